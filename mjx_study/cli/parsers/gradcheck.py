"""Options of mjx-study gradcheck."""

import argparse
import dataclasses

from mjx_study.choices import CHECKED_STATES, CHECKED_STEPS, CHECKED_STIFFNESS
from mjx_study.cli.options import (
    add_contact_options,
    add_option,
    add_process_options,
    add_scene_options,
    add_task_argument,
)
from mjx_study.option import OPTIONS, Option

PAIR = Option("pair", str, "GEOM,GEOM", "for files: pair of geoms that the stiffness is for", many=True)
EPILOG = """\
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
reference gradient is needed. Columns: that difference; the integral minus it (the gap), the half-width of its 99.9 %
interval, and the quadrature's part of that; the gap as a share of the difference, and the smallest share certain to be
detected. "Right" is within 5 %. Exit code 0: all are right. 1: one is biased. 3: undecided, too few samples.
"""
MEAN = {
    "estimators": ("zobg", "fobg"),
    "onset": "none",
    "samples": 1000,
    "sigma": None,
    "span": None,
    "direction": "random",
}
"""Options of --mean, with their defaults."""


def add(command: argparse.ArgumentParser) -> None:
    add_task_argument(command)
    usual = ",".join(f"{each:g}" for each in CHECKED_STIFFNESS)
    add_contact_options(command, analytic=False, stiffness=f"{usual}, or the task's if stiffer")
    add_option(command, PAIR)
    add_option(command, OPTIONS["cone"])
    add_scene_options(command)
    add_option(command, OPTIONS["iterations"], line="iterations of the solver", unset="the MJCF's")
    add_option(command, OPTIONS["ls_iterations"])
    add_option(command, OPTIONS["horizon"], unset=f"the task's; {CHECKED_STEPS} for a file")
    add_option(command, OPTIONS["model"])
    add_option(command, OPTIONS["states"], CHECKED_STATES)
    command.add_argument("--stock", action="store_true", help="also check the derivative of mjx.step itself")
    command.add_argument("--mean", action="store_true", help="check the means of estimators instead of derivatives")
    for name, default in MEAN.items():
        option = dataclasses.replace(OPTIONS[name], line=f"with --mean: {OPTIONS[name].line}")
        if name == "span":
            option = dataclasses.replace(option, many=True, unset="two sigma about theta")
        if name == "direction":
            option = dataclasses.replace(option, line=f"{option.line}; or means: three paths that the means span")
        if name == "estimators":
            option = dataclasses.replace(option, many=True)
        add_option(command, option, default, given=False)
    command.add_argument("--verbose", action="store_true", help="print every entry of every finding")
    add_process_options(command)
