"""mjx-study gradcheck."""

import argparse
from typing import Any

from estimators import make_estimator
from mjx_study import gradcheck as check
from mjx_study.choices import CHECKED_STEPS, is_file
from mjx_study.cli.options import UsageError, computing, configure_process, print_report, scene_options, usage_errors
from mjx_study.cli.parsers.gradcheck import MEAN
from mjx_study.gradcheck.mean import lines_of
from mjx_study.gradcheck.plan import GradcheckPlan
from mjx_study.simulation.scene import load_scene
from mjx_study.study.resolution import check_estimators
from mjx_study.tasks import make_task

UNEXERCISED = 3
"""Exit code if nothing is wrong but something was never exercised."""


def run(options: argparse.Namespace) -> int:
    """Check and print; return 1 if something is wrong, 3 if something was not exercised."""
    if options.mean:
        return _run_mean(options)
    if given := _given(options):
        raise UsageError(f"--{next(iter(given))} is for --mean")
    with usage_errors():
        configure_process(options)
        plan = _plan(options)
    with computing() as progress:
        report = check.gradcheck(plan, progress)
    print_report(options, report.as_json(), report.lines(verbose=options.verbose))
    return 1 if not report.passed else UNEXERCISED if report.unexercised else 0


def _given(options: argparse.Namespace) -> dict[str, Any]:
    """Options of --mean that were given."""
    return {name: getattr(options, name) for name in MEAN if getattr(options, name) is not None}


def _run_mean(options: argparse.Namespace) -> int:
    chosen = MEAN | _given(options)
    with usage_errors():
        configure_process(options)
        scene = scene_options(options, "cone", "iterations", "ls_iterations", "horizon", "model")
        task = make_task(options.task, **scene).replace(onset=chosen["onset"])
        task = task if chosen["sigma"] is None else task.replace(sigma=chosen["sigma"])
        plan = check.plan_gradcheck(
            task, options.contact, options.stiffness, seed=options.seed, damping=options.damping
        )
        found = [make_estimator(name, gamma=task.defaults.gamma, sigma=task.sigma) for name in chosen["estimators"]]
        check_estimators(found, task)
    given = {name: chosen[name] for name in ("samples", "span", "direction")} | {"names": chosen["estimators"]}
    with computing() as progress:
        checks = check.check_mean(task, plan.cells, found, seed=options.seed, progress=progress, **given)
    document = {"checks": [each.as_dict() for each in checks], "warnings": list(plan.warnings)}
    print_report(options, document, [*lines_of(checks), *(f"warning: {text}" for text in plan.warnings)])
    verdicts = {each.verdict for each in checks}
    return 1 if "biased" in verdicts else UNEXERCISED if "undecided" in verdicts else 0


def _plan(options: argparse.Namespace) -> GradcheckPlan:
    common = {"seed": options.seed, "damping": options.damping, "states": options.states, "stock": options.stock}
    chosen = scene_options(options, "cone", "iterations", "ls_iterations")
    if not is_file(options.task):
        if options.pair is not None:
            raise UsageError("--pair is for files; a task has its own")
        chosen |= {name: getattr(options, name) for name in ("horizon", "model") if getattr(options, name) is not None}
        task = make_task(options.task, **chosen)
        return check.plan_gradcheck(task, options.contact, options.stiffness, **common)
    if options.model is not None:
        raise UsageError("--model replaces the MJCF of a task, but this is a file already")
    if options.pair is not None and len(options.pair) != 2:
        raise UsageError(f"--pair takes the names of two geoms, got {len(options.pair)}")
    scene = load_scene(options.task, **chosen)
    horizon = CHECKED_STEPS if options.horizon is None else options.horizon
    return check.plan_scene_gradcheck(
        scene, options.contact, options.stiffness, pair=options.pair, horizon=horizon, **common
    )
