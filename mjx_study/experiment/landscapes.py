r"""Landscapes of a cell: the cost along a line, its mean under noise, and each estimator's slope.

At each grid point of a line theta(t) = theta_0 + t * direction (for a scalar parameter, theta = t), compute

    the cost without noise,  F = E V_1,  E[ZoBG] . direction,  E[FoBG] . direction,

each mean with its standard error. Where F has a slope that E[FoBG] lacks, the cost jumps. All points and contact models
use the same keys, so curves are smooth and differences between them are not sampling noise; zeroth- and first-order
means use independent keys.

For a scalar parameter and a fixed start, the means are also computed without sampling, by quadrature:

    F(theta) = E f(theta + w),   F'(theta) = E f(theta + w) psi'(w),   E[FoBG] = E f'(theta + w),

with w of density p = exp(-psi), on one fine uniform grid for all theta. f is treated as constant in each grid cell;
since psi' p = -p', the cell's weight in F' is p(left end) - p(right end), whatever kinks p has in between. The error is
of second order in the spacing for smooth f, and a spacing times the jump where f jumps; the difference from the rule
with every second point estimates it.

Reference: Suh et al. 2022, figure of simple systems, second row.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators import NOISES, Estimator
from estimators.noise import split_sample_key
from mjx_study.compiled import Compiled
from mjx_study.experiment.plan import StudyCell, StudyPlan, estimators_of, oracles_of
from mjx_study.experiment.resolution import line_of
from mjx_study.experiment.sampling import Objectives, cell_keys, draw_batches, unconverged
from mjx_study.objective import rollout_cost, spread
from mjx_study.reference import FunctionObjective, Reference, ScalarFunction, smoothed
from mjx_study.runtime import local_devices, precision
from mjx_study.simulation.contact import ContactModel
from mjx_study.tasks.task import Task

QUADRATURE: Final = 1500
"""Number of quadrature points under Gaussian noise; heavier tails get more."""
TAIL_PROBABILITY: Final = 1e-6
"""Probability of noise outside the grid, from each end of the line."""
CHUNK: Final = 256
"""Quadrature points per device and call."""


def compute_landscapes(plan: StudyPlan) -> Callable[..., dict[str, np.ndarray]]:
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

    def compute(cell: StudyCell, part: object = None) -> dict[str, np.ndarray]:
        task, objective = plan.groups[cell.group].task, objectives(cell)
        line = line_of(task, config.settings.points, config.span, config.direction, config.seed)
        chosen = estimators_of(plan, cell)
        keys, columns, solved = cell_keys(config.seed, config.batches), [], []
        for theta in line.thetas(task.theta.dtype):
            drawn, _, residuals = draw_batches(objective, theta, keys, oracles, cell.samples, slice(None))
            solved += residuals.values()
            pooled = jax.tree.map(lambda leaf: jnp.asarray(leaf).reshape(-1, *leaf.shape[2:]), drawn)
            columns.append(jax.device_get(_slopes(pooled, line.direction, chosen)))
        arrays = {name: np.stack([column[name] for column in columns], axis=-1) for name in columns[0]}
        arrays |= {
            "position": line.position,
            "unconverged": np.asarray(sum(unconverged(each, precision()) for each in solved)),
            "residual": np.max([np.max(np.nan_to_num(each, nan=np.inf), initial=0.0) for each in solved]),
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
    estimates = [estimator(batches) for estimator in chosen]
    slope, slope_se = map(jnp.stack, zip(*(_mean(each.per_sample @ direction) for each in estimates), strict=True))
    return {
        "slope": slope,
        "slope_se": slope_se,
        "nonfinite": jnp.stack([each.num_nonfinite for each in estimates]),
        "cost": jnp.mean(evaluation.baseline),
        "smoothed": smoothed,
        "smoothed_se": smoothed_se,
    }


def _mean(sample: Float[Array, " samples"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Mean and standard error."""
    finite = jnp.isfinite(sample)
    count = jnp.sum(finite)
    return jnp.mean(sample, where=finite), jnp.std(sample, where=finite, ddof=1) / jnp.sqrt(count)


@dataclasses.dataclass(frozen=True)
class Means:
    """Means at the points of a line, with error estimates.

    Attributes:
        smoothed: F.
        slope: F', the mean of an unbiased estimator.
        first: E[FoBG].
        slope_error, first_error: difference from the rule with every second point.
    """

    smoothed: Float[np.ndarray, " points"]
    slope: Float[np.ndarray, " points"]
    first: Float[np.ndarray, " points"]
    slope_error: Float[np.ndarray, " points"]
    first_error: Float[np.ndarray, " points"]


def closed_form(reference: Reference, position: Float[np.ndarray, " points"]) -> Means | None:
    """Means of a function of one parameter; None for any other reference."""
    if not isinstance(reference, FunctionObjective) or not isinstance(reference.function, ScalarFunction):
        return None
    points = [smoothed(reference.function, np.array([t]), reference.sigma, reference.noise) for t in position]
    value, slope, jump = np.array([(point.value, point.gradient[0], point.jump_term[0]) for point in points]).T
    return Means(value, slope, slope - jump, np.zeros_like(slope), np.zeros_like(slope))


def applies(task: Task) -> bool:
    """Whether a rollout depends on theta + w alone, a scalar: no feedback and no random start."""
    return task.policy.num_params == 1 and task.policy.additive and not task.random_start


class Line:
    """Cost and derivative of a task with one parameter, in one compiled program for all points and contact models.

    ValueError if quadrature does not apply to the task.
    """

    def __init__(self, task: Task):
        if not applies(task):
            raise ValueError(
                "quadrature is for a scalar parameter with the noise added to it and a fixed start; "
                f"{task.name} has {task.policy.num_params}"
                f"{'' if task.policy.additive else ', the noise on its controls'}"
                f"{', its starts drawn' if task.random_start else ''}"
            )
        self._task, self._dtype = task, task.theta.dtype

        def cost(theta, contact):
            start = task.draw_start(split_sample_key(jax.random.key(0))[0])
            noise = jnp.zeros(task.policy.noise_shape, task.theta.dtype)
            return rollout_cost(task, theta[None], contact, start, noise, task.onset)[0]

        batched = jax.vmap(jax.value_and_grad(cost), in_axes=(0, None))
        self._program = Compiled(lambda contact, thetas: batched(thetas, contact), "quadrature", task)

    def __call__(
        self, points: Float[np.ndarray, " points"], contact: ContactModel | None
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """Zero-noise cost and its derivative at each point."""
        devices = local_devices()
        return spread(self._program, (contact,), (points.astype(self._dtype),), CHUNK, devices)


def grid(low: float, high: float, sigma: float, size: int, noise: str) -> Float[np.ndarray, " size"]:
    """Midpoints of the cells of a uniform grid that covers the line and the noise around it: `size` cells for Gaussian
    noise; heavier tails get more cells of the same width."""
    needed, gaussian = (high - low + 2 * sigma * NOISES[name].reach(TAIL_PROBABILITY) for name in (noise, "gaussian"))
    cells = math.ceil(size * needed / gaussian)
    return (low + high - needed) / 2 + needed * (np.arange(cells) + 0.5) / cells


def means(
    points: Float[np.ndarray, " size"],
    values: Float[np.ndarray, " size"],
    slopes: Float[np.ndarray, " size"],
    position: Float[np.ndarray, " points"],
    sigma: float,
    noise: str,
) -> Means:
    """Compute means over the noise at each position, a value of theta, from f and f' at the grid points.

    ValueError if the grid is too coarse or does not cover the noise.
    """
    spacing, reach = points[1] - points[0], NOISES[noise].reach(TAIL_PROBABILITY)
    gap = 0.51 * spacing - reach * sigma
    if spacing > sigma / 8 or points[0] > position.min() + gap or points[-1] < position.max() - gap:
        raise ValueError(
            f"the grid must cover {reach:.2g} sigma to each side of the line, with a spacing of at most sigma / 8"
        )
    fine, coarse = (_means(points[::step], values[::step], slopes[::step], position, sigma, noise) for step in (1, 2))
    return Means(*fine, slope_error=np.abs(fine[1] - coarse[1]), first_error=np.abs(fine[2] - coarse[2]))


def _means(points, values, slopes, position, sigma, noise):
    density, spacing = NOISES[noise].density, points[1] - points[0]
    weight = density((points - position[:, None]) / sigma)
    total = weight.sum(axis=1, keepdims=True)
    edges = np.append(points - spacing / 2, points[-1] + spacing / 2)
    score_weight = -np.diff(density((edges - position[:, None]) / sigma), axis=1) / (total * spacing)
    return weight / total @ values, score_weight @ values, weight / total @ slopes
