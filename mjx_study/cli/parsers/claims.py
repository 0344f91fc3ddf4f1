"""Options of mjx-study claims."""

import argparse
from pathlib import Path

from mjx_study.cli.options import add_option
from mjx_study.option import OPTIONS

EPILOG = """\
Each claim has a statistic, the values with which it holds, and those with which its opposite does.
Its interval decides: holds, fails, reversed, or undecided, with the number of samples that would decide. The intervals
of the whole ledger hold at once with probability 95 % (Bonferroni), whichever claims are run.

With --output, measurements are kept as they are made: a run that is stopped goes on, and a claim whose definition or
code has changed is measured again. The folder gets claims.json, claims.md and claims.png.

examples:
  mjx-study claims --quick --output out
  mjx-study claims --only lemma-closed-form,friction-variance
"""


def add(command: argparse.ArgumentParser) -> None:
    """Add them."""
    effort = command.add_mutually_exclusive_group()
    effort.add_argument("--quick", dest="effort", action="store_const", const="quick", help="minutes; the default")
    effort.add_argument("--full", dest="effort", action="store_const", const="full", help="hours, narrower intervals")
    command.set_defaults(effort="quick")
    command.add_argument(
        "--only", action="append", metavar="ID[,ID]", help="these claims; may be repeated (default: all of them)"
    )
    command.add_argument("--output", type=Path, metavar="DIR", help="folder of the ledger; resumable")
    command.add_argument("--list", action="store_true", help="print the claims and what decides them; measure nothing")
    command.add_argument(
        "--accept-versions", action="store_true", help="go on with studies in DIR that other versions began"
    )
    add_option(command, OPTIONS["devices"])
