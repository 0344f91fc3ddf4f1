"""Atomic file writes, complete or absent whatever happens to the writing process, and nonblocking reads.

A file is written under a temporary name in the same folder, locked while its writer lives, and renamed once it is on
disk. A temporary file with a free lock was left by a process that died; the next one removes it. Temporary names end
with a checksum of themselves, so that no other program's file is taken for one.
"""

import errno
import fcntl
import hashlib
import os
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, Final

TEMPORARY: Final = ".mjx-study"
"""Suffix of temporary files."""
SEALED: Final = re.compile(rf"(\..+\.[0-9a-f]{{12}})([0-9a-f]{{12}}){re.escape(TEMPORARY)}", re.DOTALL)
"""Temporary names: a dot, the file's name, random digits, and a checksum of all that."""
_FOLDERS: Final[set[str]] = set()
MAX_BYTES: Final = 100_000_000
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


def prepare_folder(folder: str | Path, *, follow: bool = True) -> Path:
    """Ensure before computing that a folder is writable, else ValueError; remove leftovers of dead writers.

    Unless `follow` is set, a symbolic link in its place is a ValueError.
    """
    path = Path(folder)
    try:
        path.mkdir(parents=True, exist_ok=True)
        if not follow:
            check_no_link(path)
        remove_leftovers(path)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise ValueError(f"cannot write to the output folder {path}: {error.strerror or error}") from error
    return path


def private_folder(folder: Path) -> Path:
    """Create a folder that only this user can read and write, with its parents; tighten one that others may read.

    Raises:
        OSError: it cannot be created, is a link, belongs to another user, or others can write to it.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    check_no_link(folder)
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        check_private(descriptor, folder)
        if os.fstat(descriptor).st_mode & 0o077:
            os.fchmod(descriptor, 0o700)
    finally:
        os.close(descriptor)
    return folder


def check_private(descriptor: int, path: Path) -> None:
    """Raise OSError unless an open file or folder belongs to this user, and nobody else can write to it."""
    found = os.fstat(descriptor)
    if found.st_uid != os.geteuid():
        raise OSError(errno.EPERM, "it belongs to another user", str(path))
    if found.st_mode & 0o022:
        raise OSError(errno.EPERM, "others can write to it", str(path))


def check_no_link(path: Path) -> None:
    """Raise OSError if a path is a symbolic link."""
    if path.is_symlink():
        raise OSError(errno.ELOOP, "it is a symbolic link", str(path))


def write_whole(path: Path, content: bytes | Callable[[IO[bytes]], Any], mode: int = 0o644) -> Path:
    """Write a file, given its content or a function that writes it, under a temporary name, and rename it.

    It is complete or absent, even after a power loss. On an OSError any previous content is kept.
    """
    descriptor, temporary = _begin(path)
    try:
        with os.fdopen(descriptor, "wb") as file:
            content(file) if callable(content) else file.write(content)
            file.flush()
            os.fsync(file.fileno())
            os.fchmod(file.fileno(), mode)
            os.replace(temporary, path)  # under the lock, lest it be taken for a leftover
    except BaseException as error:
        with suppress(OSError):
            os.unlink(temporary)
        if isinstance(error, OSError):
            error.filename = str(path)  # instead of none or the temporary one
        raise
    return path


def _begin(path: Path) -> tuple[int, Path]:
    """Create a locked temporary file for a path."""
    while True:
        temporary = path.with_name(temporary_name(path.name))
        try:
            descriptor = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        except FileExistsError:
            continue
        with suppress(OSError):  # on file systems without locks, leftovers are not removed either
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        if os.fstat(descriptor).st_nlink:
            return descriptor, temporary
        os.close(descriptor)  # removed between creation and locking


def temporary_name(name: str) -> str:
    """Draw a temporary name for a file."""
    stem = f".{name}.{secrets.token_hex(6)}"
    return f"{stem}{_seal(stem)}{TEMPORARY}"


def _seal(stem: str) -> str:
    return hashlib.sha256(os.fsencode(stem)).hexdigest()[:12]


def is_temporary(name: str) -> bool:
    """Whether a name was drawn by `temporary_name`."""
    found = SEALED.fullmatch(name)
    return found is not None and _seal(found[1]) == found[2]


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of processes that died while writing; those of live ones are locked and stay."""
    for path in folder.glob(f".*{TEMPORARY}"):
        if not is_temporary(path.name):
            continue
        with suppress(OSError):
            descriptor = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                if stat.S_ISREG(os.fstat(descriptor).st_mode):
                    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.unlink(path)
            finally:
                os.close(descriptor)


def open_regular(path: Path, flags: int, *, follow: bool = True) -> int:
    """Open a regular file; opening a pipe, socket or device, an OSError here, could block or have side effects.

    Unless `follow` is set, a symbolic link is an OSError as well.
    """
    if not follow:
        check_no_link(path)
        flags |= os.O_NOFOLLOW
    descriptor = os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return descriptor


def read_whole(path: Path, *, follow: bool = True, most: int | None = None) -> bytes:
    """Read a regular file of at most so many bytes; OSError as for `open_regular`, or if it is larger."""
    with os.fdopen(open_regular(path, os.O_RDONLY, follow=follow), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        if most is not None and size > most:
            raise OSError(errno.EFBIG, f"it has {size} bytes; the limit is {most}", str(path))
        return file.read() or b""  # None where a read would have to wait


def read_bytes(path: Path) -> bytes:
    """Read a regular file of at most `MAX_BYTES`; anything else is a ValueError."""
    try:
        return read_whole(path, most=MAX_BYTES)
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror or error}") from error
