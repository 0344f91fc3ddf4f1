"""The task that options describe, and its policy's parameters: numbers, a file of them, or a policy of optimise."""

import argparse
from pathlib import Path

from mjx_study.cli.options import scene_options
from mjx_study.files import read_theta
from mjx_study.tasks import make_task
from mjx_study.tasks.task import Task


def task_of(options: argparse.Namespace) -> Task:
    task = make_task(options.task, **scene_options(options, "cone", "horizon", "model"))
    return task if options.sigma is None else task.replace(sigma=options.sigma)


def theta_of(options: argparse.Namespace) -> tuple[float, ...] | None:
    """The parameters that `--theta` gives; None where it is not given.

    Raises:
        ValueError: the file cannot be read, is of another kind, or is a policy of another task.
    """
    if options.theta is None:
        return None
    try:
        return tuple(float(part) for part in options.theta.split(","))
    except ValueError:
        path = Path(options.theta)
    theta, task = read_theta(path)
    if task not in (None, options.task):
        raise ValueError(f"{path} is a policy of {task}, not of {options.task}")
    return theta
