"""Files that are complete or absent, whatever happens to the process that writes them, and reads that never wait.

A file is written under a temporary name beside its place, locked as long as its writer lives, and moved there when it
is on the disk. A temporary file whose lock is free was left by a process that died; the next one removes it.
"""

import errno
import fcntl
import os
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Final

TEMPORARY: Final = ".mjx-study"
"""Ending of temporary names, by which a program knows its own."""


def prepare_folder(folder: str | Path) -> Path:
    """Make sure that results can be written to a folder, before anything is computed; removes what dead writers left.

    Raises:
        ValueError: it cannot be created or written to, or is a file.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise ValueError(f"cannot write to the output folder {path}: {error.strerror or error}") from error
    return path


def write_whole(path: Path, write: Callable[[IO[bytes]], Any]) -> Path:
    """Write a file beside its place and move it there, so that it is never half there, after a loss of power either.

    Raises:
        OSError: it cannot be written; what was there before still is.
    """
    descriptor, temporary = _begin(path)
    try:
        with os.fdopen(descriptor, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
            os.fchmod(file.fileno(), 0o644)
            os.replace(temporary, path)  # under the lock, so that nobody takes it for a leftover
    except BaseException as error:
        with suppress(OSError):
            os.unlink(temporary)
        if isinstance(error, OSError):
            error.filename = str(path)  # in place of none, or of the temporary one
        raise
    return path


def _begin(path: Path) -> tuple[int, str]:
    """A temporary file for a path, locked."""
    while True:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=TEMPORARY)
        with suppress(OSError):  # a file system without locks: then nobody removes leftovers either
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:
            return descriptor, temporary
        os.close(descriptor)  # removed between its creation and its lock


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of processes that died while they wrote; those of live ones are locked and stay."""
    for path in folder.glob(f".*{TEMPORARY}"):
        with suppress(OSError):
            descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                if stat.S_ISREG(os.fstat(descriptor).st_mode):
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(path)
            finally:
                os.close(descriptor)


def open_regular(path: Path, flags: int) -> int:
    """A descriptor of a regular file; opening a pipe, a socket or a device would wait or have effects.

    Raises:
        OSError: it cannot be opened, or is no regular file.
    """
    descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return descriptor


def read_whole(path: Path) -> bytes:
    """The content of a regular file.

    Raises:
        OSError: it cannot be read, or is no regular file.
    """
    with os.fdopen(open_regular(path, os.O_RDONLY), "rb") as file:
        return file.read()
