"""mjx-study plot."""

import argparse

from mjx_study._matplotlib import matplotlib
from mjx_study.cli.options import attempt, finish, print_report, usage_errors
from mjx_study.disk import prepare_folder
from mjx_study.plots.study import plot_study
from mjx_study.plots.style import STYLES, fit_to_paper, save_figures
from mjx_study.study.run import load_study, warnings_of


def run(options: argparse.Namespace) -> int:
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
