"""What is computed of each cell of a sweep: estimates of a gradient, descents, or a landscape."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import estimators
from estimators import ORACLES, Estimator, GradientEstimate
from mjx_study.objective import Simulator
from mjx_study.study.descents import Backend, optimise
from mjx_study.study.gradients import UNCONVERGED, estimate_numbers, reference_of, residuals_of, soft_gradient
from mjx_study.study.landscapes import line_of
from mjx_study.study.plan import (
    LARGEST_BATCH,
    SweepCell,
    SweepPlan,
    descent_plan,
    estimators_of,
    oracles_of,
    seeds_together,
)

CANDIDATES: Final = 100
"""First-order samples whose median is a candidate for the reference's control variate."""
CONFIDENCE: Final = 0.95
"""Of intervals within a batch; those over seeds are made where figures are drawn."""
Compute = Callable[[SweepCell], dict[str, np.ndarray]]
"""Gives the numbers of a cell by variable."""

GRADIENT_VARIABLES: Final[dict[str, tuple[tuple[str, ...], str, str]]] = {
    "variance": (("seed", "estimator"), "gradient^2", "variance of one sample, the trace of the covariance"),
    "norm_90": (("seed", "estimator"), "gradient", "90 % quantile of the samples' norms"),
    "norm_max": (("seed", "estimator"), "gradient", "largest norm of a sample"),
    "gradient_norm": (("seed", "estimator"), "gradient", "norm of the mean"),
    "relative_error": (("seed", "estimator"), "1", "distance of the mean to the reference, over its norm"),
    "relative_error_se": (("seed", "estimator"), "1", "standard error of that"),
    "debiased_error": (("seed", "estimator"), "1", "the same without what noise adds to it"),
    "debiased_error_se": (("seed", "estimator"), "1", "standard error of that"),
    "cosine": (("seed", "estimator"), "1", "of the angle between mean and reference"),
    "debiased_cosine": (("seed", "estimator"), "1", "the same without what noise takes from it"),
    "debiased_cosine_se": (("seed", "estimator"), "1", "standard error of that"),
    "effective_samples": (("seed", "estimator"), "1", "samples that the variance rests on"),
    "top_share": (("seed", "estimator"), "1", "of the variance, the largest sample's"),
    "alpha": (("seed", "estimator"), "1", "weight of the first-order batch"),
    "epsilon": (("seed", "estimator"), "gradient", "confidence radius of the zeroth-order mean"),
    "discrepancy": (("seed", "estimator"), "gradient", "distance between the two means"),
    "bias_p_value": (("seed", "estimator"), "1", "of no bias against the reference"),
    "nonfinite": (("seed", "estimator"), "1", "samples that were left out"),
    "pooled_error": (("estimator",), "1", "distance of the mean over all seeds to the reference, over its norm"),
    "squared_bias": (("estimator",), "1", "unbiased estimate of the squared bias, over the reference's squared norm"),
    "squared_bias_se": (("estimator",), "1", "standard error of that"),
    "reference_norm": ((), "gradient", "norm of the reference gradient"),
    "reference_uncertainty": ((), "1", "standard error of the reference, over its norm"),
    "reference_effective_samples": ((), "1", "samples that the reference's variance rests on"),
    "residual": ((), "1", "largest relative residual of the solver"),
    "unconverged": ((), "1", "rollouts whose solver residual is too large"),
    "seconds_per_sample": (("estimator",), "s", "computing time of one sample, measured; compilation excluded"),
}
DESCENT_VARIABLES: Final[dict[str, tuple[tuple[str, ...], str, str]]] = {
    "final_cost": (("seed", "estimator"), "cost", "mean cost of the final policy"),
    "final_cost_se": (("seed", "estimator"), "cost", "standard error of that"),
    "start_cost": ((), "cost", "mean cost of the start's policy"),
    "stopped_at": (("seed", "estimator"), "1", "iteration at which a seed stopped before the end; NaN for none"),
    "cost": (("iteration", "seed", "estimator"), "cost", "mean cost of the batch, before the update"),
    "alpha": (("iteration", "seed", "estimator"), "1", "weight of the first-order batch"),
    "rollouts": (("estimator",), "1", "simulated in one iteration of one seed"),
    "seconds": (("iteration", "estimator"), "s", "since the start, measured; compilation excluded"),
}
LANDSCAPE_VARIABLES: Final[dict[str, tuple[tuple[str, ...], str, str]]] = {
    "position": (("point",), "unit of theta", "t, of the point theta_0 + t direction"),
    "cost": (("point",), "cost", "without noise; the mean over starts where they are drawn"),
    "smoothed": (("point",), "cost", "mean cost with noise"),
    "smoothed_se": (("point",), "cost", "standard error of that"),
    "slope": (("estimator", "point"), "gradient", "mean of the estimator along the line"),
    "slope_se": (("estimator", "point"), "gradient", "standard error of that"),
    "nonfinite": (("estimator", "point"), "1", "samples that were left out"),
    "unconverged": ((), "1", "rollouts whose solver residual is too large"),
}
VARIABLES: Final = {"gradients": GRADIENT_VARIABLES, "descents": DESCENT_VARIABLES, "landscapes": LANDSCAPE_VARIABLES}
"""By kind of study: dimensions within a cell, unit and description of each variable."""
MEASURED: Final = ("seconds", "seconds_per_sample")
"""Variables that are times, and so the only ones that differ from run to run."""


def compute_gradients(plan: SweepPlan) -> Callable[[SweepCell], dict[str, np.ndarray]]:
    """A function that computes a cell; it keeps what is compiled."""
    config, oracles = plan.config, oracles_of(plan.config)
    compiled: dict[int, Simulator] = {}
    warm: set[tuple[int, bool]] = set()
    soft: dict[tuple[int, float], Array | None] = {}

    def compute(cell: SweepCell) -> dict[str, np.ndarray]:
        if cell.group not in compiled:
            compiled[cell.group] = Simulator(plan.groups[cell.group].task, chunk_size=config.chunk_size)  # type: ignore[arg-type]
        objective = dataclasses.replace(compiled[cell.group].objective(cell.model.contact), sigma=cell.sigma)
        theta = plan.groups[cell.group].task.theta
        if (cell.group, cell.model.contact is None) not in warm:  # so that no cell's time holds a compilation
            for name in oracles:
                getattr(objective, ORACLES[name].method)(theta, jax.random.split(jax.random.key(0), 1))
            warm.add((cell.group, cell.model.contact is None))
        keys = _cell_keys(config.seed, config.batches)
        odd, candidate = (
            jax.random.split(stream, size)
            for stream, size in zip(keys["reference"], (config.reference_samples or 0, CANDIDATES), strict=True)
        )
        softened = cell.group, cell.sigma
        if softened not in soft:
            soft[softened] = soft_gradient(compiled[cell.group], cell.sigma, candidate)
        tests, chosen = jax.random.split(keys["test"], config.batches), estimators_of(plan, cell)
        together = seeds_together(plan, cell)
        reference, parts, spent, residuals = None, [], [], []
        for start in range(0, config.batches, together):
            some = slice(start, start + together)
            drawn, seconds, residual = _draw(objective, theta, keys, oracles, cell.samples, some)
            if reference is None:
                pilot = jax.tree.map(lambda leaf: leaf[0], drawn["evaluation"])
                reference = reference_of(objective, odd, candidate, pilot, soft[softened])
            parts.append(jax.device_get(_seed_numbers(drawn, reference, tests[some], chosen)))
            spent.append(seconds)
            residuals.append(residual)
        assert reference is not None
        numbers = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
        residuals = np.concatenate(residuals)
        seconds = {name: sum(each[name] for each in spent) for name in oracles}
        arrays = _of_seeds(numbers, config.batches) | _bias(numbers, reference)
        arrays["residual"] = np.asarray(np.max(np.where(np.isfinite(residuals), residuals, np.inf)))
        arrays["unconverged"] = np.asarray(np.sum(~(residuals <= UNCONVERGED[str(residuals.dtype)])))
        per_sample = [sum(seconds[oracle] for oracle in each.needs) for each in chosen]
        arrays["seconds_per_sample"] = np.array(per_sample) / (cell.samples * config.batches)
        return {name: np.asarray(array, float) for name, array in arrays.items()}

    return compute


def _of_seeds(numbers: Sequence[dict[str, Any]], seeds: int) -> dict[str, np.ndarray]:
    """Numbers by seed and estimator, NaN for what an estimator does not have; and those of the reference."""
    arrays = {
        name: np.stack([np.full(seeds, np.nan) if row[name] is None else row[name] for row in numbers], axis=1)
        for name, (dimensions, *_) in GRADIENT_VARIABLES.items()
        if dimensions == ("seed", "estimator")
    }
    first = numbers[0]  # every estimator's row has the reference's numbers, every seed the same
    shared = ("reference_norm", "reference_uncertainty", "reference_effective_samples")
    return arrays | {name: np.asarray(first[name][0]) for name in shared}


def _bias(numbers: Sequence[dict[str, Any]], reference: GradientEstimate) -> dict[str, np.ndarray]:
    """Each estimator's bias over the norm of the reference, from the means of its seeds."""
    means = [jnp.asarray(row["gradient"]) for row in numbers]
    square = float(jnp.sum(reference.mean**2))
    squared, errors = zip(*(estimators.squared_bias_of_means(each, reference) for each in means), strict=True)
    gaps = [jnp.linalg.norm(jnp.mean(each, axis=0) - reference.mean) for each in means]
    return {
        "squared_bias": np.array(squared, float) / square,
        "squared_bias_se": np.array(errors, float) / square,
        "pooled_error": np.array(gaps, float) / square**0.5,
    }


def _cell_keys(seed: int, seeds: int) -> dict[str, Any]:
    """Independent keys, the same in every cell: of each seed's batches, of the reference and of the tests."""
    zeroth, first, odd, candidate, test = jax.random.split(jax.random.key(seed), 5)
    by_order = [jax.random.split(stream, seeds) for stream in (zeroth, first)]
    return {"order": by_order, "reference": (odd, candidate), "test": test}


def _draw(objective: Any, theta: Array, keys: dict[str, Any], oracles: Sequence[str], samples: int, seeds: slice):
    """Batches of every oracle with an axis of seeds, the seconds that each took, and every rollout's residual."""
    together = max(1, LARGEST_BATCH // samples)
    drawn, seconds, residuals = {}, {}, []
    for name in oracles:
        streams: Key[Array, " seeds"] = keys["order"][ORACLES[name].order][seeds]
        parts, seconds[name] = [], 0.0
        for start in range(0, len(streams), together):
            some = jax.random.clone(streams[start : start + together])
            flat = jax.vmap(lambda key: jax.random.split(key, samples))(some).reshape(-1)
            begun = time.perf_counter()
            batch = jax.block_until_ready(getattr(objective, ORACLES[name].method)(theta, flat))
            seconds[name] += time.perf_counter() - begun
            residuals.append(residuals_of(batch))
            parts.append(jax.tree.map(lambda leaf: leaf.reshape(-1, samples, *leaf.shape[1:]), batch))
        drawn[name] = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return drawn, seconds, np.concatenate(residuals)


@partial(jax.jit, static_argnames="chosen")
def _seed_numbers(drawn: dict[str, Any], reference: Any, keys: Key[Array, " seeds"], chosen: tuple[Estimator, ...]):
    """The numbers of every estimator, with an axis of seeds."""
    return jax.vmap(lambda batches, key: estimate_numbers(batches, reference, key, chosen, CONFIDENCE))(drawn, keys)


def compute_descents(plan: SweepPlan) -> Callable[[SweepCell], dict[str, np.ndarray]]:
    """A function that computes a cell; it keeps what is compiled."""
    backends: dict[tuple[int, float, int], Backend] = {}

    def compute(cell: SweepCell) -> dict[str, np.ndarray]:
        ready = descent_plan(plan, cell)
        key = (cell.group, cell.sigma, cell.samples)
        if key not in backends:
            backends[key] = Backend(ready)
        found = optimise(ready, backend=backends[key])
        iterations, seeds = ready.config.iterations or 0, ready.config.seeds
        arrays = {
            "final_cost": np.stack([run.final_cost for run in found.runs], 1),
            "final_cost_se": np.stack([run.final_cost_se for run in found.runs], 1),
            "start_cost": np.array(found.start_cost[0]),
            "stopped_at": np.full((seeds, len(found.runs)), np.nan),
            "rollouts": np.array([run.rollouts for run in found.runs]),
        }
        for column, run in enumerate(found.runs):
            for seed, (iteration, _) in run.stopped.items():
                arrays["stopped_at"][seed, column] = iteration
        for name in ("cost", "alpha"):
            arrays[name] = np.stack([_padded(run.history[name], iterations) for run in found.runs], -1)
        arrays["seconds"] = np.stack([_padded(run.seconds, iterations) for run in found.runs], -1)
        return {name: np.asarray(array, float) for name, array in arrays.items()}

    return compute


def _padded(values: np.ndarray, length: int) -> np.ndarray:
    """With NaN after its end, along the first axis."""
    missing = [(0, length - len(values))] + [(0, 0)] * (values.ndim - 1)
    return np.pad(np.asarray(values, float), missing, constant_values=np.nan)


def compute_landscapes(plan: SweepPlan) -> Compute:
    """A function that computes a cell; it keeps what is compiled."""
    config, oracles = plan.config, oracles_of(plan.config)
    compiled: dict[int, Simulator] = {}

    def compute(cell: SweepCell) -> dict[str, np.ndarray]:
        task = plan.groups[cell.group].task
        if cell.group not in compiled:
            compiled[cell.group] = Simulator(task, chunk_size=config.chunk_size)  # type: ignore[arg-type]
        objective = dataclasses.replace(compiled[cell.group].objective(cell.model.contact), sigma=cell.sigma)
        line = line_of(task, config.points or 0, config.span, config.direction, config.seed)
        chosen = estimators_of(plan, cell)
        keys, columns, unconverged = _cell_keys(config.seed, config.batches), [], 0
        for theta in line.thetas:
            drawn, _, residuals = _draw(objective, theta, keys, oracles, cell.samples, slice(None))
            unconverged += np.sum(~(residuals <= UNCONVERGED[str(residuals.dtype)]))
            pooled = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), drawn)
            columns.append(jax.device_get(_slopes(pooled, line.direction, chosen)))
        arrays = {name: np.stack([column[name] for column in columns], axis=-1) for name in columns[0]}
        arrays |= {"position": line.position, "unconverged": np.asarray(unconverged)}
        return {name: np.asarray(array, float) for name, array in arrays.items()}

    return compute


@partial(jax.jit, static_argnames="chosen")
def _slopes(batches: dict[str, Any], direction: Array, chosen: tuple[Estimator, ...]):
    """Costs at a point, and every estimator's slope along the line; what is not finite is left out."""
    evaluation = batches["evaluation"]
    smoothed, smoothed_se = _mean(evaluation.value)
    along = {"slope": [], "slope_se": [], "nonfinite": []}
    for estimator in chosen:
        estimate = estimator(batches)
        mean, error = _mean(estimate.per_sample @ direction)
        for key, value in zip(along, (mean, error, estimate.num_nonfinite), strict=True):
            along[key].append(value)
    found = {name: jnp.stack(values) for name, values in along.items()}
    return found | {"cost": jnp.mean(evaluation.baseline), "smoothed": smoothed, "smoothed_se": smoothed_se}


def _mean(sample: Float[Array, " samples"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean of what is finite, and its standard error."""
    finite = jnp.isfinite(sample)
    count = jnp.sum(finite)
    return jnp.mean(sample, where=finite), jnp.std(sample, where=finite, ddof=1) / jnp.sqrt(count)


COMPUTE: Final = {"gradients": compute_gradients, "descents": compute_descents, "landscapes": compute_landscapes}
