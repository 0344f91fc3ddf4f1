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
  mjx-study landscape ball_wall --output out             the whole range of launch angles, reference and MJX
  mjx-study landscape momentum_transfer --contact penalty,mujoco_default --stiffness 3000,100000
  mjx-study landscape pusher --direction 0 --span=-2,2   the first of 200 forces

Top row of the figure: the cost without noise, and the mean cost with noise (the smoothed objective) with a 95 % band.
Bottom row: the means of ZoBG and FoBG along the line, with 95 % bands. Where the smoothed objective has a slope that
the mean of FoBG lacks, the cost jumps: first-order gradients do not see jumps.

For a scalar initial-state parameter with a fixed start, both slopes are also computed without sampling error, by
quadrature over 1500 rollouts and gradients per contact model (more if --noise has heavy tails), whatever --points and
--samples.
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
    command.add_argument("--no-reference", action="store_true", help="omit the analytic reference")
    add_folder_options(command)
