"""Caches that outlive the process: files of this user alone, each with a digest that is checked before use.

JAX's cache of compiled programs trusts what it finds: it decompresses it, with a checksum or without one, by the
library that is installed, and runs it. Here its entries are digested like everything else; one that does not match is
discarded, and the program is recompiled.
"""

import functools
import hashlib
import inspect
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from jax._src import compilation_cache

from mjx_study.disk import check_private, open_regular, private_folder, write_whole

LENGTH: Final = 65
"""Length of a digest and the line feed that follows it [bytes]."""


def digested(content: bytes) -> bytes:
    """Content with its digest as a line before it."""
    return hashlib.sha256(content).hexdigest().encode() + b"\n" + content


def undigested(content: bytes) -> bytes:
    """Content without its digest; ValueError if that does not match."""
    rest = content[LENGTH:]
    if digested(rest) != content:
        raise ValueError("its digest does not match")
    return rest


def read_cached(path: Path) -> bytes | None:
    """Read a file written by `write_cached`; None if it is missing, and if it is damaged, a link or others may write to
    it, in which case it is removed."""
    try:
        with os.fdopen(open_regular(path, os.O_RDONLY, follow=False), "rb") as file:
            check_private(file.fileno(), path)
            return undigested(file.read())
    except FileNotFoundError:
        return None
    except (OSError, ValueError):
        with suppress(OSError):
            path.unlink()
        return None


def write_cached(path: Path, content: bytes) -> None:
    """Write a file for `read_cached`, in a folder of this user alone; failures are ignored."""
    with suppress(OSError):
        private_folder(path.parent)
        write_whole(path, digested(content), mode=0o600)


class ProgramCache:
    """JAX's cache of compiled programs in a folder, with digests."""

    def __init__(self, folder: Path):
        self._path = folder

    def get(self, key: str) -> bytes | None:
        return read_cached(self._path / f"{key}-cache")

    def put(self, key: str, value: bytes) -> None:
        write_cached(self._path / f"{key}-cache", value)


def check_programs(folder: Path) -> None:
    """Let JAX keep its programs of this folder, and of no other, in a `ProgramCache`."""
    opened = inspect.unwrap(compilation_cache.get_file_cache)

    @functools.wraps(opened)
    def open_cache(path: str) -> tuple[Any, str] | None:
        return (ProgramCache(folder), path) if path == str(folder) else opened(path)

    compilation_cache.get_file_cache = open_cache
