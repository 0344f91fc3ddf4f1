"""mjx-study report."""

import argparse

from mjx_study.cli.options import attempt, finish, print_report, usage_errors
from mjx_study.disk import prepare_folder, write_whole
from mjx_study.report import report
from mjx_study.study.run import load_study, warnings_of


def run(options: argparse.Namespace) -> int:
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
