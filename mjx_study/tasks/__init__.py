"""The systems of the study, one module each, all structured alike."""

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any, Final

from estimators.user_code import MissingModuleError
from mjx_study.choices import TASK_DESCRIPTIONS, is_file, unknown_task
from mjx_study.options.configuration import OPTIONS, as_arguments
from mjx_study.options.option import OptionError
from mjx_study.tasks.mjcf import mjcf_task
from mjx_study.tasks.task import Task
from mjx_study.tasks.user_task import build_user_task, registered_name


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
        return build_user_task(place, options)
    if ":" in name:
        try:
            return build_user_task(name, options)
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
