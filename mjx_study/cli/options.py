"""What the commands share: options, their checks, one line for what is wrong, and a clean end when interrupted."""

import argparse
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn

from estimators import BASELINES, NOISES
from mjx_study.configuration import Progress
from mjx_study.console import progress_bar, show_cursor
from mjx_study.contact import FAMILIES
from mjx_study.limitations import FLAGS
from mjx_study.runtime import PRECISIONS, configure
from mjx_study.scene import CONES, INTEGRATORS, SOLVERS
from mjx_study.task import Task
from mjx_study.tasks import make_task, task_names

INTERRUPTED = "mjx-study: interrupted; nothing was written"


class UsageError(ValueError):
    """A bad option or file: one line, exit code 2."""


class Parser(argparse.ArgumentParser):
    """A parser whose errors are UsageErrors."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


Commands = Any
"""argparse's collection of subparsers, whose class is private."""


def add_command(
    commands: Commands, name: str, summary: str, run: Callable[[argparse.Namespace], int], epilog: str = ""
) -> argparse.ArgumentParser:
    """A subcommand with `--json`."""
    command = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.set_defaults(run=run)
    command.add_argument("--json", action="store_true", help="print the numbers as JSON on standard output")
    return command


def add_task_options(
    command: argparse.ArgumentParser,
    *,
    contact: bool = True,
    stiffness: str = "the task's sweep",
    files: str = "",
) -> None:
    """The task, what may replace its own settings, and how it is computed."""
    metavar = "TASK|FILE.xml" if files else "TASK"
    command.add_argument(
        "task", metavar=metavar, help=f"one of: {', '.join(task_names())}; or module:name of your own{files}"
    )
    if contact:
        add_contact_options(command, stiffness)
    command.add_argument("--sigma", type=float, metavar="S", help="noise, in the unit of what it is added to")
    command.add_argument("--cone", choices=list(CONES), help="friction cone (default: the MJCF's)")
    command.add_argument("--horizon", type=int, metavar="H", help="steps (default: the task's)")
    command.add_argument("--model", metavar="FILE.xml", help="an MJCF in place of the task's own")
    add_process_options(command)


def add_contact_options(command: argparse.ArgumentParser, stiffness: str = "the task's sweep") -> None:
    """The contact models."""
    command.add_argument(
        "--stiffness", type=numbers, metavar="K[,K]", help=f"contact stiffnesses in N/m (default: {stiffness})"
    )
    command.add_argument("--contact", type=names, metavar="FAMILY[,FAMILY]", help=f"of: {', '.join(FAMILIES)}")
    command.add_argument(
        "--damping", type=float, metavar="B", help="contact damping in N s/m, in place of the family's"
    )


def add_scene_options(command: argparse.ArgumentParser) -> None:
    """What replaces an MJCF's own <option>: what MJX lacks can be changed without editing the file."""
    command.add_argument("--integrator", choices=list(INTEGRATORS), help="default: the MJCF's")
    command.add_argument("--solver", choices=list(SOLVERS), help="of the constraints (default: the MJCF's)")
    command.add_argument(
        "--disable-flag",
        metavar="FLAG[,FLAG]",
        dest="disable_flags",
        help=f"as in the MJCF's <flag>; of: {', '.join(FLAGS)}",
    )


def scene_options(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of the options, and of `add_scene_options`, that are given, as `load_scene` takes them."""
    given = {name: getattr(options, name, None) for name in ("integrator", "solver", "disable_flags", *names)}
    return {name: value for name, value in given.items() if value is not None}


def add_estimator_options(command: argparse.ArgumentParser) -> None:
    """The noise, and what estimators let one choose; see `estimators.EstimatorOptions`."""
    add_noise_option(command)
    command.add_argument("--baseline", choices=list(BASELINES), help="of zeroth-order samples (default: zero_noise)")
    command.add_argument(
        "--gamma", type=float, metavar="G", help="AoBG's accuracy bound; inf for none (default: the task's)"
    )
    command.add_argument(
        "--failure-probability", type=float, metavar="P", help="that epsilon's interval misses (default: 0.05)"
    )
    command.add_argument(
        "--variance-proxy",
        metavar="S2",
        help="variance, second_moment or upper_bound, in epsilon (default: variance)",
    )
    command.add_argument(
        "--radius",
        type=number_or_name,
        metavar="R",
        help="max_deviation or a number, in epsilon (default: max_deviation)",
    )
    command.add_argument("--max-norm", type=float, metavar="G", help="of a sample of fobg_clipped")
    command.add_argument("--window", type=int, metavar="H", help="steps between cuts of fobg_truncated")
    command.add_argument("--tolerance", type=float, metavar="C", help="of ddcg's test (default: 0.3)")


def add_noise_option(command: argparse.ArgumentParser) -> None:
    """The density of the noise."""
    command.add_argument("--noise", choices=list(NOISES), help="density of the noise (default: the task's)")


def add_process_options(command: argparse.ArgumentParser) -> None:
    """Randomness, precision, devices."""
    command.add_argument("--seed", type=int, default=0, metavar="N", help="of all randomness (default: 0)")
    command.add_argument("--precision", choices=PRECISIONS, default="float64", help="default: float64")
    command.add_argument(
        "--devices", type=int, metavar="N", help="CPU devices (default: one per core; with JAX 0.11 one)"
    )


def configure_process(options: argparse.Namespace) -> None:
    """Set JAX up as the options ask; a command without such options gets float64 and one device."""
    configure(precision=getattr(options, "precision", PRECISIONS[0]), cpu_devices=getattr(options, "devices", 1))


def task_of(options: argparse.Namespace) -> Task:
    """The task that the options describe."""
    task = make_task(options.task, **scene_options(options, "cone", "horizon", "model"))
    return task if options.sigma is None else task.replace(sigma=options.sigma)


@contextmanager
def usage_errors() -> Generator[None]:
    """Turns what a user can get wrong into a UsageError; used around checks only, never around computing."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error


@contextmanager
def computing(interrupted: str = INTERRUPTED) -> Generator[Progress]:
    """A progress bar around computing; an interrupt ends the process at once, with one line and exit code 130.

    An exception would not do: JAX calls back into Python while it traces, and what is raised there may be lost.
    Nothing is on disk yet, or only what is complete, so there is nothing to undo.
    """
    previous = signal.getsignal(signal.SIGINT)
    # Only the main thread may set a handler, and a background job that ignores interrupts goes on ignoring them.
    ours = threading.current_thread() is threading.main_thread() and previous is not signal.SIG_IGN
    if ours:
        signal.signal(signal.SIGINT, lambda *_: _leave(interrupted))
    try:
        with progress_bar() as progress:
            yield progress
    finally:
        if ours:
            signal.signal(signal.SIGINT, previous)


def _leave(message: str) -> NoReturn:
    show_cursor()
    print(message, file=sys.stderr, flush=True)
    os._exit(130)


def print_report(options: argparse.Namespace, document: dict[str, Any], lines: Sequence[str]) -> None:
    """The document as JSON where that is asked for, otherwise the lines."""
    if options.json:
        print(json.dumps(document, allow_nan=False))
    else:
        print("\n".join(lines))


def numbers(text: str) -> tuple[float, ...]:
    """A list of numbers such as 10,100,1000."""
    try:
        return tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of numbers such as 10,100,1000") from None


def number_or_name(text: str) -> float | str:
    """A number where it is one."""
    try:
        return float(text)
    except ValueError:
        return text


def names(text: str) -> tuple[str, ...]:
    """A list of names such as zobg,fobg."""
    return tuple(part.strip() for part in text.split(",") if part.strip())
