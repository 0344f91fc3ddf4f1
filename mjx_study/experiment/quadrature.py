r"""Means under noise along a line of a scalar parameter, by quadrature or in closed form.

Without sampling, for a scalar parameter and a fixed start,

    F(theta) = E f(theta + w),   F'(theta) = E f(theta + w) psi'(w),   E[FoBG] = E f'(theta + w),

with w of density p = exp(-psi), on one fine uniform grid for all theta. f is treated as constant in each grid cell;
since psi' p = -p', the cell's weight in F' is p(left end) - p(right end), whatever kinks p has in between. The error is
of second order in the spacing for smooth f, and a spacing times the jump where f jumps; the difference from the rule
with every second point estimates it.
"""

import dataclasses
import math
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from estimators import NOISES
from estimators.noise import split_sample_key
from mjx_study.compiled import Compiled
from mjx_study.objective import rollout_cost, spread
from mjx_study.reference import FinalCost, ReferenceObjective, ScalarFunction, smoothed
from mjx_study.runtime import local_devices
from mjx_study.simulation.contact import ContactModel
from mjx_study.tasks.task import Task

QUADRATURE: Final = 1500
"""Number of quadrature points under Gaussian noise; heavier tails get more."""
TAIL_PROBABILITY: Final = 1e-6
"""Probability of noise outside the grid, from each end of the line."""
CHUNK: Final = 256
"""Quadrature points per device and call."""


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


def closed_form(reference: ReferenceObjective, position: Float[np.ndarray, " points"]) -> Means | None:
    """Means of a function of one parameter; None for any other reference."""
    system = reference.system
    if not isinstance(system, FinalCost) or not isinstance(system.function, ScalarFunction):
        return None
    points = [smoothed(system.function, np.array([t]), reference.sigma, reference.noise) for t in position]
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
