"""mjx-study diagnose."""

import argparse
import json
import shlex
from pathlib import Path

from mjx_study.choices import FAMILIES, is_file
from mjx_study.cli.options import configure_process, given_options, task_at_theta, usage_errors
from mjx_study.cli.output import attempt, computing, print_report
from mjx_study.diagnose.columns import CONTACTS, DISTANCE, ESTIMATES, TOUCHES
from mjx_study.disk import prepare_folder, write_whole
from mjx_study.options.configuration import OPTIONS
from mjx_study.options.parser import MIDDLE, TASK_OPTIONS, Parser
from mjx_study.table import explain

EPILOG = f"""\
examples:
  mjx-study diagnose momentum_transfer --contact mujoco_default
  mjx-study diagnose momentum_transfer --contact kelvin_voigt
  mjx-study diagnose robot.xml                 no cost is needed: the default is of displacements
  mjx-study diagnose robot_task:robot --theta out/policy-fobg.json       at the end of a descent

columns of the contacts and of the estimators:
{explain(*TOUCHES, *CONTACTS, DISTANCE, *ESTIMATES)}

The error is that of a gradient from as many samples as this machine computes in a second. Means are checked along
paths, as in gradcheck --mean, and so is the bias. Exit code 1 if a derivative is wrong.
"""


def add(command: Parser) -> None:
    command.add_task_options()
    command.add_contact_options(MIDDLE, many=False, analytic=False)
    command.add_option(
        "samples", many=False, interval="[2, 1e7]", unset="500, or what a verdict needs, within a minute"
    )
    command.add_theta_option("parameters at which gradients are taken")
    command.add_argument("--output", type=Path, metavar="DIR", help="folder for the page (diagnosis.txt) and the JSON")


def run(options: argparse.Namespace) -> int:
    from mjx_study.diagnose.page import document_of, page_lines
    from mjx_study.diagnose.run import diagnose_task, plan_diagnosis

    with usage_errors():
        configure_process(options)
        task = task_at_theta(options)
        folder = options.output and prepare_folder(options.output)
        plan = plan_diagnosis(
            options.task,
            task,
            options.contact,
            options.stiffness,
            damping=options.damping,
            smoothing=options.smoothing,
            samples=options.samples,
            seed=options.seed or 0,
        )
    (contact,) = plan.cells
    given = given_options(
        options, "contact", "stiffness", "damping", "smoothing", "sigma", *TASK_OPTIONS, "seed", "theta"
    )
    if not is_file(options.task):  # other commands default to several
        given["contact"] = contact.family
        if FAMILIES[contact.family].swept:
            given["stiffness"] = contact.stiffness
    flags = "".join(f" {OPTIONS[name].flag} {shlex.quote(_text(value))}" for name, value in given.items())
    with computing() as progress:
        found = diagnose_task(
            options.task,
            plan,
            samples=options.samples,
            theta=options.theta or "",
            options=flags,
            progress=progress,
        )
    document, lines, unwritten = document_of(found), page_lines(found), None
    if folder is not None:
        texts = {"diagnosis.txt": "\n".join(lines), "diagnosis.json": json.dumps(document, allow_nan=False)}
        write = lambda: [write_whole(folder / name, f"{text}\n".encode()) for name, text in texts.items()]  # noqa: E731
        written, unwritten = attempt(write)
        lines = [*lines, *([f"written to {folder}: {', '.join(path.name for path in written)}"] if written else [])]
    return max(print_report(options, document, lines, unwritten), 0 if found.derivatives.passed else 1)


def _text(value: str | int | float | tuple[str, ...]) -> str:
    """A value as on the command line."""
    return ",".join(value) if isinstance(value, tuple) else f"{value:.12g}" if isinstance(value, float) else str(value)
