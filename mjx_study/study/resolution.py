"""Resolve a configuration for a task: estimators, recipe and parameters."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from estimators import Estimator, make_estimator
from mjx_study.study.configuration import StudyConfig
from mjx_study.tasks.task import Recipe, Task


def recipe_of(config: StudyConfig, task: Task) -> Recipe:
    """Return the settings of a task's descents: the configuration's, else those of the task's recipe.

    Raises:
        ValueError: a setting is missing.
    """
    given = {name: getattr(config, name) for name in ("iterations", "learning_rate", "decay")}
    given |= {"samples": None if config.samples is None else max(config.samples)}
    if (recipe := task.defaults.recipe) is not None:
        return dataclasses.replace(recipe, **{name: value for name, value in given.items() if value is not None})
    given["decay"] = given["decay"] or 0.0
    if missing := [name.replace("_", " ") for name, value in given.items() if value is None]:
        raise ValueError(f"{task.name} has no recipe: give {', '.join(missing)}")
    return Recipe(**given)


def at_theta(task: Task, theta: Sequence[float] | None) -> Task:
    """Return the task with other parameters; unchanged for None.

    Raises:
        ValueError: their number differs from the policy's, or one is nonfinite.
    """
    if theta is None:
        return task
    values = np.asarray(theta, float)
    if values.shape != (task.policy.num_params,) or not np.all(np.isfinite(values)):
        raise ValueError(
            f"theta has {values.size} numbers; {task.name} needs {task.policy.num_params}, all of them finite"
        )
    return task.replace(theta=jnp.asarray(values, task.theta.dtype))


def configured_estimators(config: StudyConfig, task: Task) -> tuple[Estimator, ...]:
    """Build a configuration's estimators with their options, and check them against the task.

    Raises:
        ValueError: there is no such estimator, an option is out of range or missing, an estimator does not support the
            task, or published constants are requested where there are none or along with others.
    """
    options = {name: getattr(config, name) for name in ("baseline", "max_norm", "window", "tolerance", "weights")}
    options |= bound_constants(config, task) | {"sigma": task.sigma}
    found = tuple(make_estimator(name, **options) for name in config.estimators)
    check_estimators(found, task)
    return found


def bound_constants(config: StudyConfig, task: Task) -> dict[str, Any]:
    """Return the constants of AoBG's bound, from the configuration or the published example.

    Raises:
        ValueError: published constants are requested where there are none, or along with others.
    """
    names = ("gamma", "failure_probability", "variance_proxy", "radius")
    given = {name: getattr(config, name) for name in names}
    if not config.published:
        return given | {"gamma": task.defaults.gamma if config.gamma is None else config.gamma}
    if task.defaults.published is None:
        raise ValueError(f"{task.name} has no published constants of the bound; omit published")
    defaults = {field.name: field.default for field in dataclasses.fields(StudyConfig)}
    if others := [name for name in names if given[name] != defaults[name]]:
        raise ValueError(f"published sets {', '.join(names)}: omit {', '.join(others)}")
    return dataclasses.asdict(task.defaults.published)


def check_estimators(estimators: Iterable[Estimator], task: Task) -> None:
    """Reject estimators whose formula does not hold for a task.

    Raises:
        ValueError: the formula needs Gaussian noise, noise on theta or no onset term, and the task differs.
    """
    for estimator in estimators:
        if estimator.gaussian and task.noise != "gaussian":
            raise ValueError(f"{estimator.name!r} holds for Gaussian noise only; the noise is {task.noise}")
        if estimator.additive and not task.policy.additive:
            raise ValueError(
                f"{estimator.name!r} needs noise that is added to theta itself; {task.name} has a feedback policy"
            )
        if task.onset != "none" and "linearisation" in estimator.needs:
            raise ValueError(
                f"{estimator.name!r} needs the derivatives of single steps, which have no onset term; omit onset"
            )
