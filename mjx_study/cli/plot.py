"""mjx-study plot."""

import argparse
from pathlib import Path

from mjx_study._matplotlib import matplotlib
from mjx_study.cli.options import Commands, add_command, add_option, attempt, finish, print_report, usage_errors
from mjx_study.disk import prepare_folder
from mjx_study.option import Option
from mjx_study.plots.study import plot_study
from mjx_study.plots.style import FORMATS, STYLES, fit_to_paper, save_figures
from mjx_study.study.run import load_study, warnings_of

FORMAT = Option("format", str, "FORMAT", f"of: {', '.join(FORMATS)}", choices=FORMATS, many=True)
EPILOG = """\
Draws what the study has the numbers for: variance, bias and alpha against stiffness, error against samples, maps over
two swept parameters; of descents, achieved cost against stiffness, and cost against iterations, rollouts and seconds;
of landscapes, costs and slopes. Works while the study is still being computed. --style paper is as wide as a column or
a page, without a title, in 8 point type that is embedded.

examples:
  mjx-study plot out
  mjx-study plot out --output figures
  mjx-study plot out --style paper --format pdf,svg
"""


def add(commands: Commands) -> None:
    """Register the command."""
    command = add_command(commands, "plot", "draw a study's figures", run, EPILOG)
    command.add_argument("folder", type=Path, metavar="FOLDER", help="of a study")
    command.add_argument("--output", type=Path, metavar="DIR", help="default: the study's folder")
    command.add_argument("--style", choices=tuple(STYLES), default="screen", help="default: screen")
    add_option(command, FORMAT, FORMAT.parse("png,pdf"))


def run(options: argparse.Namespace) -> int:
    """Load, draw, write."""
    with usage_errors():
        dataset = load_study(options.folder)
        folder = prepare_folder(options.output or options.folder)
    with matplotlib.rc_context(STYLES[options.style]):
        figures = plot_study(dataset)
        for figure in figures.values() if options.style == "paper" else ():
            fit_to_paper(figure)
        written, unwritten = attempt(lambda: save_figures(figures, folder, options.format))
    warnings = list(warnings_of(dataset))
    document = {"written": [str(path) for path in written], "warnings": warnings}
    names = ", ".join(path.name for path in written if path.suffix == f".{options.format[0]}")
    others = ", ".join(kind.upper() for kind in options.format[1:])
    lines = [f"warning: {message}" for message in warnings]
    if not figures:
        lines.append("nothing to draw yet")
    elif written:
        lines.append(f"written to {folder}: {names}{f' (and as {others})' if others else ''}")
    print_report(options, document, lines)
    return finish(unwritten)
