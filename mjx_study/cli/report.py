"""mjx-study report."""

import argparse
from pathlib import Path

from mjx_study.cli.options import Commands, add_command, attempt, finish, print_report, usage_errors
from mjx_study.disk import prepare_folder, write_whole
from mjx_study.report import report
from mjx_study.study.run import load_study, warnings_of

EPILOG = """\
Writes FOLDER/report.html: one page that needs no other file, with warnings, figures, a table, the whole configuration,
versions and machine, and the command that made it. Works while the study is still being computed.

example:
  mjx-study report out
"""


def add(commands: Commands) -> None:
    """Register the command."""
    command = add_command(commands, "report", "write a study as one HTML page", run, EPILOG)
    command.add_argument("folder", type=Path, metavar="FOLDER", help="of a study, made by sweep")
    command.add_argument("--output", type=Path, metavar="FILE.html", help="default: FOLDER/report.html")


def run(options: argparse.Namespace) -> int:
    """Load, write."""
    with usage_errors():
        dataset = load_study(options.folder)
        path = options.output or options.folder / "report.html"
        prepare_folder(path.parent)
    page = report(dataset).encode()
    written, unwritten = attempt(lambda: [write_whole(path, lambda file: file.write(page))])
    warnings = list(warnings_of(dataset))
    lines = [f"warning: {message}" for message in warnings]
    lines += [f"written: {path} ({len(page) / 1e6:.1f} MB)"] if written else []
    print_report(options, {"written": str(path) if written else None, "warnings": warnings}, lines)
    return finish(unwritten)
