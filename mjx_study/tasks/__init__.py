"""The systems of the study, one module each, all structured alike; and tasks of the user's own."""

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module, metadata
from typing import Any, Final

from estimators.user_code import MissingModuleError, describe_error, find_attribute, importable_here
from estimators.user_inputs import observing
from mjx_study.choices import TASK_DESCRIPTIONS, TASK_GROUP, is_file, unknown_task
from mjx_study.options.configuration import OPTIONS, as_arguments
from mjx_study.options.option import OptionError
from mjx_study.tasks.mjcf import mjcf_task
from mjx_study.tasks.task import Task, check_shapes


def _builder(name: str) -> Callable[..., Task]:
    """The function named after its module; the part of the name after a colon is its first argument."""
    system, _, variant = name.partition(":")
    builder = getattr(import_module(f"mjx_study.tasks.{system}"), system)
    return partial(builder, variant) if variant else builder


TASKS: Final[dict[str, Callable[..., Task]]] = {name: _builder(name) for name in TASK_DESCRIPTIONS}
"""Task builders by name; variants of a system have their own names, such as `ball_wall:dome`."""


def make_task(name: str, **options: Any) -> Task:
    """Build a task by name with `options` for its builder (`cone`, `horizon`, ...).

    Args:
        name: name of a built-in task, or of one registered by an installed package (entry point group
            `mjx_study.tasks`), or `module:attribute` of a Task or of a function of the options that returns one; or the
            path of an MJCF, from which `mjx_study.tasks.mjcf.scene_task` makes a task.
        **options: arguments for the builder; a ready-made Task takes none.

    Raises:
        ValueError: unknown name; the message lists the choices. Or a user's task cannot be built: its module or
            function is missing, raises, rejects an option, or does not return a Task.
    """
    if name in TASKS:
        return TASKS[name](**options)
    if is_file(name):
        if "model" in options:
            raise OptionError("model", f"replaces the MJCF of a task, but {name} is a file already")
        return mjcf_task(name, **options)
    if (place := registered_name(name)) is not None:
        return _build_user_task(place, options)
    if ":" in name:
        try:
            return _build_user_task(name, options)
        except MissingModuleError as error:
            raise ValueError(unknown_task(name, f" ({error})")) from None
    raise ValueError(unknown_task(name))


def task_with_options(name: str, options: Mapping[str, Any]) -> Task:
    """Build a task with options that are not None; with a timestep but no horizon, rollouts keep their duration."""
    given = as_arguments(options)
    if "timestep" in given and "horizon" not in given:
        own = make_task(name, **{key: value for key, value in given.items() if key != "timestep"})
        steps = own.horizon * own.scene.timestep / given["timestep"]
        given["horizon"] = OPTIONS["horizon"].check(max(1, round(min(steps, 1e15))))
    return make_task(name, **given)


def registered_name(name: str) -> str | None:
    """The `module:name` of a registered task, or None; a ValueError if packages register different ones so named."""
    places = {f"{point.module}:{point.attr}" for point in metadata.entry_points(group=TASK_GROUP, name=name)}
    if len(places) > 1:
        raise ValueError(f"task {name!r} is registered more than once; choose from {', '.join(sorted(places))}")
    return next(iter(places), None)


def _build_user_task(place: str, options: dict[str, Any]) -> Task:
    """Return the task at a place: a Task, or the result of a function of the options.

    The current directory counts as importable, in the console script too.

    Raises:
        MissingModuleError: there is no such module.
        ValueError: the module raises, has neither a Task nor a function of these options that returns one, or the
            Task's parts do not fit together.
    """
    with importable_here():
        found = find_attribute(place, "task", Task)
        if isinstance(found, Task) and options:
            raise ValueError(
                f"{place} is a ready-made Task, which {' and '.join(options)} cannot change: "
                "give a function that takes this and returns the Task"
            )
        with observing(place.partition(":")[0]):
            task = found if isinstance(found, Task) else _build(place, found, options)
            check_shapes(task, place)
    return task


def _build(place: str, builder: object, options: dict[str, Any]) -> Task:
    if not callable(builder) or inspect.isbuiltin(builder):  # never call sys.exit or os.abort
        raise ValueError(
            f"{place} is neither a Task nor a function that returns one, but of type {type(builder).__name__}"
        )
    _check_arguments(place, builder, options)
    try:
        task = builder(**options)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{place} raised {describe_error(error)}") from error
    if not isinstance(task, Task):
        raise ValueError(f"{place} returned an object of type {type(task).__name__} instead of a Task")
    return task


def _check_arguments(place: str, builder: Callable[..., object], options: dict[str, Any]) -> None:
    try:
        signature = inspect.signature(builder)
    except (TypeError, ValueError):  # some non-Python functions have no signature
        return
    try:
        signature.bind(**options)
    except TypeError as error:
        both = {"timestep", "horizon"} <= options.keys()
        reason = "a timestep comes with the horizon that keeps the duration of rollouts; " if both else ""
        raise ValueError(
            f"{place} does not take the options given ({error}): {reason}give it an argument for each, and others a "
            "default"
        ) from None
