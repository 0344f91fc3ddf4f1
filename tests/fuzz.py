"""Answer thousands of hostile inputs, and put the table of what came of them into a page: `python -m tests.fuzz`."""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from mjx_study import configure
from mjx_study.table import format_table
from tests.fuzzing_cases import FULL, Row, fuzz, fuzzed_folder, tally
from tests.planted.__main__ import MARK as END

BEGIN: Final = "<!-- from here on: make fuzz -->\n"
HEADER: Final = ("input", "tried", "silent errors", "tracebacks", "hangs", "writes outside")
STUDIES: Final = "tests.fuzzing_studies"
FLIPS: Final = {"flip_studies": 1200, "flip_cached": 400}
"""Number of flipped bits by the function that flips them."""


def rows_of_studies(folder: Path, share: float) -> list[Any]:
    """A row for each kind of damaged or forged study."""
    if find_spec(STUDIES) is None:
        return []
    fuzzing_studies, found = import_module(STUDIES), list[Any]()
    for name, count in FLIPS.items():
        root = folder / name
        root.mkdir()
        found.append(timed(name, lambda: getattr(fuzzing_studies, name)(max(1, round(share * count)), root)))  # noqa: B023
    root = folder / "forged"
    root.mkdir()
    found += timed("forged folders", lambda: fuzzing_studies.forge_studies(None if share >= 1 else 1, root))
    return found


def timed(what: str, work: Any) -> Any:
    """What work returns; says how long it took."""
    begun = time.monotonic()
    done = work()
    told = f": {done.inputs} inputs, {done.wrong} wrong" if isinstance(done, Row) else ""
    codes = f", {tally(done.codes)}" if isinstance(done, Row) else ""
    print(f"{time.monotonic() - begun:7.1f} s  {what}{told}{codes}", file=sys.stderr, flush=True)
    return done


def cells(row: Any) -> list[str]:
    """A row's entries."""
    return [row.kind, *map(str, (row.inputs, row.silent, row.tracebacks, row.hangs, row.outside))]


def markdown(rows: Sequence[Any]) -> str:
    """The table of the page."""
    tried, wrong = sum(row.inputs for row in rows), sum(row.wrong for row in rows)
    lines = [f"{tried:,} inputs, {wrong} answered wrongly.", "", f"| {' | '.join(HEADER)} |"]
    lines += ["| --- |" + " ---: |" * (len(HEADER) - 1), *(f"| {' | '.join(cells(row))} |" for row in rows)]
    return "\n".join(lines) + "\n"


def put_into(page: Path, table: str) -> None:
    """Replace the table of a page, which stands between its marks."""
    head, _, rest = page.read_text().partition(BEGIN)
    page.write_text(f"{head}{BEGIN}\n{table}\n{END}{rest.partition(END)[2]}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Answer all inputs and print the table; 1 if an answer was wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--only", action="append", metavar="KIND", choices=[*FULL, "studies"])
    parser.add_argument("--share", type=float, default=1.0, metavar="X", help="of the full number of inputs")
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="put the table where the page has its marks")
    options = parser.parse_args(arguments)
    chosen = options.only or [*FULL, "studies"]
    configure(cache=None, cpu_devices=1)
    rows: list[Any] = []
    with tempfile.TemporaryDirectory(prefix="mjx-study-fuzz-") as name:
        folder = Path(name).resolve()
        (folder / "inputs").mkdir()
        with fuzzed_folder(folder / "inputs") as path:
            for kind in (kind for kind in FULL if kind in chosen):
                count = max(1, round(options.share * FULL[kind]))
                rows.append(timed(kind, lambda: fuzz(kind, path, count)))  # noqa: B023
        if "studies" in chosen:
            rows += rows_of_studies(folder, options.share)
    print("\n".join([line for row in rows for line in row.told] + format_table(list(map(cells, rows)), HEADER)))
    if options.page is not None:
        put_into(options.page, markdown(rows))
    return int(any(row.wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
