"""The comparison of estimators over contact models: what to run, running it, and one row per estimate.

A plan is checked completely before anything is computed. In each cell (one contact model) the estimators share their
batches: one of evaluations, one of differentiations, drawn from independent keys; alpha-order estimates combine the
two. The same keys are used in every cell, so differences between contact models are not sampling noise.
"""

import dataclasses
import math
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

import estimators
from estimators import ESTIMATORS, Differentiation, EstimatorOptions, Evaluation, GradientEstimate
from mjx_study.contact import FAMILIES, ContactModel, ContactWarning, family_model, stiffness_from_solref
from mjx_study.objective import MjxObjective, Simulator, chunk_for
from mjx_study.reference_gradient import reference_gradient
from mjx_study.runtime import environment
from mjx_study.task import Task
from mjx_study.tasks import make_task

UNCONVERGED: Final = {"float64": 1e-6, "float32": 1e-3}
"""Relative solver residual above which a sample is reported as unconverged."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareConfig:
    """Everything that decides the result of a comparison.

    Attributes:
        task: name of a task.
        stiffness: contact stiffnesses [N/m], for the families that take one.
        contact: names of contact families.
        estimators: names of estimators.
        samples: in each batch; an alpha-order estimate uses two batches.
        reference_samples: pairs of rollouts behind each reference gradient.
        sigma: standard deviation of the noise, in the control's unit; None for the task's.
        seed: of all randomness.
        baseline: of zeroth-order estimates: zero_noise, leave_one_out or none.
        gamma: accuracy that the alpha-order estimate must keep, in the unit of the gradient; None for the task's.
        failure_probability: of the confidence radius epsilon.
        variance_proxy: in epsilon: variance or second_moment.
        radius: R in epsilon: max_deviation, or a bound in the unit of the gradient.
        confidence: of the intervals that are reported.
        damping: of the contact [N s/m]; None for each family's damping ratio.
        cone: pyramidal or elliptic; None for the MJCF's.
        horizon: steps; None for the task's.
        model: an MJCF in place of the task's own; None for that.
        chunk_size: samples per device and call; None to choose by the number of samples.
    """

    task: str
    stiffness: tuple[float, ...] = (10.0, 30.0, 100.0, 300.0, 1000.0, 3000.0)
    contact: tuple[str, ...] = ("penalty", "mujoco", "mujoco_stiff")
    estimators: tuple[str, ...] = ("zobg", "fobg", "aobg")
    samples: int = 400
    reference_samples: int = 600
    sigma: float | None = None
    seed: int = 0
    baseline: str = "zero_noise"
    gamma: float | None = None
    failure_probability: float = 0.05
    variance_proxy: str = "variance"
    radius: str | float = "max_deviation"
    confidence: float = 0.95
    damping: float | None = None
    cone: str | None = None
    horizon: int | None = None
    model: str | None = None
    chunk_size: int | None = None

    def __post_init__(self) -> None:
        for label, names, choices in (
            ("contact family", self.contact, FAMILIES),
            ("estimator", self.estimators, ESTIMATORS),
        ):
            if not names:
                raise ValueError(f"no {label} given; choose from {', '.join(choices)}")
            for name in names:
                if name not in choices:
                    raise ValueError(f"unknown {label} {name!r}; choose from {', '.join(choices)}")
        if any(FAMILIES[name].swept for name in self.contact) and not self.stiffness:
            raise ValueError(f"the contact families {', '.join(self.contact)} need at least one stiffness in N/m")
        for label, count, least in (("samples", self.samples, 3), ("reference_samples", self.reference_samples, 3)):
            if count < least:
                raise ValueError(f"{label} must be at least {least}, so that a variance has an interval; got {count}")
        if self.chunk_size is not None and self.chunk_size < 1:
            raise ValueError(f"chunk_size must be at least 1 sample, got {self.chunk_size}")
        if not 0 < self.confidence < 1:
            raise ValueError(f"confidence must lie strictly between 0 and 1, got {self.confidence}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


@dataclasses.dataclass(frozen=True)
class Cell:
    """One contact model of a comparison."""

    family: str
    stiffness: float
    contact: ContactModel


@dataclasses.dataclass(frozen=True)
class Row:
    """One estimator at one contact model. Gradients are in cost per unit of theta.

    Attributes:
        contact: contact family.
        stiffness: K of the contact's spring, at full penetration [N/m].
        solref, solimp: MuJoCo's parameters of this contact.
        estimator: name.
        samples: in each batch.
        gradient_norm: of the mean gradient.
        variance: empirical variance of one sample, the trace of the covariance.
        variance_lower, variance_upper: its confidence interval.
        norm_median, norm_90, norm_max: quantiles of the norms of single samples; heavy tails show here.
        relative_error, relative_error_se: distance to the reference gradient over its norm, with standard error.
        cosine, cosine_se: of the angle to the reference gradient, with standard error.
        reference_norm: of the reference gradient.
        reference_uncertainty: its relative standard error; errors below it cannot be told from zero.
        alpha: weight of the first-order batch; None for an estimator of one batch.
        epsilon: confidence radius of the zeroth-order mean; None likewise.
        discrepancy: B, the distance between the two means; None likewise.
        seconds_per_sample: of computing, compilation excluded.
        residual: largest relative solver residual in the batches.
        unconverged: samples whose residual is above the threshold.
        nonfinite: samples left out because they were not finite.
    """

    contact: str
    stiffness: float
    solref: tuple[float, ...]
    solimp: tuple[float, ...]
    estimator: str
    samples: int
    gradient_norm: float
    variance: float
    variance_lower: float
    variance_upper: float
    norm_median: float
    norm_90: float
    norm_max: float
    relative_error: float
    relative_error_se: float
    cosine: float
    cosine_se: float
    reference_norm: float
    reference_uncertainty: float
    alpha: float | None
    epsilon: float | None
    discrepancy: float | None
    seconds_per_sample: float
    residual: float
    unconverged: int
    nonfinite: int


@dataclasses.dataclass(frozen=True)
class CompareResult:
    """What a comparison found, with what it depended on.

    Attributes:
        config: as resolved: no value is left to a default.
        environment: versions, machine, devices, precision.
        rows: one per cell and estimator, in the order of the configuration.
        warnings: what MuJoCo would alter or the integrator cannot resolve, each with its cell.
        gradients: mean gradients, (rows, params).
        references: reference gradients, (rows, params).
    """

    config: CompareConfig
    environment: dict[str, Any]
    rows: tuple[Row, ...]
    warnings: tuple[str, ...]
    gradients: Float[np.ndarray, "rows params"]
    references: Float[np.ndarray, "rows params"]


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
    if config.sigma is not None:
        task = task.replace(sigma=config.sigma)
    options = EstimatorOptions(
        baseline=config.baseline,
        gamma=task.gamma if config.gamma is None else config.gamma,
        failure_probability=config.failure_probability,
        variance_proxy=config.variance_proxy,
        radius=config.radius,
    )
    chunk = chunk_for(config.samples, jax.local_devices()) if config.chunk_size is None else config.chunk_size
    cells, messages = plan_cells(task, config.contact, config.stiffness, config.damping)
    resolved = dataclasses.replace(
        config,
        sigma=task.sigma,
        gamma=options.gamma,
        horizon=task.horizon,
        chunk_size=chunk,
        cone={0: "pyramidal", 1: "elliptic"}[int(task.scene.host.opt.cone)],
        model=None if config.model is None else str(Path(config.model)),
    )
    return ComparePlan(resolved, task, cells, options, messages)


def plan_cells(
    task: Task, families: Sequence[str], stiffnesses: Sequence[float], damping: float | None = None
) -> tuple[tuple[Cell, ...], tuple[str, ...]]:
    """The contact models of a sweep, family by family from soft to stiff, and what there is to warn about.

    Raises:
        ValueError: a family is unknown, or a stiffness or damping is out of range.
    """
    cells, messages, mass = [], [], task.effective_mass
    for family in families:
        swept = family not in FAMILIES or FAMILIES[family].swept
        for stiffness in stiffnesses if swept else (None,):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", ContactWarning)
                contact = family_model(
                    family,
                    task.scene,
                    stiffness=stiffness,
                    damping=damping if swept else None,
                    effective_mass=mass,
                )
            solref = np.asarray(contact.solref).tolist()
            cell = Cell(family, stiffness or stiffness_from_solref(solref, effective_mass=mass)[0], contact)
            cells.append(cell)
            messages += [f"{family}, K = {cell.stiffness:g} N/m: {warning.message}" for warning in caught]
    return tuple(cells), tuple(messages)


def compare(plan: ComparePlan, progress: Progress = lambda done, total, what: None) -> CompareResult:
    """Run a comparison."""
    config, task = plan.config, plan.task
    assert config.chunk_size is not None, "a plan's configuration is resolved"
    simulator = Simulator(task, chunk_size=config.chunk_size)
    needed = {order for name in config.estimators for order in ESTIMATORS[name].order_of_oracle}
    keys = _Keys(config)

    total = len(plan.cells) + 1
    progress(0, total, "compiling")
    _compile(simulator, plan.cells[0])

    rows: list[Row] = []
    gradients, references, candidates = [], [], []
    for done, cell in enumerate(plan.cells, start=1):
        progress(done, total, f"{cell.family}, K = {cell.stiffness:g} N/m")
        objective = simulator.objective(cell.contact)
        zeroth, zeroth_seconds = _timed(objective.evaluate, task.theta, keys.zeroth)
        first = first_seconds = None
        if 1 in needed:
            first, first_seconds = _timed(objective.differentiate, task.theta, keys.first)
        reference = _reference(objective, keys, zeroth, candidates)
        summary = _summarise(zeroth, first, reference, config.estimators, plan.options, config.confidence)
        for name, numbers, gradient in summary:
            rows.append(_row(cell, name, config.samples, numbers, zeroth_seconds, first_seconds, zeroth, first))
            gradients.append(gradient)
            references.append(np.asarray(reference.mean))
    progress(total, total, "done")
    return CompareResult(config, environment(), tuple(rows), plan.warnings, np.stack(gradients), np.stack(references))


class _Keys:
    """Independent keys of the batches; the same in every cell."""

    def __init__(self, config: CompareConfig):
        names = ("zeroth", "first", "odd", "candidate")
        sizes = (config.samples, config.samples, config.reference_samples, max(64, config.samples // 4))
        streams = jax.random.split(jax.random.key(config.seed), len(names))
        self.zeroth, self.first, self.odd, self.candidate = (
            jax.random.split(stream, size) for stream, size in zip(streams, sizes, strict=True)
        )


def _compile(simulator: Simulator, cell: Cell) -> None:
    """Compile both programs at once: XLA compiles outside of Python's lock."""
    objective, theta = simulator.objective(cell.contact), simulator.task.theta
    keys = jax.random.split(jax.random.key(0), 1)
    with ThreadPoolExecutor(2) as pool:
        for future in [pool.submit(method, theta, keys) for method in (objective.evaluate, objective.differentiate)]:
            future.result()


def _timed(method: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    result = jax.block_until_ready(method(*arguments))
    return result, time.perf_counter() - start


def _reference(
    objective: MjxObjective, keys: _Keys, pilot: Evaluation, candidates: list[Float[Array, " params"]]
) -> GradientEstimate:
    """The reference gradient of a cell; adds this cell's control variate to the candidates of those to come."""
    theta = objective.simulator.task.theta
    gradients = objective.differentiate(theta, keys.candidate).gradient
    candidates.append(jnp.median(gradients, axis=0))
    newest = jnp.stack((candidates[-1:] + candidates[-2::-1])[:8])
    padded = jnp.concatenate([newest, jnp.zeros((8 - len(newest), len(theta)), newest.dtype)])
    return _reference_gradient(objective.evaluate_odd(theta, keys.odd), pilot, padded, objective.sigma)


@partial(jax.jit, static_argnames="sigma")
def _reference_gradient(
    odd: Evaluation, pilot: Evaluation, candidates: Float[Array, "candidates params"], sigma: float
):
    return reference_gradient(odd, pilot, list(candidates), sigma)


def _summarise(
    zeroth: Evaluation,
    first: Differentiation | None,
    reference: GradientEstimate,
    names: tuple[str, ...],
    options: EstimatorOptions,
    confidence: float,
) -> list[tuple[str, dict[str, Any], np.ndarray]]:
    numbers = jax.device_get(_numbers(zeroth, first, reference, names, options, confidence))
    return [(name, values, values.pop("gradient")) for name, values in zip(names, numbers, strict=True)]


@partial(jax.jit, static_argnames=("names", "options", "confidence"))
def _numbers(zeroth, first, reference, names, options, confidence):
    """The numbers of each row that are functions of the batches alone."""
    result = []
    for name in names:
        estimate = estimators.combine(name, zeroth, first, options)
        lower, upper = estimators.variance_interval(estimate, confidence)
        median, high, most = estimators.norm_quantiles(estimate, (0.5, 0.9, 1.0))
        against = estimators.compare(estimate, reference)
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
                "nonfinite": estimate.num_nonfinite,
            }
        )
    return result


def _row(
    cell: Cell,
    name: str,
    samples: int,
    numbers: dict[str, Any],
    zeroth_seconds: float,
    first_seconds: float | None,
    zeroth: Evaluation,
    first: Differentiation | None,
) -> Row:
    orders = ESTIMATORS[name].order_of_oracle
    batches = [(zeroth, zeroth_seconds), (first, first_seconds)]
    seconds = sum(batches[order][1] or 0.0 for order in orders)
    residuals = np.concatenate([np.asarray(batches[order][0].residual) for order in orders])
    threshold = UNCONVERGED[str(residuals.dtype)]
    nonfinite = int(numbers.pop("nonfinite"))
    return Row(
        contact=cell.family,
        stiffness=cell.stiffness,
        solref=tuple(np.asarray(cell.contact.solref).tolist()),
        solimp=tuple(np.asarray(cell.contact.solimp).tolist()),
        estimator=name,
        samples=samples,
        seconds_per_sample=seconds / samples,
        residual=float(np.max(np.where(np.isfinite(residuals), residuals, math.inf))),
        unconverged=int(np.sum(~(residuals <= threshold))),
        nonfinite=nonfinite,
        **{key: None if value is None else float(value) for key, value in numbers.items()},  # type: ignore[arg-type]
    )


def findings(result: CompareResult) -> list[str]:
    """What the intervals say, in sentences: where FoBG's variance is above ZoBG's, and where its mean is biased."""
    return [
        sentence
        for family in result.config.contact
        for sentence in (*_variance_finding(result, family), *_bias_finding(result, family))
    ]


def _variance_finding(result: CompareResult, family: str) -> list[str]:
    table = {(row.stiffness, row.estimator): row for row in result.rows if row.contact == family}
    groups: dict[str, list[float]] = {"below ZoBG's": [], "above it": [], "not told apart": []}
    for stiffness in sorted({stiffness for stiffness, _ in table}):
        if (stiffness, "zobg") not in table or (stiffness, "fobg") not in table:
            return []
        zeroth, first = table[stiffness, "zobg"], table[stiffness, "fobg"]
        below, above = first.variance_upper < zeroth.variance_lower, first.variance_lower > zeroth.variance_upper
        groups["below ZoBG's" if below else "above it" if above else "not told apart"].append(stiffness)
    parts = [f"{verdict} at K = {_list(group)} N/m" for verdict, group in groups.items() if group]
    return [f"{family}: FoBG's variance is {'; '.join(parts)} ({result.config.confidence:.0%} intervals)"]


def _bias_finding(result: CompareResult, family: str) -> list[str]:
    """Where the error of FoBG's mean is more than three times what its own noise and the reference's explain."""
    biased = []
    for row in result.rows:
        if row.contact == family and row.estimator == "fobg":
            noise = math.hypot(math.sqrt(row.variance / row.samples) / row.reference_norm, row.reference_uncertainty)
            if row.relative_error > 3 * noise:
                biased.append(row)
    return [
        f"{family}: FoBG's mean is biased by {row.relative_error:.1%} at K = {row.stiffness:g} N/m "
        "(its error is over three times what noise explains)"
        for row in biased
    ]


def _list(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)
