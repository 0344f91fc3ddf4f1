"""Options of mjx-study tasks."""

import argparse

EPILOG = ""


def add(command: argparse.ArgumentParser) -> None:
    """Add no options beyond --json."""
