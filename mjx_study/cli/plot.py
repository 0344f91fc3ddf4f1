"""mjx-study plot."""

import argparse
from pathlib import Path

from mjx_study.choices import FIGURE_FORMATS, FIGURE_STYLES
from mjx_study.cli.options import usage_errors
from mjx_study.cli.output import attempt, print_report
from mjx_study.options.option import Option, OptionError
from mjx_study.options.parser import Parser

FORMAT = Option("format", str, "FORMAT", "of: {}", choices=FIGURE_FORMATS, many=True, default=("png", "pdf"))
EPILOG = """\
Draws the figures for which the study has numbers, at most 12 of a kind: variance, bias and alpha against stiffness,
error against samples, a map over stiffness and another swept parameter; for descents, achieved cost against stiffness,
and cost against iterations, rollouts and seconds; for landscapes, costs and slopes. Works while the study is still
being computed. --style paper gives column or page width, no title, and embedded 8-point type.

examples:
  mjx-study plot out
  mjx-study plot out --output figures
  mjx-study plot out --style paper --format pdf,svg
"""


def add(command: Parser) -> None:
    command.add_argument("folder", type=Path, metavar="FOLDER", help="folder of a study")
    command.add_argument("--output", type=Path, metavar="DIR", help="default: the study's folder")
    command.add_argument("--style", choices=FIGURE_STYLES, default="screen", help="default: screen")
    command.add_option(FORMAT)


def run(options: argparse.Namespace) -> int:
    from mjx_study._matplotlib import matplotlib
    from mjx_study.disk import prepare_folder
    from mjx_study.plots.study import plot_study
    from mjx_study.plots.style import STYLES, fit_to_paper, save_figures
    from mjx_study.results.warnings import warnings_of
    from mjx_study.storage.folder import load_study

    with usage_errors():
        if not options.format:
            raise OptionError("format", "must have at least one value")
        dataset = load_study(options.folder)
        folder = prepare_folder(options.output or options.folder)
    with matplotlib.rc_context(STYLES[options.style]):
        figures = plot_study(dataset)
        for figure in figures.values() if options.style == "paper" else ():
            fit_to_paper(figure)
        written, unwritten = attempt(lambda: save_figures(figures, folder, options.format))
    warnings = list(warnings_of(dataset))
    names = ", ".join(path.name for path in written if path.suffix == f".{options.format[0]}")
    others = ", ".join(kind.upper() for kind in options.format[1:])
    lines = [f"warning: {message}" for message in warnings]
    if not figures:
        lines.append("nothing to draw yet")
    elif written:
        lines.append(f"written to {folder}: {names}{f' (and as {others})' if others else ''}")
    document = {"written": [str(path) for path in written], "warnings": warnings}
    return print_report(options, document, lines, unwritten)
