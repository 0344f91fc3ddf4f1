"""What is computed of each cell of a study: estimates of a gradient, descents, or a landscape."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators import Estimator
from mjx_study.objective import Simulator
from mjx_study.runtime import precision
from mjx_study.study.descents import Backend, optimise
from mjx_study.study.gradients import compute_gradients
from mjx_study.study.landscapes import line_of
from mjx_study.study.plan import StudyCell, StudyPlan, descent_plan, estimators_of, oracles_of
from mjx_study.study.sampling import cell_keys, draw_batches, unconverged

Compute = Callable[[StudyCell], dict[str, np.ndarray]]
"""Gives the numbers of a cell by variable."""


def compute_descents(plan: StudyPlan) -> Callable[[StudyCell], dict[str, np.ndarray]]:
    """A function that computes a cell; it keeps what is compiled."""
    backends: dict[tuple[int, float, int], Backend] = {}

    def compute(cell: StudyCell) -> dict[str, np.ndarray]:
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


def compute_landscapes(plan: StudyPlan) -> Compute:
    """A function that computes a cell; it keeps what is compiled."""
    config, oracles = plan.config, oracles_of(plan.config)
    compiled: dict[int, Simulator] = {}

    def compute(cell: StudyCell) -> dict[str, np.ndarray]:
        task = plan.groups[cell.group].task
        if cell.group not in compiled:
            compiled[cell.group] = Simulator(task, chunk_size=plan.chunk_size)
        objective = dataclasses.replace(compiled[cell.group].objective(cell.model.contact), sigma=cell.sigma)
        line = line_of(task, config.points or 0, config.span, config.direction, config.seed)
        chosen = estimators_of(plan, cell)
        keys, columns, lost = cell_keys(config.seed, config.batches), [], 0
        for theta in line.thetas:
            drawn, _, residuals = draw_batches(objective, theta, keys, oracles, cell.samples, slice(None))
            lost += sum(unconverged(each, precision()) for each in residuals.values())
            pooled = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), drawn)
            columns.append(jax.device_get(_slopes(pooled, line.direction, chosen)))
        arrays = {name: np.stack([column[name] for column in columns], axis=-1) for name in columns[0]}
        arrays |= {"position": line.position, "unconverged": np.asarray(lost)}
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
