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
from mjx_study.study.descents import compute_descents
from mjx_study.study.gradients import compute_gradients
from mjx_study.study.landscapes import line_of
from mjx_study.study.plan import StudyCell, StudyPlan, estimators_of, oracles_of
from mjx_study.study.sampling import cell_keys, draw_batches, unconverged

Compute = Callable[[StudyCell], dict[str, np.ndarray]]
"""Gives the numbers of a cell by variable."""


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
