"""mjx-study compare."""

import argparse
from functools import partial

from estimators.registry import ESTIMATORS
from mjx_study.choices import FAMILIES
from mjx_study.cli.options import study_fields
from mjx_study.options.configuration import StudyConfig
from mjx_study.options.parser import Parser
from mjx_study.results.variables import COLUMNS, DETAILS, GRADIENTS, MARKS, explained
from mjx_study.table import described

EPILOG = f"""\
examples:
  mjx-study compare pusher --stiffness 10,1000 --contact penalty,mujoco_default
  mjx-study compare momentum_transfer --contact mujoco_default --theta 0.5 --estimators zobg,fobg,aobg,ivw --gamma 0.5
  mjx-study compare pusher --theta out/policy-aobg.json    at the end of a descent instead of its start
  mjx-study compare pusher --json > pusher.json

estimators:
{described({item.name: item.description for item in ESTIMATORS.values()})}

contact families (K: from --stiffness):
{described({item.name: item.description for item in FAMILIES.values()})}

columns of the table:
{explained(GRADIENTS, *(name for group in COLUMNS for name in group if name not in DETAILS))}

and with --details:
{explained(GRADIENTS, *DETAILS, "top_share")}

{MARKS}
?: too few effective samples; do not trust the number.
"""


def add(command: Parser) -> None:
    command.add_task_options(many=True)
    command.add_contact_options()
    command.add_theta_option("parameters at which gradients are taken")
    command.add_options("estimators", "reference_samples")
    command.add_option("samples", default=(400,))
    command.add_estimator_options()
    command.add_backward_options()
    command.add_options("confidence", "chunk_size", "block_size")
    command.add_folder_options()
    command.add_cluster_option()
    command.add_flag("--details", "print all columns")


def run(options: argparse.Namespace) -> int:
    from mjx_study.cli.console import gradient_lines, rows_as_json
    from mjx_study.cli.studies import run_one
    from mjx_study.experiment.plan import plan_study
    from mjx_study.experiment.study import StudyPlan

    def planned() -> StudyPlan:
        return plan_study(StudyConfig(**study_fields(options)))

    lines = partial(gradient_lines, details=options.details)
    offer = "figures and the numbers on disk"
    return run_one(options, planned, rows_as_json, lines, offer, thetas=lambda document: {})
