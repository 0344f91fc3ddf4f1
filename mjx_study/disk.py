"""Atomic file writes, complete or absent whatever happens to the writing process, and nonblocking reads.

A file is written under a temporary name in the same folder, locked while its writer lives, and renamed once it is on
disk. A temporary file with a free lock was left by a process that died; the next one removes it.
"""

import errno
import fcntl
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Final

TEMPORARY: Final = ".mjx-study"
"""Suffix by which temporary files are recognised."""
_FOLDERS: Final[set[str]] = set()
MOST_BYTES: Final = 100_000_000
"""Maximum size of a file that users supply [bytes]."""


@contextmanager
def temporary_folder() -> Generator[str]:
    """Make a private folder that is removed at the end, by `remove_temporary_folders` too."""
    with tempfile.TemporaryDirectory(prefix="mjx-study-", ignore_cleanup_errors=True) as folder:
        _FOLDERS.add(folder)
        try:
            yield folder
        finally:
            _FOLDERS.discard(folder)


def remove_temporary_folders() -> None:
    """Remove those of `temporary_folder` that are in use, before the process ends without leaving its contexts."""
    for folder in tuple(_FOLDERS):
        shutil.rmtree(folder, ignore_errors=True)


def prepare_folder(folder: str | Path) -> Path:
    """Ensure before computing that a folder is writable, else ValueError; remove leftovers of dead writers."""
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise ValueError(f"cannot write to the output folder {path}: {error.strerror or error}") from error
    return path


def write_whole(path: Path, content: bytes | Callable[[IO[bytes]], Any]) -> Path:
    """Write a file, given its content or a function that writes it, under a temporary name, and rename it.

    It is complete or absent, even after a power loss. On an OSError any previous content is kept.
    """
    descriptor, temporary = _begin(path)
    try:
        with os.fdopen(descriptor, "wb") as file:
            content(file) if callable(content) else file.write(content)
            file.flush()
            os.fsync(file.fileno())
            os.fchmod(file.fileno(), 0o644)
            os.replace(temporary, path)  # under the lock, lest it be taken for a leftover
    except BaseException as error:
        with suppress(OSError):
            os.unlink(temporary)
        if isinstance(error, OSError):
            error.filename = str(path)  # instead of none or the temporary one
        raise
    return path


def _begin(path: Path) -> tuple[int, str]:
    """Create a locked temporary file for a path."""
    while True:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=TEMPORARY)
        with suppress(OSError):  # on file systems without locks, leftovers are not removed either
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:
            return descriptor, temporary
        os.close(descriptor)  # removed between creation and locking


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of processes that died while writing; those of live ones are locked and stay."""
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
    """Open a regular file; opening a pipe, socket or device, an OSError here, could block or have side effects."""
    descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return descriptor


def read_whole(path: Path) -> bytes:
    """Read a regular file; OSError as for `open_regular`."""
    with os.fdopen(open_regular(path, os.O_RDONLY), "rb") as file:
        return file.read() or b""  # None where a read would have to wait


def read_bytes(path: Path) -> bytes:
    """Read a regular file of at most `MOST_BYTES`; anything else is a ValueError."""
    try:
        if (size := path.stat().st_size) > MOST_BYTES:
            raise ValueError(f"{path} has {size} bytes; the limit is {MOST_BYTES}")
        return read_whole(path)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror or error}") from error
