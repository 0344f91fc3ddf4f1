"""Progress on standard error: a bar on a terminal, lines elsewhere."""

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager


@contextmanager
def progress_bar() -> Generator[Callable[[int, int, str], None]]:
    """A progress bar on standard error, shown only on a terminal and gone when the work is done."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    )
    with bar:
        task = bar.add_task("starting", total=None)

        def report(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total, description=what)

        yield report


def stage_lines(progress: Callable[[int, int, str], None]) -> Callable[[int, int, str], None]:
    """The progress, and a line on standard error for each of its stages where that is no terminal."""

    def report(done: int, total: int, what: str) -> None:
        progress(done, total, what)
        if not sys.stderr.isatty():
            print(f"[{done}/{total}] {what}", file=sys.stderr, flush=True)

    return report


def show_cursor() -> None:
    """Bring back the cursor that a progress bar hides, where standard error is a terminal."""
    if sys.stderr is not None and sys.stderr.isatty():
        sys.stderr.write("\n\x1b[?25h")
