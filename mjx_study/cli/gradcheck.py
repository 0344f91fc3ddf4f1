"""mjx-study gradcheck."""

import argparse
import dataclasses

from mjx_study.choices import CHECKED_STATES, CHECKED_STEPS, CHECKED_STIFFNESS, is_file
from mjx_study.cli.options import configure_process, given_options, task_at_theta, usage_errors
from mjx_study.cli.output import computing, print_report
from mjx_study.diagnose.columns import MEANS
from mjx_study.options.configuration import OPTIONS, REQUIRED_OPTIONS
from mjx_study.options.option import Option, OptionError, check_span, reject_unused
from mjx_study.options.parser import Parser
from mjx_study.table import explain

UNEXERCISED = 3
"""Exit code if nothing is wrong but something was never exercised."""
PAIR = Option("pair", str, "GEOM,GEOM", "for files: pair of geoms that the stiffness is for", many=True)
STATES = Option("states", int, "N", "states to check", "[1, 1000]", unset=str(CHECKED_STATES))
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
differs from mjx.step or, for no documented reason, from the C engine, which contact laws other than MuJoCo's are not
compared with. 3: right, but something that the model has and can reach was never exercised. Kinks and jumps are
properties of the step, and differently placed contacts are not derivative errors: both are reported but do not fail.

With --mean: does an estimator's mean integrate to the difference of the mean cost along a path through theta? No
reference gradient is needed. Exit code 0: all are right. 1: one is biased. 3: undecided. Columns:
{explain(*MEANS)}
"""
MEAN_OPTIONS = {
    option.name: option
    for option in (
        dataclasses.replace(OPTIONS["estimators"], default=("zobg", "fobg")),
        OPTIONS["onset"],
        dataclasses.replace(
            OPTIONS["samples"], many=False, interval="[2, 1e7]", default=1000, line="samples at each node of the path"
        ),
        dataclasses.replace(OPTIONS["sigma"], many=False),
        dataclasses.replace(OPTIONS["span"], line="range of the path", unset="two sigma about theta"),
        dataclasses.replace(
            OPTIONS["direction"], default="random", line="random, a parameter's index, or means: paths that these span"
        ),
        *(OPTIONS[name] for name in REQUIRED_OPTIONS),
    )
}
"""Options of --mean."""
DERIVATIVES = ("states", "stock", "pair", "details")
"""Options that --mean does not read."""


def add(command: Parser) -> None:
    command.add_task_argument()
    usual = ",".join(f"{each:g}" for each in CHECKED_STIFFNESS)
    families = "penalty,mujoco,mujoco_default; mjcf without contact_pair, as for a file"
    command.add_contact_options(f"{usual}, or the task's if stiffer", families, analytic=False)
    command.add_option(PAIR)
    command.add_builder_options(horizon={"unset": f"the task's; {CHECKED_STEPS} for a file"})
    command.add_theta_option("parameters whose rollout is checked")
    command.add_option(STATES)
    command.add_flag("--stock", "also check the derivative of mjx.step itself")
    command.add_flag("--mean", "check the means of estimators instead of derivatives")
    for option in MEAN_OPTIONS.values():
        command.add_option(option, filled=False, line=f"with --mean: {option.line}")
    command.add_flag("--details", "print every entry of every finding")
    command.add_process_options()


def run(options: argparse.Namespace) -> int:
    from mjx_study.gradcheck import gradcheck, plan_gradcheck, plan_scene_gradcheck

    with usage_errors():
        reject_unused(
            given_options(options, *MEAN_OPTIONS, *DERIVATIVES, "theta"),
            (DERIVATIVES, not options.mean, "is for derivatives of steps: omit it, or --mean"),
            (MEAN_OPTIONS, options.mean, "is for --mean"),
            (["pair"], is_file(options.task), "is for files: a task has a pair of geoms already"),
            (
                ["theta"],
                options.mean or not is_file(options.task),
                "is for a task, or for --mean: a file has no policy",
            ),
        )
    if options.mean:
        return _run_mean(options)
    common = {"seed": options.seed or 0, "damping": options.damping}
    common |= {"smoothing": options.smoothing, "stock": options.stock}
    common["states"] = options.states or CHECKED_STATES
    with usage_errors():
        configure_process(options)
        task = task_at_theta(options)
        if not is_file(options.task):
            plan = plan_gradcheck(task, options.contact, options.stiffness, **common)
        else:
            if options.pair is not None and len(options.pair) != 2:
                raise OptionError("pair", f"takes the names of two geoms, got {len(options.pair)}")
            common |= {"pair": options.pair, "horizon": task.horizon}
            plan = plan_scene_gradcheck(task.scene, options.contact, options.stiffness, **common)
    with computing() as progress:
        report = gradcheck(plan, progress)
    print_report(options, report.as_json(), report.lines(verbose=options.details))
    return 1 if not report.passed else UNEXERCISED if report.unexercised else 0


def _run_mean(options: argparse.Namespace) -> int:
    from mjx_study.diagnose.means import ALONG_MEANS, check_mean, lines_of, path_of
    from mjx_study.diagnose.setting import setting_of
    from mjx_study.experiment.resolution import direction_of, make_estimators, reads_onset, reject_unread
    from mjx_study.gradcheck import plan_gradcheck

    chosen = {name: option.default for name, option in MEAN_OPTIONS.items()} | given_options(options, *MEAN_OPTIONS)
    names, onset, seed = chosen["estimators"], chosen["onset"], options.seed or 0
    with usage_errors():
        configure_process(options)
        task = task_at_theta(options).replace(onset=onset)
        given = {"damping": options.damping, "smoothing": options.smoothing}
        plan = plan_gradcheck(task, options.contact, options.stiffness, seed=seed, **given)
        settings = {name: chosen[name] for name in REQUIRED_OPTIONS}
        found = make_estimators(names, settings | {"gamma": task.defaults.gamma}, task)
        reject_unread(names, given_options(options, *REQUIRED_OPTIONS))
        check_span(chosen["span"])
        if chosen["direction"] != ALONG_MEANS:
            direction_of(chosen["direction"], task.policy.num_params, seed)
        reject_unused(
            given_options(options, "onset", "span"),
            (["onset"], onset == "none" or reads_onset(names, onset), "has no effect on these estimators: add fobg"),
            (["span"], chosen["direction"] != ALONG_MEANS, "is for one path, and --direction means chooses several"),
        )
    given = {name: chosen[name] for name in ("samples", "span", "direction")} | {"names": names}
    with computing() as progress:
        checks = check_mean(task, plan.cells, found, seed=seed, progress=progress, **given)
    document = {"checks": [each.as_dict() for each in checks], "warnings": list(plan.warnings)}
    lines = [
        f"{options.task}: {chosen['samples']} samples at each node of the path, seed {seed}, float64"
        f"{'' if onset == 'none' else f', onset {onset}'}",
        setting_of(options.task, task).line(),
        path_of(task, chosen["span"], chosen["direction"]),
        "",
        *lines_of(checks, onset),
        *(f"warning: {text}" for text in plan.warnings),
    ]
    print_report(options, document, lines)
    verdicts = {each.verdict for each in checks}
    return 1 if "biased" in verdicts else UNEXERCISED if "undecided" in verdicts else 0
