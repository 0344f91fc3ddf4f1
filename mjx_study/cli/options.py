"""From parsed options to what computes: the task, its parameters, fields of a study, and the process."""

import argparse
import re
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_study.choices import PRECISIONS
from mjx_study.cli.output import complain
from mjx_study.options.configuration import OPTIONS
from mjx_study.options.option import OptionError, flag_of
from mjx_study.options.parser import TASK_OPTIONS, UsageError

if TYPE_CHECKING:
    import mjx_study.tasks.task


@contextmanager
def usage_errors() -> Generator[None]:
    """Turn errors that users can cause into UsageErrors, with options spelled as flags; for checks only, never for
    computing."""
    try:
        yield
    except OptionError as error:
        raise UsageError(error.spelled(flag_of)) from error
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error


def refuse_unusable(given: Sequence[str]) -> None:
    """Raise UsageError for an option whose value is --, which argparse drops, and for characters that no file's name
    may have."""
    for text in given:
        if "\0" in text or re.search("[\ud800-\udc7f\udd00-\udfff]", text):
            raise UsageError(f"no argument may hold null or surrogate characters, got {text!r}")
        if text.startswith("-") and text.endswith("=--"):
            raise UsageError(f"{text.removesuffix('=--')} needs a value, got --")


def given_options(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of the named options that the command has and that were given."""
    found = {name: getattr(options, name, None) for name in names}
    return {name: value for name, value in found.items() if value is not None and value is not False}


def study_fields(options: argparse.Namespace) -> dict[str, Any]:
    fields = given_options(options, *OPTIONS)
    if "theta" in fields:
        fields["theta"], _ = theta_and_policy(options)
    if hasattr(options, "task"):
        fields["tasks"] = options.task
    single = {name for name in fields if OPTIONS[name].many and not isinstance(fields[name], tuple)}
    return {name: (value,) if name in single else value for name, value in fields.items()}


def task_of(options: argparse.Namespace) -> "mjx_study.tasks.task.Task":
    """Build the task with the options for its builder, and sigma."""
    from mjx_study.tasks import task_with_options

    task = task_with_options(options.task, given_options(options, *TASK_OPTIONS))
    return task if options.sigma is None else task.replace(sigma=options.sigma)


def task_at_theta(options: argparse.Namespace) -> "mjx_study.tasks.task.Task":
    """`task_of`, with the parameters given by `--theta`."""
    from mjx_study.experiment.resolution import at_theta

    task = task_of(options)
    return at_theta(task, theta_and_policy(options)[0])


def theta_and_policy(options: argparse.Namespace) -> tuple[tuple[float, ...] | None, dict[str, Any]]:
    """Return the parameters given by `--theta`, and what `read_theta` finds with them in a policy's file, which must be
    for the task."""
    from mjx_study.options.files import read_theta

    if options.theta is None:
        return None, {}
    try:
        [float(part) for part in options.theta.split(",")]
    except ValueError:
        theta, policy = read_theta(Path(options.theta))
    else:
        return OPTIONS["theta"].parse(options.theta), {}
    if policy.get("task", options.task) != options.task:
        raise ValueError(f"{options.theta} is a policy of {policy['task']}, not of {options.task}")
    return theta, policy


def configure_process(options: argparse.Namespace) -> None:
    """Set up JAX from the options, and watch its computation; commands without them get float64 and one device."""
    from mjx_study.watchdog import watch

    configure(precision=getattr(options, "precision", PRECISIONS[0]), cpu_devices=getattr(options, "devices", 1))
    watch(lambda line: complain(f"mjx-study: {line}"))


def configure(**settings: Any) -> None:
    """Call `mjx_study.runtime.configure`; ValueError if JAX has no device, for instance by JAX_PLATFORMS."""
    import jax

    from mjx_study.runtime import configure

    try:
        configure(**settings)
        jax.local_devices()
    except RuntimeError as error:
        raise ValueError(f"JAX has no device to compute on: {error}") from error
