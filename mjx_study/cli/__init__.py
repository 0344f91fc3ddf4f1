"""The command line: parse, check, call, print; exit codes.

Exit codes: 0 success; 1 a requested check failed, or a file could not be written (one line after the numbers); 2 an
invalid option or file (one line, nothing written); 3 `gradcheck` found nothing wrong but could not check everything;
128 + N ended by signal N (130 interrupted, 143 terminated, 129 hung up). Each command is a module: `EPILOG` for its
help, `add` for its options, and `run`, which alone imports what computes.
"""

import argparse
import gc
import os
import shlex
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Final

from mjx_study.cli.options import refuse_unusable
from mjx_study.cli.output import OutputError, complain, encodable, ending, written_out
from mjx_study.options.parser import Parser, UsageError
from mjx_study.version import version_of

ENDED = "existing files are complete"
EXAMPLES = """\
start here:
  mjx-study compare pusher                       which estimator, at which contact stiffness? 10 s once compiled
  mjx-study compare pusher --output out          the same, with a figure and the numbers on disk
  mjx-study optimise pusher --output out         what does each estimator achieve in gradient descent?
  mjx-study sweep pusher --output out            many contact models, resumable; then plot out, report out
  mjx-study landscape ball_wall --output out     the cost, its mean under noise, and the slopes that estimators see
  mjx-study rollout tennis                       pictures and a film of a task
  mjx-study gradcheck pusher                     are the derivatives right? exit code 1 if not
  mjx-study init robot.xml                       writes a task of your own: robot_task:robot in every command
  mjx-study diagnose robot.xml                   any MJCF: what contact does to gradients, and what to do about it
  mjx-study bench pusher                         what does a gradient cost on this machine?
"""
COMMANDS: Final = {
    "init": "write a task for an MJCF, to start from",
    "compare": "compare gradient estimators over contact models",
    "optimise": "optimise a policy with any estimator",
    "sweep": "sweep contact models, noise and samples; resumable",
    "plot": "draw a study's figures",
    "report": "write a study as one HTML page",
    "landscape": ("draw the cost and smoothed cost along a line of parameters, and the slope that each estimator sees"),
    "rollout": "show a rollout: pictures, a film and its numbers",
    "gradcheck": "check derivatives against finite differences, the C engine and a closed form",
    "diagnose": "diagnose whether a model's gradients are worth having, and which estimator to use",
    "claims": "test which claims survive, in which contact models",
    "bench": "measure what rollouts and gradients cost on this machine",
    "tasks": "list the tasks",
    "estimators": "list the gradient estimators and the noise densities",
}
ALIASES: Final = {"optimize": "optimise"}
COLLECTION: Final = (200_000, 20, 100)
"""Thresholds of Python's garbage collector, a 16th of the time of a first answer with its own."""


def main(arguments: Sequence[str] | None = None) -> int:
    # Suppress XLA's banners about programs that take minutes to compile; failures still raise.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    if arguments is None:  # a process of its own: tracing makes millions of objects that live on
        gc.set_threshold(*COLLECTION)
    try:
        with written_out(), ending(ENDED, signal.SIGTERM, signal.SIGHUP):
            given = sys.argv[1:] if arguments is None else list(arguments)
            refuse_unusable(given)
            chosen = next((text for text in given if not text.startswith("-")), "")
            options = parser(ALIASES.get(chosen, chosen)).parse_args(given)
            options.command_line = encodable(shlex.join(["mjx-study", *given]))
            return import_module(f"mjx_study.cli.{options.command}").run(options)
    except UsageError as error:
        complain(f"mjx-study: {' '.join(str(error).split())}")
        return 2
    except KeyboardInterrupt:
        complain(f"mjx-study: interrupted; {ENDED}")
        return 130
    except OutputError as error:
        complain(f"mjx-study: {error}")
        return 1
    except BrokenPipeError:
        return 1


def parser(chosen: str | None = None) -> argparse.ArgumentParser:
    """Build the command line's parser, with the options of all commands or of one only."""
    root = Parser(
        prog="mjx-study",
        description="Measure, with real contact physics, whether the gradients of a differentiable simulator are worth "
        "having.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    root.add_argument("--version", action="version", version=f"mjx-study {version_of('mjx-study')}")
    commands = root.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, line in COMMANDS.items():
        command = commands.add_parser(
            name,
            aliases=[alias for alias, of in ALIASES.items() if of == name],
            help=line,
            description=line[0].upper() + line[1:] + ".",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        if chosen in (None, name):
            module = import_module(f"mjx_study.cli.{name}")
            command.epilog = module.EPILOG
            command.add_flag("--json", "print the numbers as JSON on standard output")
            module.add(command)
            command.set_defaults(command=name)
    return root


__all__ = ["main", "parser"]
