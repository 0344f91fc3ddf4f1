"""mjx-study compare."""

import argparse
from functools import partial

from mjx_study.cli.console import gradient_lines, rows_as_json
from mjx_study.cli.studies import run_one, study_fields
from mjx_study.study.configuration import StudyConfig
from mjx_study.study.plan import StudyPlan, plan_study


def run(options: argparse.Namespace) -> int:
    lines = partial(gradient_lines, details=options.details)
    return run_one(options, _plan, rows_as_json, lines, "figures and the numbers on disk")


def _plan(options: argparse.Namespace) -> StudyPlan:
    return plan_study(StudyConfig(**study_fields(options), seeds=1))
