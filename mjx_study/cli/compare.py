"""mjx-study compare."""

import argparse
import json
import sys

from estimators import ESTIMATORS
from mjx_study.cli.console import alarms, gradients_as_json, print_gradients
from mjx_study.cli.options import (
    Commands,
    add_command,
    add_contact_options,
    add_estimator_options,
    add_option,
    add_options,
    add_process_options,
    add_task_argument,
    configure_process,
    finish,
    usage_errors,
)
from mjx_study.cli.parameters import add_theta_option, theta_of
from mjx_study.cli.studies import add_folder_options, compute, draw, study_fields
from mjx_study.simulation.contact import FAMILIES
from mjx_study.study.configuration import StudyConfig
from mjx_study.study.plan import plan_study

SAMPLES = (400,)
EXAMPLES = """\
examples:
  mjx-study compare pusher --stiffness 10,1000 --contact penalty,mujoco_default
  mjx-study compare pusher --estimators zobg,fobg,aobg,ivw --gamma 1000 --samples 1000
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
  nan             samples that overflowed or became NaN; they are left out, and a warning says so
"""


def add(commands: Commands) -> None:
    """Register the command."""
    epilog = EXAMPLES.format(
        estimators="\n".join(f"  {item.name:<21} {item.description}" for item in ESTIMATORS.values()),
        families="\n".join(f"  {item.name:<15} {item.description}" for item in FAMILIES.values()),
    )
    command = add_command(commands, "compare", "compare gradient estimators over contact models", run, epilog)
    add_task_argument(command)
    add_options(command, StudyConfig, "sigma", "cone", "horizon", "model", "timestep")
    add_process_options(command)
    add_contact_options(command)
    add_theta_option(command, "parameters at which gradients are taken")
    add_options(command, StudyConfig, "estimators", "reference_samples", reference_samples={"unset": "600"})
    add_option(command, StudyConfig.option("samples"), SAMPLES)
    add_estimator_options(command, StudyConfig)
    add_options(command, StudyConfig, "confidence", "chunk_size")
    add_folder_options(command)


def run(options: argparse.Namespace) -> int:
    """Compare, print, and write where an output folder is given."""
    with usage_errors():
        configure_process(options)
        plan = plan_study(StudyConfig(**study_fields(options), tasks=(options.task,), theta=theta_of(options), seeds=1))
    dataset, unwritten = compute(plan, options)
    written, undrawn = draw(dataset, options.output, unwritten)
    if options.json:
        print(json.dumps(gradients_as_json(dataset), allow_nan=False))
        for warning in alarms(dataset):
            print(f"warning: {warning}", file=sys.stderr)
    else:
        print_gradients(dataset)
        if written:
            print(f"written to {options.output}: {', '.join(path.name for path in written)}")
        elif options.output is None:
            print("add --output DIR for figures and the numbers on disk")
    return finish(unwritten, undrawn)
