"""mjx-study gradcheck."""

import argparse
from pathlib import Path

from mjx_study import gradcheck as check
from mjx_study.choices import CHECKED_STEPS
from mjx_study.cli.options import UsageError, computing, configure_process, print_report, scene_options, usage_errors
from mjx_study.gradcheck.plan import GradcheckPlan
from mjx_study.simulation.scene import load_scene
from mjx_study.tasks import make_task

UNEXERCISED = 3
"""Exit code where nothing is wrong and something was never exercised."""


def run(options: argparse.Namespace) -> int:
    """Check and print; 1 where something is wrong, 3 where something was not exercised."""
    with usage_errors():
        configure_process(options)
        plan = _plan(options)
    with computing() as progress:
        report = check.gradcheck(plan, progress)
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
    horizon = CHECKED_STEPS if options.horizon is None else options.horizon
    return check.plan_scene_gradcheck(
        scene, options.contact, options.stiffness, pair=options.pair, horizon=horizon, **common
    )
