"""Options of mjx-study compare."""

import argparse

from estimators.catalogue import CATALOGUE
from mjx_study.choices import FAMILIES
from mjx_study.cli.options import (
    add_backward_options,
    add_cluster_option,
    add_contact_options,
    add_estimator_options,
    add_folder_options,
    add_option,
    add_options,
    add_process_options,
    add_task_argument,
    add_theta_option,
)
from mjx_study.study.configuration import StudyConfig

SAMPLES = (400,)
EPILOG = (
    """\
examples:
  mjx-study compare pusher --stiffness 10,1000 --contact penalty,mujoco_default
  mjx-study compare momentum_transfer --contact mujoco_default --theta 0.5 --estimators zobg,fobg,aobg,ivw --gamma 0.5
  mjx-study compare pusher --theta out/policy-aobg.json    at the end of a descent instead of its start
  mjx-study compare pusher --json > pusher.json

estimators:
"""
    + "\n".join(f"  {item.name:<21} {item.description}" for item in CATALOGUE.values())
    + """

contact families (K: from --stiffness):
"""
    + "\n".join(f"  {item.name:<15} {item.description}" for item in FAMILIES.values())
    + """

columns of the table:
  variance        trace of the sample covariance of one gradient sample, with a jackknife interval
  relative error  distance of the mean to a reference gradient, over the norm of the reference
  -> debiased     the same without the sampling noise of batch and reference, ± one standard error; < and >: no error
                  is detected, these are bounds of two standard errors; -: noise explains all of it
  ?               fewer than three effective samples: do not trust the number
  alpha           weight of the first-order batch in AoBG
  ms              computing time of one sample in milliseconds, compilation excluded
  variance x s    variance times that time: the variance left after one second of computing

and with --details:
  |gradient|      norm of the mean gradient
  effective (top) effective number of samples behind the variance, and the share of the largest
  cosine          between mean and reference gradient, and the same debiased; for several parameters
  epsilon, B      confidence radius of the zeroth-order mean; distance between the two means
  residual        largest relative residual of MuJoCo's constraint solver
  nan             samples that overflowed or became NaN; they are left out, with a warning
"""
)


def add(command: argparse.ArgumentParser) -> None:
    add_task_argument(command)
    add_options(command, StudyConfig, "sigma", "cone", "horizon", "model", "timestep")
    add_process_options(command)
    add_contact_options(command)
    add_theta_option(command, "parameters at which gradients are taken")
    add_options(command, StudyConfig, "estimators", "reference_samples", reference_samples={"unset": "600"})
    add_option(command, StudyConfig.option("samples"), SAMPLES)
    add_estimator_options(command, StudyConfig)
    add_backward_options(command)
    add_options(command, StudyConfig, "confidence", "chunk_size", "block_size")
    add_folder_options(command)
    add_cluster_option(command)
    command.add_argument("--details", action="store_true", help="print all columns")
