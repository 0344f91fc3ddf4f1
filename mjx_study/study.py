"""The comparison of estimators over contact models: planning it, running it, and one row per estimate.

A plan is checked completely before anything is computed. In each cell (one contact model) the estimators share their
batches: those of values and those of derivatives, drawn from independent keys; interpolated estimates combine the
two. The same keys are used in every cell, so differences between contact models are not sampling noise.
"""

import dataclasses
import math
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import estimators
from estimators import ESTIMATORS, ORACLES, EstimatorOptions, Evaluation, GradientEstimate, Linearisation
from mjx_study.comparison import CompareConfig, CompareResult, Row
from mjx_study.contact import FAMILIES, ContactModel, ContactWarning, family_model, stiffness_from_solref
from mjx_study.objective import MjxObjective, Simulator, chunk_for
from mjx_study.reference_gradient import antithetic_gradient, reference_gradient
from mjx_study.runtime import environment
from mjx_study.task import Task
from mjx_study.tasks import make_task

UNCONVERGED: Final = {"float64": 1e-6, "float32": 1e-3}
"""Relative solver residual above which a sample is reported as unconverged."""
BIAS_DRAWS: Final = 999
"""Draws of the test for bias; its least p-value is 0.001."""
GAUSSIAN_ONLY: Final = ("ddcg", "delta")
ADDITIVE_ONLY: Final = ("delta",)
"""Estimators whose formula needs Gaussian noise, or noise that is added to theta."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One contact model of a comparison."""

    family: str
    stiffness: float
    contact: ContactModel | None

    @property
    def label(self) -> str:
        """As messages name it."""
        return f"{self.family}, K = {self.stiffness:g} N/m" if self.stiffness else self.family


@dataclasses.dataclass(frozen=True)
class ComparePlan:
    """A comparison that has been checked: its task is built and its contact models are valid."""

    config: CompareConfig
    task: Task
    cells: tuple[Cell, ...]
    options: EstimatorOptions
    warnings: tuple[str, ...]


Progress = Callable[[int, int, str], None]
"""Called with (work done, work in all, what is being done)."""


def plan_compare(config: CompareConfig) -> ComparePlan:
    """Check a configuration and resolve its defaults, computing nothing.

    Raises:
        ValueError: anything about the configuration that cannot be run; the message says what is accepted.
    """
    scene_options: dict[str, Any] = {"cone": config.cone, "horizon": config.horizon, "model": config.model}
    task = make_task(config.task, **{name: value for name, value in scene_options.items() if value is not None})
    changes = {"sigma": config.sigma, "noise": config.noise}
    task = task.replace(**{name: value for name, value in changes.items() if value is not None})
    options = EstimatorOptions(
        baseline=config.baseline,
        gamma=task.gamma if config.gamma is None else config.gamma,
        failure_probability=config.failure_probability,
        variance_proxy=config.variance_proxy,
        radius=config.radius,
        sigma=task.sigma,
        max_norm=config.max_norm,
        window=config.window,
        tolerance=config.tolerance,
    )
    check_estimators(config.estimators, task, options)
    chunk = chunk_for(config.samples, jax.local_devices()) if config.chunk_size is None else config.chunk_size
    cells, messages = plan_cells(task, config.contact, config.stiffness, config.damping)
    families = tuple(dict.fromkeys(cell.family for cell in cells))
    resolved = dataclasses.replace(
        config,
        contact=families,
        stiffness=config.stiffness or (task.stiffnesses if any(FAMILIES[name].swept for name in families) else None),
        sigma=task.sigma,
        noise=task.noise,
        gamma=options.gamma,
        horizon=task.horizon,
        chunk_size=chunk,
        cone={0: "pyramidal", 1: "elliptic"}[int(task.scene.host.opt.cone)],
        model=None if config.model is None else str(Path(config.model)),
    )
    return ComparePlan(resolved, task, cells, options, messages)


def check_estimators(names: Sequence[str], task: Task, options: EstimatorOptions) -> None:
    """Refuse estimators whose formula does not hold for a task, or that lack an option.

    Raises:
        ValueError: an option is not set; the noise is not Gaussian, or not on theta, where the formula needs it.
    """
    for name in names:
        ESTIMATORS[name].check(options)
        if name in GAUSSIAN_ONLY and task.noise != "gaussian":
            raise ValueError(f"{name!r} holds for Gaussian noise only; the noise is {task.noise}")
        if name in ADDITIVE_ONLY and not task.policy.additive:
            raise ValueError(f"{name!r} needs noise that is added to theta itself; {task.name} has a feedback policy")


def plan_cells(
    task: Task,
    families: Sequence[str] | None = None,
    stiffnesses: Sequence[float] | None = None,
    damping: float | None = None,
) -> tuple[tuple[Cell, ...], tuple[str, ...]]:
    """The contact models of a sweep, family by family, and what there is to warn about.

    Args:
        task: gives what is None, and the effective mass.
        families: names of contact families.
        stiffnesses: for families that take one [N/m].
        damping: in place of each family's [N s/m].

    Raises:
        ValueError: a family is unknown, or a stiffness or damping is out of range.
    """
    cells, messages = [], []
    for family in task.families if families is None else families:
        swept = family not in FAMILIES or FAMILIES[family].swept
        undamped = swept and family in FAMILIES and FAMILIES[family].dampratio == 0
        own = damping if damping is not None else task.damping if undamped else None
        for stiffness in (task.stiffnesses if stiffnesses is None else stiffnesses) if swept else (None,):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", ContactWarning)
                contact = None if family == "mjcf" else _contact(task, family, stiffness, own if swept else None)
            cell = Cell(family, stiffness or _stiffness(task, contact), contact)
            cells.append(cell)
            messages += [f"{cell.label}: {warning.message}" for warning in caught]
    return tuple(cells), tuple(messages)


def _contact(task: Task, family: str, stiffness: float | None, damping: float | None) -> ContactModel:
    return family_model(family, task.scene, stiffness=stiffness, damping=damping, effective_mass=task.effective_mass)


def _stiffness(task: Task, contact: ContactModel | None) -> float:
    """Spring K [N/m] of a contact model that was not made from one; 0 where there is no contact."""
    if task.contact_pair is None:
        return 0.0
    if contact is None:
        solref = task.scene.host.geom_solref[task.scene.geom(task.contact_pair[0])]
    else:
        solref = np.asarray(contact.solref)
    return stiffness_from_solref(solref.tolist(), effective_mass=task.effective_mass)[0]


def compare(plan: ComparePlan, progress: Progress = lambda done, total, what: None) -> CompareResult:
    """Run a comparison."""
    config, task = plan.config, plan.task
    assert config.chunk_size is not None, "a plan's configuration is resolved"
    simulator = Simulator(task, chunk_size=config.chunk_size)
    needed = {"evaluation", *(oracle for name in config.estimators for oracle in ESTIMATORS[name].needs)}
    oracles = tuple(name for name in ORACLES if name in needed)
    keys = _Keys(config)

    total = len(plan.cells) + 1
    progress(0, total, "compiling")
    for cell in {cell.contact is None: cell for cell in plan.cells}.values():
        _compile(simulator, cell, oracles)

    rows: list[Row] = []
    gradients, references, candidates = [], [], []
    for done, cell in enumerate(plan.cells, start=1):
        progress(done, total, cell.label)
        objective = simulator.objective(cell.contact)
        batches, seconds = {}, {}
        for name in oracles:
            method = getattr(objective, ORACLES[name].method)
            drawn = jax.random.clone((keys.zeroth, keys.first)[ORACLES[name].order])  # shared on purpose
            batches[name], seconds[name] = _timed(method, task.theta, drawn)
        reference = _reference(objective, keys, batches["evaluation"], candidates)
        summary = _summarise(batches, reference, keys.test, config.estimators, plan.options, config.confidence)
        for name, numbers, gradient in summary:
            rows.append(_row(cell, name, config.samples, numbers, seconds, batches))
            gradients.append(gradient)
            references.append(np.asarray(reference.mean))
    progress(total, total, "done")
    return CompareResult(config, environment(), tuple(rows), plan.warnings, np.stack(gradients), np.stack(references))


class _Keys:
    """Independent keys of the batches; the same in every cell."""

    def __init__(self, config: CompareConfig):
        names = ("zeroth", "first", "odd", "candidate", "test")
        sizes = (config.samples, config.samples, config.reference_samples, max(64, config.samples // 4))
        *streams, self.test = jax.random.split(jax.random.key(config.seed), len(names))
        self.zeroth, self.first, self.odd, self.candidate = (
            jax.random.split(stream, size) for stream, size in zip(streams, sizes, strict=True)
        )


def _compile(simulator: Simulator, cell: Cell, oracles: Sequence[str]) -> None:
    """Compile what is needed, so that no cell's time holds it; in turn, since tracing in two threads can crash JAX."""
    objective, theta = simulator.objective(cell.contact), simulator.task.theta
    keys = jax.random.split(jax.random.key(0), 1)
    for name in dict.fromkeys([*oracles, "differentiation"]):  # the reference's control variate needs it
        getattr(objective, ORACLES[name].method)(theta, jax.random.clone(keys))


def _timed(method: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    result = jax.block_until_ready(method(*arguments))
    return result, time.perf_counter() - start


def _reference(
    objective: MjxObjective, keys: _Keys, pilot: Evaluation, candidates: list[Float[Array, " params"]]
) -> GradientEstimate:
    """The reference gradient of a cell; adds this cell's control variate to the candidates of those to come."""
    theta = objective.simulator.task.theta
    task = objective.simulator.task
    if not task.policy.additive or task.noise != "gaussian":
        return _antithetic_gradient(*objective.evaluate_pair(theta, keys.odd))
    gradients = objective.differentiate(theta, keys.candidate).gradient
    candidates.append(jnp.median(gradients, axis=0))
    newest = jnp.stack((candidates[-1:] + candidates[-2::-1])[:8])
    padded = jnp.concatenate([newest, jnp.zeros((8 - len(newest), len(theta)), newest.dtype)])
    return _reference_gradient(objective.evaluate_odd(theta, keys.odd), pilot, padded, objective.sigma)


_antithetic_gradient = jax.jit(antithetic_gradient)


@partial(jax.jit, static_argnames="sigma")
def _reference_gradient(
    odd: Evaluation, pilot: Evaluation, candidates: Float[Array, "candidates params"], sigma: float
):
    return reference_gradient(odd, pilot, list(candidates), sigma)


def _summarise(
    batches: dict[str, Any],
    reference: GradientEstimate,
    key: Key[Array, ""],
    names: tuple[str, ...],
    options: EstimatorOptions,
    confidence: float,
) -> list[tuple[str, dict[str, Any], np.ndarray]]:
    numbers = jax.device_get(_numbers(batches, reference, jax.random.clone(key), names, options, confidence))
    return [(name, values, values.pop("gradient")) for name, values in zip(names, numbers, strict=True)]


@partial(jax.jit, static_argnames=("names", "options", "confidence"))
def _numbers(batches, reference, key, names, options, confidence):
    """The numbers of each row that are functions of the batches alone."""
    result = []
    for name in names:
        estimate = estimators.combine(name, batches, options)
        lower, upper = estimators.variance_interval(estimate, confidence)
        median, high, most = estimators.norm_quantiles(estimate, (0.5, 0.9, 1.0))
        against = estimators.compare(estimate, reference)
        test = estimators.bias_test(estimate, reference, jax.random.clone(key), num_draws=BIAS_DRAWS)
        choice = estimate.alpha
        result.append(
            {
                "gradient": estimate.mean,
                "gradient_norm": jnp.linalg.norm(estimate.mean),
                "variance": estimate.variance,
                "variance_lower": lower,
                "variance_upper": upper,
                "norm_median": median,
                "norm_90": high,
                "norm_max": most,
                "relative_error": against.relative_error,
                "relative_error_se": against.relative_error_se,
                "cosine": against.cosine,
                "cosine_se": against.cosine_se,
                "reference_norm": jnp.linalg.norm(reference.mean),
                "reference_uncertainty": against.reference_uncertainty,
                "alpha": None if choice is None else choice.alpha,
                "epsilon": None if choice is None else choice.epsilon,
                "discrepancy": None if choice is None else choice.discrepancy,
                "bias_p_value": test.p_value,
                "nonfinite": estimate.num_nonfinite,
            }
        )
    return result


def _row(
    cell: Cell,
    name: str,
    samples: int,
    numbers: dict[str, Any],
    batch_seconds: dict[str, float],
    batches: dict[str, Any],
) -> Row:
    needs = ESTIMATORS[name].needs
    seconds = sum(batch_seconds[oracle] for oracle in needs)
    residuals = np.concatenate([_residuals(batches[oracle]) for oracle in needs])
    threshold = UNCONVERGED[str(residuals.dtype)]
    nonfinite = int(numbers.pop("nonfinite"))
    return Row(
        contact=cell.family,
        stiffness=cell.stiffness,
        solref=() if cell.contact is None else tuple(np.asarray(cell.contact.solref).tolist()),
        solimp=() if cell.contact is None else tuple(np.asarray(cell.contact.solimp).tolist()),
        estimator=name,
        samples=samples,
        seconds_per_sample=seconds / samples,
        variance_seconds=float(numbers["variance"]) * seconds / samples,
        residual=float(np.max(np.where(np.isfinite(residuals), residuals, math.inf))),
        unconverged=int(np.sum(~(residuals <= threshold))),
        nonfinite=nonfinite,
        **{key: None if value is None else float(value) for key, value in numbers.items()},  # type: ignore[arg-type]
    )


def _residuals(batch: Any) -> Float[np.ndarray, " rollouts"]:
    """The solver's residual of every rollout of a batch, whatever its kind."""
    parts = batch if isinstance(batch, tuple) else (batch,)
    steps = [part.steps if isinstance(part, Linearisation) else part for part in parts]
    return np.concatenate([np.asarray(part.residual) for part in steps])
