"""What a command writes: standard output and error, progress, the line and the exit code with which it ends."""

import argparse
import json
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NoReturn

from mjx_study.cli.display import TICK, Activity, Display, Show, ticking
from mjx_study.disk import remove_temporary_folders
from mjx_study.progress import Progress

RESUMABLE: Final = "the same command resumes where it stopped"
ROOM: Final = 64
"""Columns of a terminal for the bar, its counter and its clock."""
INTERRUPTED: Final = "nothing was written"
"""Default continuation of "interrupted; ..."."""
ENDINGS: Final = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}
"""Signals that end a command with one line and exit code 128 + the signal's number."""


class OutputError(Exception):
    """Standard output cannot be written to."""


@contextmanager
def written_out() -> Generator[None]:
    """Run a command with unencodable characters escaped and output flushed at the end.

    BrokenPipeError if the reader of standard output has gone, OutputError if it cannot be written to otherwise.
    """
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        try:
            yield
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except OSError as error:
        if error.filename is not None:
            raise OutputError(f"cannot write {error.filename}: {error.strerror}") from error
        with suppress(OSError, AttributeError, ValueError):  # else Python would try to write the rest again at exit
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())  # type: ignore[union-attr]
            os.close(nowhere)
        if isinstance(error, BrokenPipeError):
            raise
        raise OutputError(f"cannot write to standard output: {error.strerror or error}") from error


def encodable(text: str) -> str:
    """Text of a command line with bytes that are not UTF-8, which no document holds, written as \\udcff."""
    return text.encode(errors="backslashreplace").decode()


def complain(line: str) -> None:
    """Print a line on standard error, if there is one."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)


@contextmanager
def computing(interrupted: str = INTERRUPTED) -> Generator[Progress]:
    """Show progress while computing; a signal ends the process at once, see `ending`."""
    with ending(interrupted, *ENDINGS), shown_progress() as progress:
        yield progress


@contextmanager
def ending(told: str, *signals: signal.Signals) -> Generator[None]:
    """Within the context, let signals end the process at once, with one line and exit code 128 + the signal's number.

    Exceptions would not work: JAX calls back into Python while tracing, and exceptions raised there may be lost.
    Nothing is on disk yet, or only complete files, so there is nothing to undo.
    """
    previous = {number: signal.getsignal(number) for number in signals}
    # Only the main thread may set handlers; signals that a background job or nohup ignores stay ignored.
    ours = threading.current_thread() is threading.main_thread()
    caught = [number for number, handler in previous.items() if ours and handler is not signal.SIG_IGN]
    for number in caught:
        signal.signal(number, lambda code, _: _leave(f"mjx-study: {ENDINGS[signal.Signals(code)]}; {told}", code))
    try:
        yield
    finally:
        for number in caught:
            signal.signal(number, previous[number])


def _leave(message: str, code: int) -> NoReturn:
    """End the process, whether or not anybody reads the message: an exception here would be lost, or a write wait for
    ever."""
    with suppress(Exception):
        descriptor = sys.stderr.fileno()  # not through sys.stderr, which may be amid a write
        cursor = "\n\x1b[?25h" if os.isatty(descriptor) else ""  # a progress bar hides it
        if select.select([], [descriptor], [], 0)[1]:
            os.write(descriptor, f"{cursor}{message}\n".encode(errors="backslashreplace"))
    with suppress(Exception):
        _end_children()
        remove_temporary_folders()
    os._exit(128 + code)


def _end_children() -> None:
    """End the processes that this one has started, such as a renderer or ffmpeg, where /proc lists them."""
    for listed in Path("/proc/self/task").glob("*/children"):
        for child in listed.read_text().split():
            with suppress(ProcessLookupError):
                os.kill(int(child), signal.SIGTERM)


@contextmanager
def shown_progress() -> Generator[Progress]:
    """Show a live bar on a terminal until the work is done; otherwise print a line per stage with the elapsed time, and
    one after each silence."""
    activity = Activity()
    with ExitStack() as stack:
        stack.enter_context(activity.listening())
        if sys.stderr is not None and sys.stderr.isatty():
            display = Display(stack.enter_context(_bar(activity)), activity, within=0.0, silence=TICK)
        else:
            display = Display(_lines(), activity)
        stack.enter_context(ticking(display.tick))
        yield display.report


@contextmanager
def _bar(activity: Activity) -> Generator[Show]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.table import Column

    console = Console(stderr=True)
    text = Column(no_wrap=True, overflow="ellipsis", max_width=max(20, console.width - ROOM))
    what = TextColumn("{task.description}", table_column=text)
    columns = what, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=None)

        def show(done: int, total: int, what: str, life: str) -> None:
            bar.update(task, completed=done, total=total or None, description=f"{what}: {life}" if life else what)

        yield show


def _lines() -> Show:
    begun = time.monotonic()

    def show(done: int, total: int, what: str, life: str) -> None:
        complain(f"{time.monotonic() - begun:7.1f} s  {life or f'[{done}/{total}] {what}'}")

    return show


def attempt(write: Callable[[], list[Path]]) -> tuple[list[Path], str | None]:
    """Write files; return their paths, or the reason for a failure: a full disk must not cost the printed numbers."""
    try:
        return write(), None
    except OSError as error:
        return [], f"cannot write {error.filename or 'a file'}: {error.strerror or error}; existing files are complete"


def print_report(
    options: argparse.Namespace, document: dict[str, Any], lines: Sequence[str], *unwritten: str | None
) -> int:
    """Print the document as JSON or the lines; return the exit code, 1 with one line for what could not be written."""
    print(json.dumps(document, allow_nan=False) if options.json else "\n".join(lines))
    failures = list(filter(None, unwritten))
    for failure in failures[:1]:
        complain(f"mjx-study: {failure}")
    return int(bool(failures))
