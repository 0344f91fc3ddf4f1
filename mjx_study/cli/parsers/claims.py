"""Options of mjx-study claims."""

import argparse
from pathlib import Path

from mjx_study.cli.options import add_option
from mjx_study.option import OPTIONS

EPILOG = """\
Each claim has a statistic, a range of values for which the claim holds, and a range for which its opposite holds. The
statistic's confidence interval decides: holds, fails, reversed, or undecided, with the number of samples that would
decide. All intervals hold at once with probability 95 % (Bonferroni), whichever claims are run.

With --output, measurements are saved as they are made: a stopped run can be resumed, and a claim whose definition or
code has changed is measured again. The folder also gets claims.json, claims.md and claims.png.

examples:
  mjx-study claims --quick --output out
  mjx-study claims --only lemma-closed-form,friction-variance
"""


def add(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    effort = command.add_mutually_exclusive_group()
    effort.add_argument("--quick", dest="effort", action="store_const", const="quick", help="minutes (default)")
    effort.add_argument("--full", dest="effort", action="store_const", const="full", help="hours; narrower intervals")
    command.set_defaults(effort="quick")
    command.add_argument(
        "--only", action="append", metavar="ID[,ID]", help="run only these claims; may be repeated (default: all)"
    )
    command.add_argument("--output", type=Path, metavar="DIR", help="folder for measurements and verdicts; resumable")
    command.add_argument("--list", action="store_true", help="print the claims and their criteria; measure nothing")
    command.add_argument(
        "--accept-versions", action="store_true", help="resume studies in DIR begun by other versions of the software"
    )
    add_option(command, OPTIONS["devices"])
