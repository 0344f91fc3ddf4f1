"""mjx-study gradcheck."""

import argparse
from pathlib import Path

from mjx_study import gradcheck as check
from mjx_study.cli.console import stage_lines
from mjx_study.cli.options import (
    Commands,
    UsageError,
    add_command,
    add_contact_options,
    add_option,
    add_process_options,
    add_scene_options,
    computing,
    configure_process,
    print_report,
    scene_options,
    usage_errors,
)
from mjx_study.gradcheck.plan import HORIZON, STATES, GradcheckPlan
from mjx_study.option import OPTIONS, Option
from mjx_study.simulation.scene import load_scene
from mjx_study.tasks import make_task, task_names

EPILOG = """\
Columns, all relative, each the worst over the states:
  modes        reverse mode against forward mode
  differences  the derivative over state and control against central differences
  parameters   the same over solref, solimp and friction, through the contact model
  one-sided    how far the two one-sided differences disagree: 0 where the map is smooth
  closed form  against a hand-derived gradient of the task's analytic counterpart, another model of the same system
  mjx step     the state after a step against that of mjx.step, run to convergence
  C step       the same against the C engine's; contacts may be placed differently
  C engine     the Jacobian against differences of the C engine's step, where the steps agree
  mjx.step     the derivative of mjx.step itself, with --stock: what one would have without this project
  residual     what the solver leaves; the derivative is only as good as this
  unresolved   entries of which differences, as large as their uncertainty, say nothing

Below it, what the states exercise: contacts that push, stick, slide or separate, limits, friction loss, equalities.
Where a rollout does not reach one that the model has, faster ones and random poses are searched.

Exit code 0: every derivative that exists is right. 1: one is wrong, NaN, silently zero or unconverged, or the step is
another than that of mjx.step or, for no documented reason, of the C engine. 3: right, but something that the model has
was never exercised. Kinks and jumps are properties of the step, and contacts placed differently are no error of a
derivative: they are reported, and do not fail.
"""
UNEXERCISED = 3
"""Exit code where nothing is wrong and something was never exercised."""


PAIR = Option("pair", str, "GEOM,GEOM", "contact of a file that a stiffness is for", many=True)


def add(commands: Commands) -> None:
    """Register the command."""
    summary = "check derivatives against differences, the C engine and a closed form"
    command = add_command(commands, "gradcheck", summary, run, EPILOG)
    command.add_argument(
        "task",
        metavar="TASK|FILE.xml",
        help=f"one of: {', '.join(task_names())}; module:name of your own; or any MJCF that MJX runs",
    )
    usual = ",".join(f"{each:g}" for each in check.STIFFNESS)
    add_contact_options(command, analytic=False, stiffness=f"{usual}, or the task's where that is stiffer")
    add_option(command, PAIR)
    add_option(command, OPTIONS["cone"])
    add_scene_options(command)
    add_option(command, OPTIONS["iterations"], line="of the solver", unset="the MJCF's")
    add_option(command, OPTIONS["ls_iterations"])
    add_option(command, OPTIONS["horizon"], unset=f"the task's; of a file {HORIZON}")
    add_option(command, OPTIONS["model"])
    add_option(command, OPTIONS["states"], STATES)
    command.add_argument("--stock", action="store_true", help="check the derivative of mjx.step itself, too")
    command.add_argument("--verbose", action="store_true", help="every entry of every finding")
    add_process_options(command)


def run(options: argparse.Namespace) -> int:
    """Check and print; 1 where something is wrong, 3 where something was not exercised."""
    with usage_errors():
        configure_process(options)
        plan = _plan(options)
    with computing() as progress:
        report = check.gradcheck(plan, stage_lines(progress))
    print_report(options, report.as_json(), report.lines(verbose=options.verbose))
    return 1 if not report.passed else UNEXERCISED if report.unexercised else 0


def _plan(options: argparse.Namespace) -> GradcheckPlan:
    common = {"seed": options.seed, "damping": options.damping, "states": options.states, "stock": options.stock}
    chosen = scene_options(options, "cone", "iterations", "ls_iterations")
    if Path(options.task).suffix.lower() != ".xml":
        if options.pair is not None:
            raise UsageError("--pair is for files; a task has its own")
        chosen |= {name: getattr(options, name) for name in ("horizon", "model") if getattr(options, name) is not None}
        task = make_task(options.task, **chosen)
        return check.plan_gradcheck(task, options.contact, options.stiffness, **common)
    if options.model is not None:
        raise UsageError("--model replaces the MJCF of a task, and this is a file already")
    if options.pair is not None and len(options.pair) != 2:
        raise UsageError(f"--pair takes the names of two geoms, got {len(options.pair)}")
    scene = load_scene(options.task, **chosen)
    horizon = HORIZON if options.horizon is None else options.horizon
    return check.plan_scene_gradcheck(
        scene, options.contact, options.stiffness, pair=options.pair, horizon=horizon, **common
    )
