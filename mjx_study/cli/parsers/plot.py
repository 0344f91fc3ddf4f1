"""Options of mjx-study plot."""

import argparse
from pathlib import Path

from mjx_study.choices import FIGURE_FORMATS, FIGURE_STYLES
from mjx_study.cli.options import add_option
from mjx_study.option import Option

FORMAT = Option("format", str, "FORMAT", f"of: {', '.join(FIGURE_FORMATS)}", choices=FIGURE_FORMATS, many=True)
EPILOG = """\
Draws whatever the study has numbers for: variance, bias and alpha against stiffness, error against samples, maps over
two swept parameters; for descents, achieved cost against stiffness, and cost against iterations, rollouts and seconds;
for landscapes, costs and slopes. Works while the study is still being computed. --style paper gives column or page
width, no title, and embedded 8-point type.

examples:
  mjx-study plot out
  mjx-study plot out --output figures
  mjx-study plot out --style paper --format pdf,svg
"""


def add(command: argparse.ArgumentParser) -> None:
    command.add_argument("folder", type=Path, metavar="FOLDER", help="folder of a study")
    command.add_argument("--output", type=Path, metavar="DIR", help="default: the study's folder")
    command.add_argument("--style", choices=FIGURE_STYLES, default="screen", help="default: screen")
    add_option(command, FORMAT, FORMAT.parse("png,pdf"))
