"""Robust standard output and error: full disks, closed pipes, limited character sets."""

import os
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress


class OutputError(Exception):
    """Standard output cannot be written to."""


@contextmanager
def written_out() -> Generator[None]:
    """Run a command with unencodable characters escaped and output flushed at the end.

    Raises:
        OutputError: standard output cannot be written to.
        BrokenPipeError: its reader has gone.
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
        _abandon()
        if isinstance(error, BrokenPipeError):
            raise
        raise OutputError(f"cannot write to standard output: {error.strerror or error}") from error


def complain(line: str) -> None:
    """Print a line on standard error, if there is one."""
    if sys.stderr is not None:
        with suppress(OSError):
            print(line, file=sys.stderr, flush=True)


def _abandon() -> None:
    """Discard further standard output, which Python would otherwise try to write again at exit."""
    with suppress(OSError, AttributeError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
