"""Options of mjx-study bench."""

import argparse

from mjx_study.cli.options import add_option, add_task_options
from mjx_study.option import OPTIONS

EPILOG = """\
Rates in one run on this machine: rollouts and gradients, against jax.grad through mjx.step (with the one solver
iteration that it can differentiate) and against the C engine's centred mjd_transitionFD with an adjoint, on as many
threads.
"""


def add(command: argparse.ArgumentParser) -> None:
    add_task_options(command)
    add_option(command, OPTIONS["samples"], 1000)
