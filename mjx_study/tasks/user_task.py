"""User-defined tasks: `module:name` in an importable module, or registered by an installed package."""

import inspect
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any

from estimators.user_code import describe_error, find_attribute, importable_here
from estimators.user_inputs import observing
from mjx_study.choices import TASK_GROUP
from mjx_study.tasks.task import Task, check_shapes


def registered_name(name: str) -> str | None:
    """The `module:name` of a registered task, or None; a ValueError if packages register different ones so named."""
    places = {f"{point.module}:{point.attr}" for point in metadata.entry_points(group=TASK_GROUP, name=name)}
    if len(places) > 1:
        raise ValueError(f"task {name!r} is registered more than once; choose from {', '.join(sorted(places))}")
    return next(iter(places), None)


def build_user_task(place: str, options: dict[str, Any]) -> Task:
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
                f"{place} is a ready-made Task, which {_listed(options)} cannot change: "
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
        parameters = inspect.signature(builder).parameters.values()
    except (TypeError, ValueError):  # some non-Python functions have no signature
        return
    named = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    by_keyword = {p.name for p in named if p.kind is not p.POSITIONAL_ONLY}
    refused = [name for name in options if name not in by_keyword]
    if refused and not any(p.kind is p.VAR_KEYWORD for p in parameters):
        raise ValueError(f"{place} does not take {_listed(refused)}: give it an argument of this name, or **options")
    missing = [p.name for p in named if p.default is p.empty and p.name not in by_keyword & options.keys()]
    if missing:
        raise ValueError(f"{place} needs {_listed(missing)}, which is not given: give it a default")


def _listed(names: Sequence[str] | dict[str, Any]) -> str:
    return " and ".join(names)
