"""A policy's parameters on the command line: numbers, a file of them, or a policy that optimise wrote."""

import argparse
import json
from pathlib import Path

import numpy as np


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
        return _load(Path(options.theta), options.task)


def _load(path: Path, task: str) -> tuple[float, ...]:
    try:
        content = json.loads(path.read_text()) if path.suffix == ".json" else np.load(path, allow_pickle=False)
        theirs = content.get("task", task) if isinstance(content, dict) else task
        values = np.asarray(content["theta"] if isinstance(content, dict) else content, float)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, TypeError, EOFError, KeyError) as error:
        raise ValueError(f"{path} is neither a policy, nor a .json list of numbers, nor a .npy array") from error
    if theirs != task:
        raise ValueError(f"{path} is a policy of {theirs}, not of {task}")
    return tuple(values.reshape(-1).tolist())
