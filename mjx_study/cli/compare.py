"""mjx-study compare."""

import argparse
import json
import sys

from mjx_study.cli.console import gradients_as_json, print_gradients
from mjx_study.cli.options import configure_process, finish, usage_errors
from mjx_study.cli.parameters import theta_of
from mjx_study.cli.studies import announce, compute, draw, study_fields
from mjx_study.study.configuration import StudyConfig
from mjx_study.study.plan import plan_study
from mjx_study.study.run import warnings_of


def run(options: argparse.Namespace) -> int:
    """Compare, print, and write where an output folder is given."""
    with usage_errors():
        configure_process(options)
        plan = plan_study(StudyConfig(**study_fields(options), tasks=(options.task,), theta=theta_of(options), seeds=1))
    if options.dry_run:
        return announce(plan, options)
    dataset, unwritten = compute(plan, options)
    written, undrawn = draw(dataset, options.output, unwritten)
    if options.json:
        print(json.dumps(gradients_as_json(dataset), allow_nan=False))
        for warning in warnings_of(dataset):
            print(f"warning: {warning}", file=sys.stderr)
    else:
        print_gradients(dataset)
        if written:
            print(f"written to {options.output}: {', '.join(path.name for path in written)}")
        elif options.output is None:
            print("add --output DIR for figures and the numbers on disk")
    return finish(unwritten, undrawn)
