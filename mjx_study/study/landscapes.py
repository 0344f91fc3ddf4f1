r"""Landscapes of a cell: the cost along a line, its mean under noise, and each estimator's slope.

At each grid point of a line theta(t) = theta_0 + t * direction (for a scalar parameter, theta = t), compute

    the cost without noise,  F = E V_1,  E[ZoBG] . direction,  E[FoBG] . direction,

each mean with its standard error. Where F has a slope that E[FoBG] lacks, the cost jumps. All points and contact models
use the same keys, so curves are smooth and differences between them are not sampling noise; zeroth- and first-order
means use independent keys. For a scalar parameter and a fixed start, the means are also computed without sampling, by
quadrature.

Reference: Suh et al. 2022, figure of simple systems, second row.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators import Estimator
from mjx_study.reference import FunctionObjective, Reference, ScalarFunction, smoothed
from mjx_study.runtime import precision
from mjx_study.study.line import line_of
from mjx_study.study.plan import StudyCell, StudyPlan, estimators_of, oracles_of
from mjx_study.study.quadrature import Line, Means, applies, grid, means
from mjx_study.study.sampling import Objectives, cell_keys, draw_batches, unconverged

QUADRATURE: Final = 1500
"""Number of quadrature points under Gaussian noise; heavier tails get more."""


def compute_landscapes(plan: StudyPlan) -> Callable[[StudyCell], dict[str, np.ndarray]]:
    """Return a function that computes cells and keeps compiled programs between them."""
    config, oracles, objectives = plan.config, oracles_of(plan.config), Objectives(plan)
    lines: dict[int, Line] = {}

    def exact(cell: StudyCell, position: Float[np.ndarray, " points"], objective: Any) -> Means | None:
        """Means by quadrature or closed form, where available."""
        task = plan.groups[cell.group].task
        if cell.model.analytic:
            return closed_form(objective, position)
        if not applies(task):
            return None
        if cell.group not in lines:
            lines[cell.group] = Line(task)
        points = grid(position[0], position[-1], cell.sigma, QUADRATURE, task.noise)
        return means(points, *lines[cell.group](points, cell.model.contact), position, cell.sigma, task.noise)

    def compute(cell: StudyCell) -> dict[str, np.ndarray]:
        task, objective = plan.groups[cell.group].task, objectives(cell)
        line = line_of(task, config.points or 0, config.span, config.direction, config.seed)
        chosen = estimators_of(plan, cell)
        keys, columns, unconverged_solves, largest = cell_keys(config.seed, config.batches), [], 0, 0.0
        for theta in line.thetas:
            drawn, _, residuals = draw_batches(objective, theta, keys, oracles, cell.samples, slice(None))
            unconverged_solves += sum(unconverged(each, precision()) for each in residuals.values())
            largest = max(
                largest, *(float(np.max(np.nan_to_num(each, nan=np.inf), initial=0.0)) for each in residuals.values())
            )
            pooled = jax.tree.map(lambda leaf: jnp.asarray(leaf).reshape(-1, *leaf.shape[2:]), drawn)
            columns.append(jax.device_get(_slopes(pooled, line.direction, chosen)))
        arrays = {name: np.stack([column[name] for column in columns], axis=-1) for name in columns[0]}
        arrays |= {
            "position": line.position,
            "unconverged": np.asarray(unconverged_solves),
            "residual": np.asarray(largest),
        }
        if (found := exact(cell, line.position, objective)) is not None:
            arrays |= {f"exact_{name}": values for name, values in vars(found).items()}
        return {name: np.asarray(array, float) for name, array in arrays.items()}

    return compute


@partial(jax.jit, static_argnames="chosen")
def _slopes(batches: dict[str, Any], direction: Array, chosen: tuple[Estimator, ...]):
    """Costs at a point, and every estimator's slope along the line, without nonfinite samples."""
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
    finite = jnp.isfinite(sample)
    count = jnp.sum(finite)
    return jnp.mean(sample, where=finite), jnp.std(sample, where=finite, ddof=1) / jnp.sqrt(count)


def closed_form(reference: Reference, position: Float[np.ndarray, " points"]) -> Means | None:
    """Means of a function of one parameter; None for any other reference."""
    if not isinstance(reference, FunctionObjective) or not isinstance(reference.function, ScalarFunction):
        return None
    points = [smoothed(reference.function, np.array([t]), reference.sigma, reference.noise) for t in position]
    value, slope, jump = np.array([(point.value, point.gradient[0], point.jump_term[0]) for point in points]).T
    return Means(value, slope, slope - jump, np.zeros_like(slope), np.zeros_like(slope))
