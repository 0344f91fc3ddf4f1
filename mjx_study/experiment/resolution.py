"""Resolve a configuration for a task: estimators, recipe, parameters, and the line of a landscape."""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators import Estimator, make_estimator
from mjx_study.options.configuration import StudyConfig, check_span
from mjx_study.tasks.task import Recipe, Task

BOUND: Final = ("gamma", "failure_probability", "variance_proxy", "radius")
"""Constants of AoBG's bound."""
OF_ESTIMATORS: Final = ("baseline", "max_norm", "window", "tolerance", "weights", *BOUND)
"""Options of a configuration that estimators own."""
SPAN_SIGMAS: Final = 10.0
"""Half the default length of a line through many parameters, in standard deviations of the noise."""


def recipe_of(config: StudyConfig, task: Task) -> Recipe:
    """The settings of a task's descents: the configuration's, else those of the task's recipe; ValueError if one is
    missing."""
    given = {name: getattr(config, name) for name in ("iterations", "learning_rate", "decay")}
    given |= {"samples": None if config.samples is None else max(config.samples)}
    if (recipe := task.defaults.recipe) is not None:
        return dataclasses.replace(recipe, **{name: value for name, value in given.items() if value is not None})
    given["decay"] = given["decay"] or 0.0
    if missing := [f"`{name}`" for name, value in given.items() if value is None]:
        raise ValueError(f"{task.name} has no recipe: give {', '.join(missing)}")
    return Recipe(**given)


def at_theta(task: Task, theta: Sequence[float] | None) -> Task:
    """The task with other parameters, unchanged for None; ValueError for another number than the policy's, or a
    nonfinite one."""
    if theta is None:
        return task
    values = np.asarray(theta, float)
    if values.shape != (task.policy.num_params,) or not np.all(np.isfinite(values)):
        raise ValueError(
            f"theta has {values.size} numbers; {task.name} needs {task.policy.num_params}, all of them finite"
        )
    return task.replace(theta=jnp.asarray(values, task.theta.dtype))


def configured_estimators(config: StudyConfig, task: Task) -> tuple[Estimator, ...]:
    """Build a configuration's estimators with their options, except those that it holds, and check them against the
    task.

    ValueError if there is no such estimator, an option is out of range or missing, or an estimator does not support the
    task.
    """
    options = {name: getattr(config, name) for name in OF_ESTIMATORS}
    options |= bound_constants(config, task) | {"sigma": task.sigma}
    found = tuple(
        each if isinstance(each, Estimator) else make_estimator(each, **options) for each in config.estimators
    )
    for estimator in found:
        if getattr(estimator, "sigma", task.sigma) != task.sigma:
            raise ValueError(f"{estimator.name!r} holds for another sigma than {task.sigma:g}")
    check_estimators(found, task)
    return found


def bound_constants(config: StudyConfig, task: Task) -> dict[str, Any]:
    """The constants of AoBG's bound, from the configuration or the published example; ValueError if there is none, or
    other constants are given along with it."""
    given = {name: getattr(config, name) for name in BOUND}
    if not config.published:
        return given | {"gamma": task.defaults.gamma if config.gamma is None else config.gamma}
    if task.defaults.published is None:
        raise ValueError(f"{task.name} has no published constants of the bound; omit `published`")
    if others := [f"`{name}`" for name in BOUND if config.given(name)]:
        raise ValueError(f"`published` sets {', '.join(f'`{name}`' for name in BOUND)}: omit {', '.join(others)}")
    return dataclasses.asdict(task.defaults.published)


def check_estimators(estimators: Iterable[Estimator], task: Task) -> None:
    """Raise ValueError for an estimator that needs Gaussian noise, noise on theta or no onset term, where the task
    differs."""
    for estimator in estimators:
        if estimator.gaussian and task.noise != "gaussian":
            raise ValueError(f"{estimator.name!r} holds for Gaussian noise only; the noise is {task.noise}")
        if estimator.additive and not task.policy.additive:
            raise ValueError(
                f"{estimator.name!r} needs noise that is added to theta itself; {task.name} has a feedback policy"
            )
        if task.onset != "none" and "linearisation" in estimator.needs:
            raise ValueError(
                f"{estimator.name!r} needs the derivatives of single steps, which have no onset term; omit `onset`"
            )


@dataclasses.dataclass(frozen=True)
class ThetaLine:
    """Points origin + t direction, with t in the unit of theta and a unit vector."""

    position: Float[np.ndarray, " points"]
    direction: Float[np.ndarray, " params"]
    origin: Float[np.ndarray, " params"]

    def thetas(self, dtype: Any) -> Iterator[Float[Array, " params"]]:
        """Each point, made when it is needed: all of them may not fit into memory."""
        return (jnp.asarray(self.origin + t * self.direction, dtype) for t in self.position)


def line_of(task: Task, points: int, span: Sequence[float] | None, direction: str | None, seed: int) -> ThetaLine:
    """Return the line through a task's theta; for a scalar parameter, its range, whatever theta is.

    Args:
        span: first and last t; None for the task's, or `SPAN_SIGMAS` to either side.
        direction: "random" (by the seed) or None, or the index of one parameter.
    """
    theta = np.asarray(task.theta, float)
    along = direction_of(direction or "random", len(theta), seed)
    low, high = span or task.defaults.span or (-SPAN_SIGMAS * task.sigma, SPAN_SIGMAS * task.sigma)
    check_span((low, high))
    position = np.linspace(low, high, points)
    origin = np.zeros(1) if len(theta) == 1 else theta
    return ThetaLine(position, along, origin)


def direction_of(direction: str, params: int, seed: int) -> Float[np.ndarray, " params"]:
    """Return a unit vector, random or along one parameter; arguments as for `line_of`."""
    if direction == "random":
        drawn = np.random.default_rng(seed).normal(size=params)
        return drawn / np.linalg.norm(drawn) if params > 1 else np.ones(1)
    if not direction.isdecimal() or int(direction) >= params:
        raise ValueError(f"`direction` must be random or a parameter's index, 0 to {params - 1}; got {direction}")
    return np.eye(params)[int(direction)]
