"""The task described by the options, and its parameters: numbers, a file, or a policy written by optimise."""

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
    """Return the parameters given by `--theta`; None if it is not given.

    Raises:
        ValueError: the file cannot be read, is of another kind, or is a policy for another task.
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
