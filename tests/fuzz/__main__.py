"""Answer thousands of hostile inputs, and put the table of the answers into a page: `python -m tests.fuzz`."""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from experiments.pages import write_tables
from mjx_study import configure
from mjx_study.cli import options as of_commands
from mjx_study.table import markdown_table
from tests.fuzz import FUZZERS, fuzz
from tests.fuzz.answers import Row


def timed(kind: str, folder: Path, share: float) -> Row:
    """Answer inputs of a kind, and print how many ended how."""
    begun = time.monotonic()
    row = fuzz(kind, folder, share)
    codes = ", ".join(f"{count} x exit code {code}" for code, count in sorted(row.codes.items()))
    told = f"{kind}: {row.inputs} inputs, {len(row.wrong)} wrong, {codes}"
    print(f"{time.monotonic() - begun:7.1f} s  {told}", file=sys.stderr, flush=True)
    return row


def markdown(rows: Sequence[Row]) -> str:
    """Format the table of the page."""
    tried, wrong = sum(row.inputs for row in rows), sum(len(row.wrong) for row in rows)
    table = markdown_table([(row.kind, row.inputs, len(row.wrong)) for row in rows], ("input", "tried", "wrong"))
    return f"{tried:,} inputs, {wrong} answered wrongly.\n\n{table}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Answer all inputs and print the table; 1 if an answer was wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--only", action="append", metavar="KIND", choices=list(FUZZERS))
    parser.add_argument("--share", type=float, default=1.0, metavar="X", help="of the full number of inputs")
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="put the table where the page has its marks")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="mjx-study-fuzz-") as name, pytest.MonkeyPatch.context() as monkeypatch:
        folder = Path(name).resolve()
        configure(cache=folder / "cache", cpu_devices=1)
        monkeypatch.setattr(of_commands, "configure", lambda **_: None)
        rows = [timed(kind, folder, options.share) for kind in options.only or FUZZERS]
    print("\n".join(line for row in rows for line in row.wrong))
    print(markdown(rows))
    if options.page is not None:
        write_tables(options.page, {"fuzz": markdown(rows)})
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
