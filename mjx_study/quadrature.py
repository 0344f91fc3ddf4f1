r"""Means over the noise of a decision of one number, without sampling.

    F(theta) = E f(theta + w),   F'(theta) = E f(theta + w) w / sigma^2,   E[FoBG] = E f'(theta + w),

with w ~ N(0, sigma^2), by the midpoint rule on one fine grid that serves every theta: exact to rounding for smooth f,
and to a grid spacing times the jump where f jumps. The rule on every second point tells how far that is.
"""

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Float

from mjx_study.contact import ContactModel
from mjx_study.noise import split_sample_key
from mjx_study.objective import rollout_cost
from mjx_study.task import Task

REACH: Final = 5.0
"""Standard deviations beyond the line's ends that the grid covers; the density beyond is below 2e-6 of its peak."""
CHUNK: Final = 256
"""Points per device and call."""


@dataclasses.dataclass(frozen=True)
class Means:
    """Means at the points of a line, and how far they may be off.

    Attributes:
        smoothed: F.
        slope: F', what an unbiased estimate has as its mean.
        first: E[FoBG].
        slope_error, first_error: difference to the rule with every second point.
    """

    smoothed: Float[np.ndarray, " points"]
    slope: Float[np.ndarray, " points"]
    first: Float[np.ndarray, " points"]
    slope_error: Float[np.ndarray, " points"]
    first_error: Float[np.ndarray, " points"]


class Line:
    """Cost and derivative of a task with one parameter, as one compiled program of points and contact model."""

    def __init__(self, task: Task):
        if task.policy.num_params != 1 or not task.policy.additive:
            raise ValueError(f"quadrature is for a decision of one number; {task.name} has {task.policy.num_params}")
        self.devices = jax.local_devices()
        shape, dtype = task.policy.noise_shape, task.theta.dtype

        def cost(theta, contact):
            start = task.draw_start(split_sample_key(jax.random.key(0))[0])
            return rollout_cost(task, theta[None], contact, start, jnp.zeros(shape, dtype))[0]

        batched = jax.vmap(jax.value_and_grad(cost), in_axes=(0, None))
        mesh, split = Mesh(np.array(self.devices), ("points",)), PartitionSpec("points")
        specs: dict[str, Any] = {"mesh": mesh, "in_specs": (split, PartitionSpec()), "out_specs": split}
        self._program = jax.jit(jax.shard_map(batched, **specs, check_vma=False))
        self._dtype = dtype

    def __call__(
        self, points: Float[np.ndarray, " points"], contact: ContactModel | None
    ) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """Cost without noise and its derivative at each point."""
        capacity = CHUNK * len(self.devices)
        rows = np.minimum(np.arange(-(-len(points) // capacity) * capacity), len(points) - 1)
        parts = [self._program(points[part].astype(self._dtype), contact) for part in rows.reshape(-1, capacity)]
        values, slopes = (np.concatenate(leaves)[: len(points)] for leaves in zip(*jax.device_get(parts), strict=True))
        return values, slopes


def grid(low: float, high: float, sigma: float, size: int) -> Float[np.ndarray, " size"]:
    """Midpoints of a uniform grid that covers the line and the noise about it."""
    width = high - low + 2 * REACH * sigma
    return low - REACH * sigma + width * (np.arange(size) + 0.5) / size


def means(
    points: Float[np.ndarray, " size"],
    values: Float[np.ndarray, " size"],
    slopes: Float[np.ndarray, " size"],
    position: Float[np.ndarray, " points"],
    sigma: float,
) -> Means:
    """Means over Gaussian noise at each position.

    Args:
        points: a uniform grid.
        values, slopes: f and f' on it.
        position: theta's.
        sigma: standard deviation of the noise.

    Raises:
        ValueError: the grid is too coarse, or it does not cover the noise.
    """
    covered = points[0] <= position.min() - 4 * sigma and points[-1] >= position.max() + 4 * sigma
    if points[1] - points[0] > sigma / 8 or not covered:
        raise ValueError("the grid must cover 4 sigma to each side of the line, with a spacing of at most sigma / 8")
    fine, coarse = (_means(points[::step], values[::step], slopes[::step], position, sigma) for step in (1, 2))
    return Means(*fine, slope_error=np.abs(fine[1] - coarse[1]), first_error=np.abs(fine[2] - coarse[2]))


def _means(points, values, slopes, position, sigma):
    noise = (points - position[:, None]) / sigma
    weight = np.exp(-(noise**2) / 2)
    weight /= weight.sum(axis=1, keepdims=True)
    return weight @ values, (weight * noise) @ values / sigma, weight @ slopes
