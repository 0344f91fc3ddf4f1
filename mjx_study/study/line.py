"""The line through theta along which a landscape is computed."""

import dataclasses
from collections.abc import Sequence
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_study.study.configuration import check_span
from mjx_study.tasks.task import Task

SPAN_SIGMAS: Final = 10.0
"""Half the default length of a line through many parameters, in standard deviations of the noise."""


@dataclasses.dataclass(frozen=True)
class ThetaLine:
    """Points theta_0 + t direction.

    Attributes:
        position: t, in the unit of theta.
        direction: unit vector, (params,).
    """

    position: Float[np.ndarray, " points"]
    direction: Float[np.ndarray, " params"]
    thetas: tuple[Float[Array, " params"], ...]


def line_of(task: Task, points: int, span: Sequence[float] | None, direction: str | None, seed: int) -> ThetaLine:
    """Return the line through a task's theta; for a scalar parameter, its range, whatever theta is.

    Args:
        span: first and last t; None for the task's, or 10 sigma to either side.
        direction: "random" or None, or the index of one parameter.
        seed: random seed of a random direction.

    Raises:
        ValueError: the span or the direction is invalid.
    """
    theta = np.asarray(task.theta, float)
    along = direction_of(direction or "random", len(theta), seed)
    low, high = span or task.defaults.span or (-SPAN_SIGMAS * task.sigma, SPAN_SIGMAS * task.sigma)
    check_span((low, high))
    position = np.linspace(low, high, points)
    origin = np.zeros(1) if len(theta) == 1 else theta
    return ThetaLine(position, along, tuple(jnp.asarray(origin + t * along, task.theta.dtype) for t in position))


def direction_of(direction: str, params: int, seed: int) -> Float[np.ndarray, " params"]:
    """Return a unit vector, random or along one parameter; arguments as for `line_of`."""
    if params == 1:
        return np.ones(1)
    if direction == "random":
        drawn = np.random.default_rng(seed).normal(size=params)
        return drawn / np.linalg.norm(drawn)
    if not direction.isdecimal() or int(direction) >= params:
        raise ValueError(f"direction must be random or a parameter's index, 0 to {params - 1}; got {direction}")
    return np.eye(params)[int(direction)]
