"""Options of mjx-study estimators."""

import argparse

EPILOG = """\
The second column says what each needs: values (rollouts), pairs (of opposite noise), steps (costs to go), gradients, or
derivatives of every step. compare, optimise and sweep accept any of them in --estimators.
"""


def add(command: argparse.ArgumentParser) -> None:
    """Add no options beyond --json."""
