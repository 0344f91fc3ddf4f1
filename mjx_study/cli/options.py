"""Shared by the commands: options and their checks, one-line errors, and clean interruption."""

import argparse
import dataclasses
import itertools
import json
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, NoReturn

from mjx_study.choices import FAMILIES, PRECISIONS, TASK_DESCRIPTIONS, suggestion, unknown, unknown_task
from mjx_study.cli.progress import show_cursor, shown_progress
from mjx_study.option import OPTIONS, Checked, Option
from mjx_study.study.configuration import Progress

INTERRUPTED = "nothing was written"
"""Default continuation of "interrupted; ..."."""
ENDINGS: Final = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}
"""Signals that end a command with one line and exit code 128 + the signal's number."""


class UsageError(ValueError):
    """Invalid option or file, reported in one line with exit code 2."""


class Parser(argparse.ArgumentParser):
    """Argument parser that raises UsageError, with suggestions for misspelt names."""

    def error(self, message: str) -> NoReturn:
        message = re.sub(r"^argument (?!-)\S+: ", "", message)
        raise UsageError(f"{message}{'' if message.endswith('?') else '.'} See {self.prog} --help")

    def parse_known_args(self, args: Iterable[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Reject unknown options here, since the top level would point to its own help."""
        given, flags = list(args or ()), self._option_string_actions
        own = itertools.takewhile(lambda text: text.startswith("-") if self._subparsers else text != "--", given)
        for flag in (text.partition("=")[0] for text in own if text.startswith("--")):
            if not any(known.startswith(flag) for known in flags):
                self.error(f"unknown option {flag}{suggestion(flag, flags)}")
        parsed, extra = super().parse_known_args(given, namespace)
        if extra:
            self.error(f"unexpected argument {extra[0]}")
        return parsed, extra

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            label = str(action.metavar or action.dest).lower()
            raise argparse.ArgumentError(action, unknown(label, value, action.choices))


def refuse_lone_dashes(given: Sequence[str]) -> None:
    """Raise UsageError for an option whose value is --, which argparse drops."""
    for text in given:
        if text.startswith("-") and text.endswith("=--"):
            raise UsageError(f"{text.removesuffix('=--')} needs a value, got --")


def add_option(
    command: argparse.ArgumentParser,
    option: Option,
    default: Any = None,
    *,
    given: bool = True,
    read: Callable[[str], Any] | None = None,
    **changes: Any,
) -> None:
    """Add an option to a command.

    Args:
        default: default value, shown in the help.
        given: whether the parsed namespace holds the default; otherwise it holds None, for a configuration to fill in.
        read: parser of the text; None for the option's own.
        **changes: changes to the option's description.
    """
    option = dataclasses.replace(option, **changes)

    def parse(text: str) -> Any:
        try:
            return (read or option.parse)(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    flag = option.flag or f"--{option.name.replace('_', '-')}"
    if option.kind is bool:
        command.add_argument(flag, dest=option.name, action="store_true", default=None, help=option.describe())
        return
    command.add_argument(
        flag,
        dest=option.name,
        type=parse,
        default=default if given else None,
        metavar=f"{option.metavar}[,{option.metavar}]" if option.many and "," not in option.metavar else option.metavar,
        help=option.describe(default).replace("%", "%%"),
    )


def add_options(command: argparse.ArgumentParser, owner: type[Checked], *names: str, **changes: dict[str, Any]) -> None:
    """Add options of a configuration by name, with changes to their descriptions."""
    for name in names:
        add_option(command, owner.option(name), owner.default(name), given=False, **changes.get(name, {}))


def add_task_options(command: argparse.ArgumentParser) -> None:
    """Add the task, options that override its settings, and process options."""
    add_task_argument(command)
    for name in ("sigma", "cone", "horizon", "model"):
        add_option(command, OPTIONS[name])
    add_process_options(command)


def known_task(text: str) -> str:
    """Return a task's name, or raise ArgumentTypeError if it is unknown."""
    if told := unknown_task(text):
        raise argparse.ArgumentTypeError(told)
    return text


def add_task_argument(command: argparse.ArgumentParser) -> None:
    named = f"one of: {', '.join(TASK_DESCRIPTIONS)}; module:name of your own; or any MJCF that MJX runs"
    command.add_argument("task", type=known_task, metavar="TASK|FILE.xml", help=named)


def add_theta_option(command: argparse.ArgumentParser, purpose: str) -> None:
    """Add `--theta`, read by `theta_of`."""
    command.add_argument(
        "--theta",
        metavar="FILE|X[,X]",
        help=f"{purpose}: a policy written by optimise, a .json or .npy file, or numbers (default: the task's)",
    )


def add_folder_options(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--output", type=Path, metavar="DIR", help="folder for the study's numbers and figures; resumable"
    )
    add_study_options(command)


def add_contact_options(
    command: argparse.ArgumentParser, stiffness: str = "the task's sweep", *, many: bool = True, analytic: bool = True
) -> None:
    """Add the contact models: one or many, with or without the analytic reference."""
    add_option(command, dataclasses.replace(OPTIONS["stiffness"], many=many), unset=stiffness)
    contact = dataclasses.replace(OPTIONS["contact"], many=many)
    add_option(command, contact if analytic else dataclasses.replace(contact, choices=tuple(FAMILIES)))
    add_option(command, OPTIONS["damping"])


def add_scene_options(command: argparse.ArgumentParser) -> None:
    """Add overrides of an MJCF's <option>, so that a model can be adapted to MJX without editing its file."""
    from mjx_study.simulation.limitations import FLAGS

    for name in ("integrator", "solver"):
        add_option(command, OPTIONS[name])
    command.add_argument(
        "--disable-flag",
        metavar="FLAG[,FLAG]",
        dest="disable_flags",
        help=f"flags to disable, as in the MJCF's <flag>: {', '.join(FLAGS)}",
    )


def scene_options(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """The given scene options and the named ones, as arguments of `load_scene`."""
    given = {name: getattr(options, name, None) for name in ("integrator", "solver", "disable_flags", *names)}
    return {name: value for name, value in given.items() if value is not None}


def add_estimator_options(command: argparse.ArgumentParser, owner: type[Checked]) -> None:
    """Add the noise and the estimators' options; see `estimators.ESTIMATORS`."""
    add_options(
        command, owner, "noise", "baseline", "published", "gamma", "failure_probability", "variance_proxy", "radius",
        "max_norm", "window", "tolerance", "weights", "onset",
    )  # fmt: skip


def add_backward_options(command: argparse.ArgumentParser, *, many: bool = True) -> None:
    """Add the contact model of surrogate derivatives: one or many."""
    add_option(command, dataclasses.replace(OPTIONS["backward"], many=many), unset="none")
    for name in ("backward_stiffness", "backward_margin"):
        add_option(command, OPTIONS[name])


def add_process_options(command: argparse.ArgumentParser, seed: int | None = 0) -> None:
    """Add seed, precision and devices; a seed of None leaves its default to a configuration."""
    add_option(command, OPTIONS["seed"], 0, given=seed is not None)
    command.add_argument("--precision", choices=PRECISIONS, default="float64", help="default: float64")
    add_option(command, OPTIONS["devices"])


def add_cluster_option(command: argparse.ArgumentParser) -> None:

    def cluster(text: str) -> str:
        """Parse a cluster, as for `mjx_study.study.cluster.connected`."""
        if not re.fullmatch(r"(local|slurm)(:[1-9]\d{0,4})?|(tcp|tls|ws|wss|ucx)://\S+", text):
            raise argparse.ArgumentTypeError(
                f"must be local:N, slurm:N or an address such as tcp://host:8786, got {text!r}"
            )
        return text

    command.add_argument(
        "--cluster",
        type=cluster,
        metavar="WHERE",
        help="compute on Dask workers: local:N processes, slurm:N workers, or a scheduler's tcp://host:port",
    )


def add_study_options(command: argparse.ArgumentParser) -> None:
    command.add_argument("--dry-run", action="store_true", help="print the expected cost; compute and write nothing")
    command.add_argument(
        "--accept-versions", action="store_true", help="resume a folder begun by other versions of the software"
    )


def configure_process(options: argparse.Namespace) -> None:
    """Set up JAX from the options; commands without them get float64 and one device.

    Raises:
        ValueError: JAX cannot be set up like this, for instance because JAX_PLATFORMS names no platform.
    """
    configure(precision=getattr(options, "precision", PRECISIONS[0]), cpu_devices=getattr(options, "devices", 1))


def configure(**settings: Any) -> None:
    """Call `mjx_study.runtime.configure`, and check that JAX has a device."""
    import jax

    from mjx_study.runtime import configure

    configure(**settings)
    try:
        jax.local_devices()
    except RuntimeError as error:
        raise ValueError(f"JAX has no device to compute on: {error}") from error


@contextmanager
def usage_errors() -> Generator[None]:
    """Turn errors that users can cause into UsageErrors; for checks only, never for computing."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error


@contextmanager
def computing(interrupted: str = INTERRUPTED) -> Generator[Progress]:
    """Show progress while computing; a signal ends the process at once, see `ending`."""
    with ending(interrupted, *ENDINGS), shown_progress() as progress:
        yield progress


@contextmanager
def ending(told: str, *signals: signal.Signals) -> Generator[None]:
    """Within the context, let signals end the process at once, with one line and exit code 128 + the signal's number.

    Exceptions would not work: JAX calls back into Python while tracing, and exceptions raised there may be lost.
    Nothing is on disk yet, or only complete files, so there is nothing to undo.
    """
    previous = {number: signal.getsignal(number) for number in signals}
    # Only the main thread may set handlers; signals that a background job or nohup ignores stay ignored.
    ours = threading.current_thread() is threading.main_thread()
    caught = [number for number, handler in previous.items() if ours and handler is not signal.SIG_IGN]
    for number in caught:
        signal.signal(number, lambda code, _: _leave(f"mjx-study: {ENDINGS[signal.Signals(code)]}; {told}", code))
    try:
        yield
    finally:
        for number in caught:
            signal.signal(number, previous[number])


def _leave(message: str, code: int) -> NoReturn:
    show_cursor()
    print(message, file=sys.stderr, flush=True)
    os._exit(128 + code)


def attempt(write: Callable[[], list[Path]]) -> tuple[list[Path], str | None]:
    """Write files; return their paths, or the reason for a failure: a full disk must not cost the printed numbers."""
    try:
        return write(), None
    except OSError as error:
        return [], f"cannot write {error.filename or 'a file'}: {error.strerror or error}; existing files are complete"


def finish(*unwritten: str | None) -> int:
    """Return the exit code after the numbers are printed: 1, with one line, if something could not be written."""
    if failures := [failure for failure in unwritten if failure]:
        print(f"mjx-study: {failures[0]}", file=sys.stderr)
    return int(bool(failures))


def print_report(options: argparse.Namespace, document: dict[str, Any], lines: Sequence[str]) -> None:
    """Print the document as JSON if requested, otherwise the lines."""
    if options.json:
        print(json.dumps(document, allow_nan=False))
    else:
        print("\n".join(lines))
