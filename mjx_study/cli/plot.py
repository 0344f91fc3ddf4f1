"""mjx-study plot."""

import argparse
from pathlib import Path

from mjx_study.cli.options import Commands, add_command, attempt, finish, print_report, usage_errors
from mjx_study.disk import prepare_folder
from mjx_study.plots.study import plot_study
from mjx_study.plots.style import save_figure
from mjx_study.study.run import load_study, warnings_of

EPILOG = """\
Draws what the study has the numbers for, each as PNG and PDF: variance, bias and alpha against stiffness, error against
samples, maps over two swept parameters; of descents, achieved cost against stiffness, and cost against iterations,
rollouts and seconds. Works while the study is still being computed.

examples:
  mjx-study plot out
  mjx-study plot out --output figures
"""


def add(commands: Commands) -> None:
    """Register the command."""
    command = add_command(commands, "plot", "draw a study's figures", run, EPILOG)
    command.add_argument("folder", type=Path, metavar="FOLDER", help="of a study, made by sweep")
    command.add_argument("--output", type=Path, metavar="DIR", help="default: the study's folder")


def run(options: argparse.Namespace) -> int:
    """Load, draw, write."""
    with usage_errors():
        dataset = load_study(options.folder)
        folder = prepare_folder(options.output or options.folder)
    figures = plot_study(dataset)
    written, unwritten = attempt(
        lambda: [path for name, figure in figures.items() for path in save_figure(figure, folder, name)]
    )
    warnings = list(warnings_of(dataset))
    document = {"written": [str(path) for path in written], "warnings": warnings}
    names = ", ".join(path.name for path in written if path.suffix == ".png")
    lines = [f"warning: {message}" for message in warnings]
    if not figures:
        lines.append("nothing to draw yet")
    elif written:
        lines.append(f"written to {folder}: {names} (and as PDF)")
    print_report(options, document, lines)
    return finish(unwritten)
