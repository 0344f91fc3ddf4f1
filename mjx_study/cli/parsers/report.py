"""Options of mjx-study report."""

import argparse
from pathlib import Path

EPILOG = """\
Writes FOLDER/report.html: one self-contained page with warnings, figures, a table, the whole configuration, versions
and machine, and the command that made it. Works while the study is still being computed.

example:
  mjx-study report out
"""


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument("folder", type=Path, metavar="FOLDER", help="folder of a study")
    command.add_argument("--output", type=Path, metavar="FILE.html", help="default: FOLDER/report.html")
