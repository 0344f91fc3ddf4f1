"""Resolve a configuration for a task: estimators, recipe, parameters, and the line of a landscape; and reject options
that nothing reads."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators import ESTIMATORS, ORACLES, Estimator, find_estimator, make_estimator
from estimators.registry import label_of
from mjx_study.choices import REFERENCE, takes_stiffness
from mjx_study.options.configuration import ESTIMATOR_OPTIONS, SCENE_OPTIONS, StudyConfig
from mjx_study.options.option import OptionError, check_span, reject_unused
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Recipe, Task

BOUND: Final = ("gamma", "failure_probability", "variance_proxy", "radius")
"""Constants of AoBG's bound."""
CORRECTED: Final = "corrected"
"""Oracle with an onset term, linear unless `onset` asks for another."""
FIRST_ORDER: Final = (
    "has no effect: it changes first-order gradients through simulated contact, and there are none here"
)
SPAN_SIGMAS: Final = 10.0
"""Half the default length of a line through many parameters, in standard deviations of the noise."""


def recipe_of(config: StudyConfig, task: Task) -> Recipe:
    """The settings of a task's descents: the configuration's, else those of the task's recipe; OptionError if one is
    missing."""
    given = {name: getattr(config, name) for name in ("iterations", "learning_rate", "decay", "optimizer")}
    given |= {"samples": None if config.samples is None else max(config.samples)}
    if (recipe := task.defaults.recipe) is not None:
        return dataclasses.replace(recipe, **{name: value for name, value in given.items() if value is not None})
    given |= {"decay": given["decay"] or 0.0, "optimizer": given["optimizer"] or "sgd"}
    if missing := [name for name, value in given.items() if value is None]:
        first, *others = missing
        more = f", with {' and '.join('{}' for _ in others)}" if others else ""
        hint = "; `mjx-study init` writes a task with a goal and one" if task.defaults.families == ("mjcf",) else ""
        raise OptionError(first, f"must be given{more}: {task.name} has no recipe{hint}", *others)
    return Recipe(**given)


def at_theta(task: Task, theta: Sequence[float] | None) -> Task:
    """The task with other parameters, unchanged for None; OptionError unless they are as many as the policy's, and
    finite."""
    if theta is None:
        return task
    values = np.asarray(theta, float)
    if values.shape != (task.policy.num_params,) or not np.all(np.isfinite(values)):
        needed = f"{task.name} needs {task.policy.num_params}, all of them finite"
        raise OptionError("theta", f"has {values.size} numbers; {needed}")
    return task.replace(theta=jnp.asarray(values, task.theta.dtype))


def configured_estimators(config: StudyConfig, task: Task) -> tuple[Estimator, ...]:
    """Build a configuration's estimators with their options, except those that it holds, and check them against the
    task; ValueError as for `make_estimators`."""
    options = {name: getattr(config, name) for name in ESTIMATOR_OPTIONS} | bound_constants(config, task)
    found = make_estimators(config.estimators, options, task)
    for estimator in found:
        if getattr(estimator, "sigma", task.sigma) != task.sigma:
            raise ValueError(f"{estimator.name!r} holds for another sigma than {task.sigma:g}")
    return found


def make_estimators(chosen: Iterable[str | Estimator], options: Mapping[str, Any], task: Task) -> tuple[Estimator, ...]:
    """Build estimators with the options that they have, and the task's sigma.

    Raises:
        OptionError: an option of an estimator of this package is missing.
        ValueError: there is no such estimator, or it does not support the task.
    """
    given = {**options, "sigma": task.sigma}
    for estimator in map(find_estimator, chosen):
        for name in estimator.required() if isinstance(estimator, type) else ():
            if name in options and options[name] is None:
                raise OptionError(name, f"must be given: {estimator.name!r} needs it")
    found = tuple(each if isinstance(each, Estimator) else make_estimator(each, **given) for each in chosen)
    check_estimators(found, task)
    return found


def bound_constants(config: StudyConfig, task: Task) -> dict[str, Any]:
    """The constants of AoBG's bound, from the configuration or the published example; OptionError if there is none, or
    other constants are given along with it."""
    given = {name: getattr(config, name) for name in BOUND}
    if not config.published:
        return given | {"gamma": task.defaults.gamma if config.gamma is None else config.gamma}
    if task.defaults.published is None:
        raise OptionError("published", f"has no effect on {task.name}, which has no published constants: omit it")
    if others := [name for name in BOUND if config.given(name)]:
        raise OptionError("published", f"sets them as well: omit {', '.join(['{}'] * len(others))}", *others)
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
            needed = f"which {estimator.name!r} needs"
            raise OptionError("onset", f"has no effect on the derivatives of single steps, {needed}: omit one of them")


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
    """Return the line through a task's theta; for a scalar parameter, its range, independent of theta.

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
        raise OptionError("direction", f"must be random or a parameter's index, 0 to {params - 1}; got {direction}")
    return np.eye(params)[int(direction)]


def reject_unread(chosen: Sequence[str | Estimator], given: Iterable[str]) -> None:
    """Raise OptionError for an estimators' option that none of the chosen ones reads; objects read none."""
    found = [find_estimator(each) for each in chosen]
    read = {name for each in found if isinstance(each, type) for name in _fields(each)}
    names = ", ".join(each.name for each in found)
    for option in given:
        name = "gamma" if option == "published" else option
        able = ", ".join(each for each in ESTIMATORS if name in _fields(ESTIMATORS[each]))
        reason = f"has no effect on {names}: omit it, or choose an estimator that it acts on: {able}"
        reject_unused([option], ([option], name in read, reason))


def reads_onset(chosen: Iterable[str | Estimator], onset: str = "shift") -> bool:
    """Whether an onset term changes any of the estimators; those named for it have the linear one anyway."""
    needed = {oracle for each in map(find_estimator, chosen) for oracle in each.needs if ORACLES[oracle].order}
    return bool(needed - {CORRECTED} if onset == "linear" else needed)


def reject_unused_options(
    config: StudyConfig,
    given: Sequence[str],
    grids: Sequence[tuple[Task, Sequence[ContactPoint]]],
    *,
    first_order: bool = False,
) -> None:
    """Raise OptionError for an option that was given and has no effect in any cell, and ValueError for an onset
    estimator without one; `first_order` says whether cells have means of first-order gradients with any estimators."""
    reject_unread(config.estimators, [name for name in (*ESTIMATOR_OPTIONS, "published") if name in given])
    simulated = [task for task, models in grids if not all(each.analytic for each in models)]
    touching = any(task.scene.has_constraints for task in simulated)
    families = {
        family
        for task, _ in grids
        for family in (task.defaults.families if config.contact is None else config.contact)
        if family != REFERENCE or task.contact_pair is not None
    }
    rigid = "has no effect: no contact model takes one; add a family that does, such as mujoco"
    if not any(task.contact_pair for task, _ in grids):
        lacking = "names no contact whose stiffness could be set (docs/extending.md: contact_pair)"
        rigid = f"has no effect: {grids[0][0].name} {lacking}"
    surrogates = set(config.backward) - {"none"}
    reject_unused(
        given,
        (["stiffness"], takes_stiffness(families), rigid),
        (["damping"], takes_stiffness(families - {REFERENCE}), rigid),
        (["cone"], touching, "has no effect: nothing that is simulated has contact"),
        (
            ["onset"],
            touching and (first_order or reads_onset(config.estimators, config.onset)),
            f"{FIRST_ORDER}{' (estimators named _onset have a term anyway)' if touching else ''}",
        ),
        (["backward"], touching and (first_order or reads_onset(config.estimators)), FIRST_ORDER),
        (["backward_stiffness"], takes_stiffness(surrogates), "has no effect: no surrogate family takes one"),
        (SCENE_OPTIONS, bool(simulated), "has no effect: nothing is simulated"),
    )
    known = dict[str, str]()
    for each in map(find_estimator, config.estimators):
        if CORRECTED in each.needs and not touching:
            raise ValueError(f"{each.name} corrects gradients through contact, and nothing simulated has any: omit it")
        label = label_of(each.name, config.onset) if config.onset != "none" and each.name in ESTIMATORS else each.name
        if (other := known.setdefault(label, each.name)) != each.name:
            raise OptionError("onset", f"makes {other} and {each.name} the same: omit one of the three")


def _fields(estimator: type[Estimator]) -> set[str]:
    return {field.name for field in dataclasses.fields(estimator)}
