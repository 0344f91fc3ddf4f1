"""mjx-study gradcheck."""

import argparse
from typing import Any

from mjx_study.choices import CHECKED_STATES, CHECKED_STEPS, CHECKED_STIFFNESS, is_file
from mjx_study.cli.options import Parser, UsageError, configure_process, given_options, task_of, usage_errors
from mjx_study.cli.output import computing, print_report
from mjx_study.diagnose.columns import MEANS
from mjx_study.options.option import OPTIONS, Option
from mjx_study.table import explain

UNEXERCISED = 3
"""Exit code if nothing is wrong but something was never exercised."""
PAIR = Option("pair", str, "GEOM,GEOM", "for files: pair of geoms that the stiffness is for", many=True)
EPILOG = f"""\
Columns, all relative errors, each the worst over the states:
  modes        reverse mode against forward mode
  differences  derivatives with respect to state and control, against central differences
  parameters   the same with respect to solref, solimp and friction, through the contact model
  one-sided    disagreement of the two one-sided differences: 0 where the map is smooth
  closed form  against a hand-derived gradient of the task's analytic counterpart, a different model of the same system
  mjx step     the state after a step, against mjx.step run to convergence
  C step       the same against the C engine; contacts may be placed differently
  C engine     the Jacobian against differences of the C engine's step, where the steps agree
  mjx.step     with --stock, the derivative of mjx.step itself: what you get without this project
  residual     the solver's residual; the derivative is only as good as this
  unresolved   number of entries for which differences are too uncertain to decide

Below the table, what the states exercise: contacts that push, stick, slide or separate, limits, friction loss,
equalities. If the rollout does not reach one that the model has, faster states and random poses are searched.

Exit code 0: every derivative that exists is right. 1: one is wrong, NaN, silently zero or unconverged, or the step
differs from mjx.step or, for no documented reason, from the C engine. 3: right, but something that the model has and
can reach was never exercised. Kinks and jumps are properties of the step, and differently placed contacts are not
derivative errors: both are reported but do not fail.

With --mean: does an estimator's mean integrate to the difference of the mean cost along a path through theta? No
reference gradient is needed. Exit code 0: all are right. 1: one is biased. 3: undecided. Columns:
{explain(*MEANS)}
"""
MEAN = {
    "estimators": ("zobg", "fobg"),
    "onset": "none",
    "samples": 1000,
    "sigma": None,
    "span": None,
    "direction": "random",
    "max_norm": None,
    "window": None,
}
"""Options of --mean, with their defaults."""
OF_DERIVATIVES = {"states": CHECKED_STATES, "stock": False, "pair": None, "details": False}
"""Options that --mean does not read, with their defaults."""


def add(command: Parser) -> None:
    command.add_task_argument()
    usual = ",".join(f"{each:g}" for each in CHECKED_STIFFNESS)
    families = "penalty,mujoco,mujoco_default; mjcf without contact_pair, as for a file"
    command.add_contact_options(f"{usual}, or the task's if stiffer", families, analytic=False)
    command.add_option(PAIR)
    command.add_builder_options(horizon={"unset": f"the task's; {CHECKED_STEPS} for a file"})
    command.add_option("states", CHECKED_STATES)
    command.add_flag("--stock", "also check the derivative of mjx.step itself")
    command.add_flag("--mean", "check the means of estimators instead of derivatives")
    changes: dict[str, dict[str, Any]] = {
        "estimators": {"many": True},
        "span": {"many": True, "line": "range of the path", "unset": "two sigma about theta"},
        "samples": {"line": "samples at each node of the path"},
    }
    for name, default in MEAN.items():
        more = "; or means: three paths that the means span" if name == "direction" else ""
        own = changes.get(name, {})
        own["line"] = f"with --mean: {own.get('line', OPTIONS[name].line)}{more}"
        command.add_option(name, default, given=False, **own)
    command.add_flag("--details", "print every entry of every finding")
    command.add_process_options()


def run(options: argparse.Namespace) -> int:
    """Check and print; return 1 if something is wrong, 3 if something was not exercised."""
    from mjx_study.gradcheck import gradcheck, plan_gradcheck, plan_scene_gradcheck

    if options.mean:
        if given := [name for name, default in OF_DERIVATIVES.items() if getattr(options, name) != default]:
            raise UsageError(f"--{given[0]} is for derivatives of steps: omit it, or --mean")
        return _run_mean(options)
    if given := given_options(options, *MEAN):
        raise UsageError(f"{OPTIONS[next(iter(given))].flag} is for --mean")
    common = {name: getattr(options, name) for name in ("seed", "damping", "states", "stock")}
    with usage_errors():
        configure_process(options)
        task = task_of(options)
        if not is_file(options.task):
            if options.pair is not None:
                raise UsageError("--pair is for files; a task has its own")
            plan = plan_gradcheck(task, options.contact, options.stiffness, **common)
        else:
            if options.pair is not None and len(options.pair) != 2:
                raise UsageError(f"--pair takes the names of two geoms, got {len(options.pair)}")
            common |= {"pair": options.pair, "horizon": task.horizon}
            plan = plan_scene_gradcheck(task.scene, options.contact, options.stiffness, **common)
    with computing() as progress:
        report = gradcheck(plan, progress)
    print_report(options, report.as_json(), report.lines(verbose=options.details))
    return 1 if not report.passed else UNEXERCISED if report.unexercised else 0


def _run_mean(options: argparse.Namespace) -> int:
    from estimators import make_estimator
    from mjx_study.diagnose.means import ALONG_MEANS, check_mean, lines_of, path_of
    from mjx_study.diagnose.setting import setting_of
    from mjx_study.experiment.resolution import check_estimators
    from mjx_study.experiment.unused_options import reads_onset, reject_unread
    from mjx_study.gradcheck import plan_gradcheck

    chosen = MEAN | given_options(options, *MEAN)
    with usage_errors():
        configure_process(options)
        task = task_of(options).replace(onset=chosen["onset"])
        plan = plan_gradcheck(task, options.contact, options.stiffness, seed=options.seed, damping=options.damping)
        settings = {name: chosen[name] for name in ("max_norm", "window")}
        settings |= {"gamma": task.defaults.gamma, "sigma": task.sigma}
        found = [make_estimator(name, **settings) for name in chosen["estimators"]]
        check_estimators(found, task)
        reject_unread(chosen["estimators"], given_options(options, "max_norm", "window"))
        if options.onset not in (None, "none") and not reads_onset(chosen["estimators"], options.onset):
            raise UsageError("--onset has no effect on these estimators: add fobg")
        if options.span is not None and options.direction == ALONG_MEANS:
            raise UsageError("--span is for one path, and --direction means chooses its own: omit one of them")
    given = {name: chosen[name] for name in ("samples", "span", "direction")} | {"names": chosen["estimators"]}
    with computing() as progress:
        checks = check_mean(task, plan.cells, found, seed=options.seed, progress=progress, **given)
    document = {"checks": [each.as_dict() for each in checks], "warnings": list(plan.warnings)}
    onset, table = chosen["onset"], lines_of(checks, chosen["onset"])
    lines = [
        f"{options.task}: {chosen['samples']} samples at each node of the path, seed {options.seed}, float64"
        f"{'' if onset == 'none' else f', onset {onset}'}",
        setting_of(options.task, task).line(),
        path_of(task, chosen["span"], chosen["direction"]),
        "",
        *table,
        *(f"warning: {text}" for text in plan.warnings),
    ]
    print_report(options, document, lines)
    verdicts = {each.verdict for each in checks}
    return 1 if "biased" in verdicts else UNEXERCISED if "undecided" in verdicts else 0
