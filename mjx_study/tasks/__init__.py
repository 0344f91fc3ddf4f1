"""The systems of the study, each in a short file of the same parts in the same order."""

from collections.abc import Callable
from typing import Final

from mjx_study.task import Task
from mjx_study.tasks.pusher import pusher

TASKS: Final[dict[str, Callable[..., Task]]] = {"pusher": pusher}


def make_task(name: str, **options) -> Task:
    """Build a task by name; `options` go to its builder (`cone`, `horizon`, ...).

    Raises:
        ValueError: unknown name; the message lists the choices.
    """
    if name not in TASKS:
        raise ValueError(f"unknown task {name!r}; choose from {', '.join(TASKS)}")
    return TASKS[name](**options)


__all__ = ["TASKS", "make_task", "pusher"]
