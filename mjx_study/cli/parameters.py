"""A policy's parameters on the command line: numbers, a file of them, or a policy that optimise wrote."""

import argparse
from pathlib import Path

from mjx_study.files import read_theta


def add_theta_option(command: argparse.ArgumentParser, purpose: str) -> None:
    """`--theta`; `theta_of` reads what it is given."""
    command.add_argument(
        "--theta",
        metavar="FILE|X[,X]",
        help=f"{purpose}: a policy that optimise wrote, a .json or .npy file, or the numbers (default: the task's)",
    )


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
