"""Options of mjx-study diagnose."""

import argparse

from mjx_study.cli.options import add_contact_options, add_option, add_task_options
from mjx_study.option import OPTIONS

EPILOG = """\
examples:
  mjx-study diagnose momentum_transfer --contact mujoco_default
  mjx-study diagnose robot.xml                 no cost is needed: one is made from the bodies' positions

columns of the contacts:
  h b, h^2 k     damping and stiffness of the contact over one step h; the step is unstable if h^2 k >= 4 - 2 h b
  h v / width    travel per step over the depth over which the impedance rises
  impedance      at first touch: 0 is a smooth onset; MuJoCo's default, 0.9, is a jump, which biases first order

The error after a second of computing is that of a gradient from as many samples as this machine computes in a second:
bias and standard deviation combined, relative to the gradient. "mean" says whether an estimator's mean integrates to
the difference of the mean cost along a path, as in gradcheck --mean: right within 5 %, off by the stated amount, or
undecided. There are at least 23 samples. Exit code 1 if a derivative is wrong.
"""


def add(command: argparse.ArgumentParser) -> None:
    add_task_options(command)
    add_contact_options(command, "the middle one of the task's", many=False, analytic=False)
    add_option(command, OPTIONS["samples"], unset="500, or as many as fit into a minute")
