"""Options of mjx-study diagnose."""

import argparse

from mjx_study.cli.options import add_contact_options, add_option, add_task_options
from mjx_study.option import OPTIONS

EPILOG = """\
examples:
  mjx-study diagnose momentum_transfer --contact mujoco_default
  mjx-study diagnose robot.xml                 no cost is needed: it is made of where the bodies go

columns of the contacts:
  h b, h^2 k     damping and stiffness of the contact over one step h; the step is unstable from h^2 k = 4 - 2 h b on
  h v / width    travel in a step over the depth in which the impedance rises
  impedance      at first touch: 0 sets in smoothly, MuJoCo's default 0.9 with a jump, which biases first order

The error after a second of computing is that of one gradient, of as many samples as a second has room for on this
machine: bias and standard deviation, relative to the gradient. "mean" says whether an estimator's mean integrates to
the difference of the mean cost along a path, as gradcheck --mean does: right within 5 %, biased by so much, or
undecided. Without --samples there are 500, or as many as a minute has room for, but 23 at least. Exit code 1 if a
derivative is wrong.
"""


def add(command: argparse.ArgumentParser) -> None:
    add_task_options(command)
    add_contact_options(command, "the middle one of the task's", many=False, analytic=False)
    add_option(command, OPTIONS["samples"])
