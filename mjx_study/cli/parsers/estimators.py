"""Options of mjx-study estimators."""

import argparse

EPILOG = """\
What each needs: values (rollouts), pairs (of opposite noise), steps (costs to go), gradients, or derivatives of every
step. compare and optimise take any of them with --estimators and --estimator.
"""


def add(command: argparse.ArgumentParser) -> None:
    """None but --json."""
