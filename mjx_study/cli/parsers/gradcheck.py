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

PAIR = Option("pair", str, "GEOM,GEOM", "contact of a file that a stiffness is for", many=True)
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
and can reach was never exercised. Kinks and jumps are properties of the step, and contacts placed differently are no error of a
derivative: they are reported, and do not fail.

With --mean: does the mean of an estimator integrate to the difference of the mean cost along a path through theta? It
needs no reference gradient. Columns: that difference; the integral less it, the half width of its 99.9 % interval, and
the quadrature's part of that; the gap as a share of the difference, and the least share that would be found for sure.
"Right" is within 5 %. Exit code 0: all are right. 1: one is biased. 3: none is seen to be, and samples are too few.
"""
MEAN = {
    "estimators": ("zobg", "fobg"),
    "onset": "none",
    "samples": 1000,
    "sigma": None,
    "span": None,
    "direction": "random",
}
"""Options of --mean, and their defaults."""


def add(command: argparse.ArgumentParser) -> None:
    add_task_argument(command)
    usual = ",".join(f"{each:g}" for each in CHECKED_STIFFNESS)
    add_contact_options(command, analytic=False, stiffness=f"{usual}, or the task's where that is stiffer")
    add_option(command, PAIR)
    add_option(command, OPTIONS["cone"])
    add_scene_options(command)
    add_option(command, OPTIONS["iterations"], line="of the solver", unset="the MJCF's")
    add_option(command, OPTIONS["ls_iterations"])
    add_option(command, OPTIONS["horizon"], unset=f"the task's; of a file {CHECKED_STEPS}")
    add_option(command, OPTIONS["model"])
    add_option(command, OPTIONS["states"], CHECKED_STATES)
    command.add_argument("--stock", action="store_true", help="check the derivative of mjx.step itself, too")
    command.add_argument("--mean", action="store_true", help="check the means of estimators in place of derivatives")
    for name, default in MEAN.items():
        option = dataclasses.replace(OPTIONS[name], line=f"with --mean: {OPTIONS[name].line}")
        if name == "span":
            option = dataclasses.replace(option, many=True, unset="two sigma about theta")
        if name == "direction":
            option = dataclasses.replace(option, line=f"{option.line}; or means: three paths that the means span")
        if name == "estimators":
            option = dataclasses.replace(option, many=True)
        add_option(command, option, default, given=False)
    command.add_argument("--verbose", action="store_true", help="every entry of every finding")
    add_process_options(command)
