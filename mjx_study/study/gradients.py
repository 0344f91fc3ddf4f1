"""The comparison of estimators over contact models: planning it, running it, and one row per estimate.

A plan is checked completely before anything is computed. In each cell (one contact model) the estimators share their
batches: those of values and those of derivatives, drawn from independent keys; interpolated estimates combine the
two. The same keys are used in every cell, so differences between contact models are not sampling noise.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import estimators
from estimators import ORACLES, Estimator, Evaluation, GradientEstimate, Linearisation
from mjx_study.objective import MjxObjective, Simulator
from mjx_study.runtime import environment
from mjx_study.simulation.contact import FAMILIES
from mjx_study.study.comparison import BIAS_DRAWS, CompareConfig, CompareResult, Row
from mjx_study.study.configuration import Progress, at_theta, configured_estimators, configured_task, resolved_fields
from mjx_study.study.memory import check_memory
from mjx_study.study.reference_gradient import reference_gradient
from mjx_study.tasks.contact_grid import ContactPoint, contact_grid
from mjx_study.tasks.task import Task

UNCONVERGED: Final = {"float64": 1e-6, "float32": 1e-3}
"""Relative solver residual above which a sample is reported as unconverged."""


@dataclasses.dataclass(frozen=True)
class ComparePlan:
    """A comparison that has been checked: its task is built and its contact models are valid."""

    config: CompareConfig
    task: Task
    cells: tuple[ContactPoint, ...]
    estimators: tuple[Estimator, ...]
    warnings: tuple[str, ...]


def plan_compare(config: CompareConfig, task: Task | None = None) -> ComparePlan:
    """Check a configuration and resolve its defaults, computing nothing.

    Args:
        config: what to compare.
        task: in place of the one that the configuration names.

    Raises:
        ValueError: anything about the configuration that cannot be run; the message says what is accepted.
    """
    task = at_theta(configured_task(config, task), config.theta)
    chosen = configured_estimators(config, task)
    kept = config.reference_samples * 3 * task.policy.num_params
    check_memory(task, chosen, config.samples, other=kept)
    cells, messages = contact_grid(task, config.contact, config.stiffness, config.damping)
    families = tuple(dict.fromkeys(cell.family for cell in cells))
    resolved = dataclasses.replace(
        config,
        contact=families,
        stiffness=config.stiffness or (task.stiffnesses if any(FAMILIES[name].swept for name in families) else None),
        model=None if config.model is None else str(Path(config.model)),
        **resolved_fields(config, task, config.samples),
    )
    return ComparePlan(resolved, task, cells, chosen, messages)


def compare(plan: ComparePlan, progress: Progress = lambda done, total, what: None) -> CompareResult:
    """Run a comparison."""
    config, task = plan.config, plan.task
    assert config.chunk_size is not None, "a plan's configuration is resolved"
    simulator = Simulator(task, chunk_size=config.chunk_size)
    oracles = estimators.oracles_of(plan.estimators, "evaluation")
    keys = _Keys(config)

    total = len(plan.cells) + 1
    progress(0, total, "compiling")
    for cell in {cell.contact is None: cell for cell in plan.cells}.values():
        _compile(simulator, cell, oracles)

    rows: list[Row] = []
    gradients, references = [], []
    soft = soft_gradient(simulator, task.sigma, keys.candidate)
    for done, cell in enumerate(plan.cells, start=1):
        progress(done, total, cell.label)
        objective = simulator.objective(cell.contact)
        batches, seconds = {}, {}
        for name in oracles:
            method = getattr(objective, ORACLES[name].method)
            drawn = jax.random.clone((keys.zeroth, keys.first)[ORACLES[name].order])  # shared on purpose
            batches[name], seconds[name] = _timed(method, task.theta, drawn)
        reference = reference_of(objective, keys.odd, keys.candidate, batches["evaluation"], soft)
        test = jax.random.clone(keys.test)
        summary = jax.device_get(estimate_numbers(batches, reference, test, plan.estimators, config.confidence))
        for name, estimator, numbers in zip(config.estimators, plan.estimators, summary, strict=True):
            gradients.append(numbers.pop("gradient"))
            rows.append(_row(cell, name, estimator.needs, config.samples, numbers, seconds, batches))
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


def _compile(simulator: Simulator, cell: ContactPoint, oracles: Sequence[str]) -> None:
    """Compile what is needed, so that no cell's time holds it; in turn, since tracing in two threads can crash JAX."""
    objective, theta = simulator.objective(cell.contact), simulator.task.theta
    keys = jax.random.split(jax.random.key(0), 1)
    for name in dict.fromkeys([*oracles, "differentiation"]):  # the reference's control variate needs it
        getattr(objective, ORACLES[name].method)(theta, jax.random.clone(keys))


def _timed(method: Callable[..., Any], *arguments: Any) -> tuple[Any, float]:
    start = time.perf_counter()
    result = jax.block_until_ready(method(*arguments))
    return result, time.perf_counter() - start


def soft_gradient(simulator: Simulator, sigma: float, keys: Key[Array, " samples"]) -> Float[Array, " params"] | None:
    """The median first-order gradient under the softest contact that the task sweeps, whatever is compared.

    A candidate for the reference's control variate at every contact model: beyond some stiffness first-order gradients
    are noise, and this one still points where most of the gradient does. None where the reference takes none, or where
    the task has no contact.
    """
    task = simulator.task
    if task.contact_pair is None or not _takes_candidates(task):
        return None
    (cell,), _ = contact_grid(task, ("penalty",), (min(task.stiffnesses),))
    objective = simulator.objective(cell.contact, sigma)
    return jnp.median(objective.differentiate(task.theta, jax.random.clone(keys)).gradient, axis=0)


def reference_of(
    objective: MjxObjective,
    odd_keys: Key[Array, " pairs"],
    candidate_keys: Key[Array, " samples"],
    pilot: Evaluation,
    soft: Float[Array, " params"] | None,
) -> GradientEstimate:
    """The reference gradient of a contact model; it does not depend on which others there are.

    Args:
        objective: the task under that contact model.
        odd_keys: of the pairs of rollouts.
        candidate_keys: of the first-order samples whose median is a candidate for the control variate.
        pilot: a batch from other keys, which picks among the candidates.
        soft: another candidate, see `soft_gradient`.
    """
    task = objective.simulator.task
    if not _takes_candidates(task):
        plus, minus = objective.evaluate_pair(task.theta, odd_keys)
        return _antithetic(plus, minus, "zero_noise")
    own = jnp.median(objective.differentiate(task.theta, candidate_keys).gradient, axis=0)
    candidates = jnp.stack([own, jnp.zeros_like(own) if soft is None else soft])
    return _reference_gradient(objective.evaluate_odd(task.theta, odd_keys), pilot, candidates, objective.sigma)


def _takes_candidates(task: Task) -> bool:
    """Whether the reference is of odd parts and a control variate."""
    return task.policy.additive and task.noise == "gaussian"


_antithetic = jax.jit(estimators.antithetic, static_argnames="baseline")


@partial(jax.jit, static_argnames="sigma")
def _reference_gradient(
    odd: Evaluation, pilot: Evaluation, candidates: Float[Array, "candidates params"], sigma: float
):
    return reference_gradient(odd, pilot, list(candidates), sigma)


@partial(jax.jit, static_argnames=("chosen", "confidence"))
def estimate_numbers(batches, reference, key, chosen, confidence):
    """The numbers of each estimator's row that are functions of the batches and the reference gradient alone."""
    result = []
    reference_effective = estimators.effective_samples(reference).count
    for estimator in chosen:
        estimate = estimator(batches)
        lower, upper = estimators.variance_interval(estimate, confidence)
        median, high, most = estimators.norm_quantiles(estimate, (0.5, 0.9, 1.0))
        effective = estimators.effective_samples(estimate)
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
                "effective_samples": effective.count,
                "top_share": effective.top_share,
                "relative_error": against.relative_error,
                "relative_error_se": against.relative_error_se,
                "debiased_error": against.debiased_error,
                "debiased_error_se": against.debiased_error_se,
                "cosine": against.cosine,
                "cosine_se": against.cosine_se,
                "debiased_cosine": against.debiased_cosine,
                "debiased_cosine_se": against.debiased_cosine_se,
                "reference_norm": jnp.linalg.norm(reference.mean),
                "reference_effective_samples": reference_effective,
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
    cell: ContactPoint,
    name: str,
    needs: Sequence[str],
    samples: int,
    numbers: dict[str, Any],
    batch_seconds: dict[str, float],
    batches: dict[str, Any],
) -> Row:
    seconds = sum(batch_seconds[oracle] for oracle in needs)
    residuals = np.concatenate([residuals_of(batches[oracle]) for oracle in needs])
    threshold = UNCONVERGED[str(residuals.dtype)]
    nonfinite = int(numbers.pop("nonfinite"))
    figures: dict[str, Any] = {key: None if value is None else float(value) for key, value in numbers.items()}
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
        **_onsets(batches[oracle] for oracle in needs),
        **figures,
    )


def _onsets(batches: Iterable[Any]) -> dict[str, int]:
    """What the onset term met in all samples, by field of a row; empty without the term."""
    events = [batch.events for batch in batches if getattr(batch, "events", None) is not None]
    names = ("onsets", "onsets_bounded", "onsets_missed")
    return dict(zip(names, map(int, np.sum(np.concatenate(events), axis=0)), strict=True)) if events else {}


def residuals_of(batch: Any) -> Float[np.ndarray, " rollouts"]:
    """The solver's residual of every rollout of a batch, whatever its kind."""
    parts = batch if isinstance(batch, tuple) else (batch,)
    steps = [part.steps if isinstance(part, Linearisation) else part for part in parts]
    return np.concatenate([np.asarray(part.residual) for part in steps])
