"""mjx-study landscape."""

import argparse

from mjx_study.choices import REFERENCE
from mjx_study.cli.options import given_options, study_fields
from mjx_study.options.configuration import BUILDER_OPTIONS, REQUIRED_OPTIONS, StudyConfig
from mjx_study.options.option import OptionError
from mjx_study.options.parser import MIDDLE, Parser
from mjx_study.results.variables import LANDSCAPES, explained

EPILOG = f"""\
examples:
  mjx-study landscape ball_wall --output out             the whole range of launch angles, reference and MJX
  mjx-study landscape momentum_transfer --contact penalty,mujoco_default --stiffness 3000,100000
  mjx-study landscape pusher --direction 0 --span=-2,2   the first of 200 forces

columns of the table:
{explained(LANDSCAPES, "least_cost", "least_at", "steepest", "nonfinite")}

The figure shows costs above, and slopes below, with 95 % bands. Where the mean cost with noise has a slope that the
mean of FoBG lacks, the cost jumps: first-order gradients do not see jumps.

For a scalar initial-state parameter with a fixed start, both slopes are also computed without sampling error, by
quadrature over 1500 rollouts and gradients per contact model (more if --noise has heavy tails), independently of
--points and --samples.
"""


def add(command: Parser) -> None:
    command.add_task_options(many=True)
    command.add_contact_options(MIDDLE)
    command.add_theta_option("parameters that the line goes through")
    command.add_option("estimators", default=("zobg", "fobg"))
    command.add_option("samples", default=(100,))
    command.add_option("points", default=41)
    command.add_options("span", "direction", "noise", "gamma", *REQUIRED_OPTIONS, "onset", "chunk_size")
    command.add_backward_options()
    command.add_flag("--no-reference", "omit the analytic reference")
    command.add_folder_options()


def run(options: argparse.Namespace) -> int:
    from mjx_study.cli.console import curve_lines, curves
    from mjx_study.cli.studies import run_one
    from mjx_study.experiment.plan import plan_study
    from mjx_study.experiment.study import StudyPlan
    from mjx_study.tasks import task_with_options

    def planned() -> StudyPlan:
        """Every contact family of the task, and its analytic reference if it has one."""
        fields = study_fields(options)
        task = task_with_options(options.task, given_options(options, *BUILDER_OPTIONS))
        fields.setdefault("contact", task.defaults.families)
        if options.no_reference and REFERENCE in fields["contact"]:
            raise OptionError("contact", f"{REFERENCE} is what --no-reference omits: omit one of them")
        if not options.no_reference and task.reference is not None and fields.get("onset", "none") == "none":
            fields["contact"] = tuple(dict.fromkeys((REFERENCE, *fields["contact"]))) if fields["contact"] else ()
        return plan_study(StudyConfig(**fields, kind="landscapes"), {options.task: task}, single=True)

    return run_one(options, planned, curves, curve_lines, "a figure and the numbers")
