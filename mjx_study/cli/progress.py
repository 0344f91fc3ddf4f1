"""Progress on standard error: a bar on a terminal, otherwise a line per stage."""

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

from mjx_study.cli.output import complain


@contextmanager
def shown_progress() -> Generator[Callable[[int, int, str], None]]:
    """Show a bar on a terminal until the work is done; otherwise print a line per stage with the elapsed time."""
    if sys.stderr is None or not sys.stderr.isatty():
        yield _stage_lines()
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None)

        def report(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total, description=what)

        yield report


def _stage_lines() -> Callable[[int, int, str], None]:
    """Print a line for each stage, identified by its name; progress within a stage is not shown."""
    begun, last = time.monotonic(), ""

    def report(done: int, total: int, what: str) -> None:
        nonlocal last
        if what != last:
            complain(f"{time.monotonic() - begun:7.1f} s  [{done}/{total}] {what}")
            last = what

    return report


def show_cursor() -> None:
    """Restore the cursor hidden by a progress bar, if standard error is a terminal."""
    if sys.stderr is not None and sys.stderr.isatty():
        sys.stderr.write("\n\x1b[?25h")
