"""mjx-study report."""

import argparse
from pathlib import Path

from mjx_study.cli.options import usage_errors
from mjx_study.cli.output import attempt, print_report
from mjx_study.options.parser import Parser

EPILOG = """\
Writes FOLDER/report.html: one self-contained page with warnings, figures, a table, the whole configuration, versions
and machine, and the command that made it. Works while the study is still being computed.

example:
  mjx-study report out
"""


def add(command: Parser) -> None:
    command.add_argument("folder", type=Path, metavar="FOLDER", help="folder of a study")
    command.add_argument("--output", type=Path, metavar="FILE.html", help="default: FOLDER/report.html")


def run(options: argparse.Namespace) -> int:
    from mjx_study.disk import prepare_folder, write_whole
    from mjx_study.report import render_report
    from mjx_study.results.warnings import warnings_of
    from mjx_study.storage.folder import load_study

    with usage_errors():
        dataset = load_study(options.folder)
        path = options.output or options.folder / "report.html"
        prepare_folder(path.parent)
    page = render_report(dataset).encode()
    written, unwritten = attempt(lambda: [write_whole(path, page)])
    warnings = list(warnings_of(dataset))
    lines = [f"warning: {message}" for message in warnings]
    lines += [f"written: {path} ({len(page) / 1e6:.1f} MB)"] if written else []
    document = {"written": str(path) if written else None, "warnings": warnings}
    return print_report(options, document, lines, unwritten)
