"""Options of mjx-study landscape."""

import argparse

from mjx_study.cli.options import (
    add_backward_options,
    add_contact_options,
    add_folder_options,
    add_option,
    add_options,
    add_process_options,
    add_task_argument,
    add_theta_option,
)
from mjx_study.option import OPTIONS
from mjx_study.study.configuration import StudyConfig

POINTS, SAMPLES = 41, (100,)
ESTIMATORS = ("zobg", "fobg")
EPILOG = """\
examples:
  mjx-study landscape ball_wall --output out             the launch angle's whole range, reference and MJX
  mjx-study landscape momentum_transfer --contact penalty,mujoco_default --stiffness 3000,100000
  mjx-study landscape pusher --direction 0 --span=-2,2   the first of 200 forces

Top row of the figure: the cost without noise, and the mean cost with noise (its smoothed objective) with a 95 % band.
Bottom row: the mean of ZoBG and of FoBG along the line, with theirs. Where the smoothed objective has a slope that the
mean of FoBG does not have, the cost jumps: a first-order gradient does not see jumps.

The scalar parameter of an initial-state policy with a fixed start also gets both slopes without sampling error, by
quadrature over 1500 rollouts and gradients of each contact model (more where --noise has heavy tails), whatever
--points and --samples.
"""


def add(command: argparse.ArgumentParser) -> None:
    add_task_argument(command)
    add_options(command, StudyConfig, "sigma", "cone", "horizon", "model", "noise")
    add_process_options(command)
    add_contact_options(command, "the middle one of the task's sweep")
    add_theta_option(command, "parameters that the line goes through")
    add_option(command, StudyConfig.option("estimators"), ESTIMATORS)
    add_option(command, StudyConfig.option("samples"), SAMPLES)
    add_option(command, OPTIONS["points"], POINTS)
    add_options(command, StudyConfig, "span", "direction", "onset", "chunk_size")
    add_backward_options(command)
    command.add_argument("--no-reference", action="store_true", help="leave out the analytic reference")
    add_folder_options(command)
