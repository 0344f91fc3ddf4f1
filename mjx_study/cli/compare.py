"""mjx-study compare."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from estimators import ESTIMATORS
from mjx_study.cli.console import alarms, print_comparison
from mjx_study.cli.options import (
    Commands,
    add_command,
    add_contact_options,
    add_estimator_options,
    add_options,
    add_task_options,
    attempt,
    computing,
    configure_process,
    finish,
    usage_errors,
)
from mjx_study.cli.parameters import add_theta_option, theta_of
from mjx_study.disk import prepare_folder
from mjx_study.plots.comparison import plot_comparison, save_figure
from mjx_study.simulation.contact import FAMILIES
from mjx_study.study.comparison import CompareConfig
from mjx_study.study.gradients import compare, plan_compare
from mjx_study.study.results import as_json, save

EXAMPLES = """\
examples:
  mjx-study compare pusher --stiffness 10,1000 --contact penalty,mujoco_default
  mjx-study compare pusher --estimators zobg,fobg,aobg,ivw --gamma 50 --samples 1000
  mjx-study compare pusher --theta out/policy-aobg.json    where a descent ended, in place of where it begins
  mjx-study compare pusher --json > pusher.json

estimators:
{estimators}

contact families (K: from --stiffness):
{families}

columns of the table:
  variance        trace of the sample covariance of one gradient sample, with a jackknife interval
  effective (top) samples that this variance rests on, and the share of it that the largest one carries
  relative error  distance of the mean to a reference gradient, over the norm of the reference
  -> debiased     the same without the noise of the two means, which adds to an error and takes from a cosine;
                  - where noise is all there is
  ?               fewer than three effective samples: do not believe the number
  alpha           weight of the first-order batch in AoBG
  epsilon, B      confidence radius of the zeroth-order mean; distance between the two means
  residual        largest relative imbalance left by MuJoCo's constraint solver
  ms              computing time of one sample in milliseconds, compilation excluded
  variance x s    variance times that time: the variance that a second of computing leaves
  lost            samples that overflowed or became NaN; they are left out, and a warning says so
"""
FIELDS = (
    "task stiffness contact estimators samples reference_samples sigma seed baseline gamma published "
    "failure_probability variance_proxy radius confidence damping cone horizon model chunk_size noise max_norm window "
    "tolerance weights onset"
).split()


def add(commands: Commands) -> None:
    """Register the command."""
    epilog = EXAMPLES.format(
        estimators="\n".join(f"  {item.name:<21} {item.description}" for item in ESTIMATORS.values()),
        families="\n".join(f"  {item.name:<15} {item.description}" for item in FAMILIES.values()),
    )
    command = add_command(commands, "compare", "compare gradient estimators over contact models", run, epilog)
    add_task_options(command, CompareConfig)
    add_contact_options(command, CompareConfig)
    add_theta_option(command, "parameters at which gradients are taken")
    add_options(command, CompareConfig, "estimators", "samples", "reference_samples")
    add_estimator_options(command, CompareConfig)
    add_options(command, CompareConfig, "confidence", "chunk_size")
    command.add_argument("--output", type=Path, metavar="DIR", help="write the figure and the numbers to this folder")


def run(options: argparse.Namespace) -> int:
    """Compare, print, and write where an output folder is given."""
    with usage_errors():
        configure_process(options)
        fields: dict[str, Any] = {name: getattr(options, name) for name in FIELDS} | {"theta": theta_of(options)}
        config = CompareConfig(**{name: value for name, value in fields.items() if value is not None})
        plan = plan_compare(config)
        folder = None if options.output is None else prepare_folder(options.output)
    with computing() as progress:
        result = compare(plan, progress)
    written, unwritten = [], None
    if folder is not None:
        written, unwritten = attempt(
            lambda folder=folder: save(result, folder) + save_figure(plot_comparison(result), folder, "comparison")
        )
    if options.json:
        print(json.dumps(as_json(result), allow_nan=False))
        for warning in alarms(result):
            print(f"warning: {warning}", file=sys.stderr)
    else:
        print_comparison(result)
        if written:
            print(f"written: {', '.join(map(str, written))}")
        elif folder is None:
            print("add --output DIR for a figure and the numbers on disk")
    return finish(unwritten)
