"""Inputs that user-defined code reads while it is imported, built and traced: files, modules, environment variables.

Digests of objects do not cover them. A read counts where the innermost frame outside libraries is the user's, so
that reads by this package and by libraries for themselves do not count. Not observed are reads by compiled code, by
other processes and from the network, listings of folders, and reads before `observing` began.
"""

import hashlib
import os
import sys
import sysconfig
import time
from collections import defaultdict
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any, Final, no_type_check

FILE, VARIABLE = "file ", "variable "  # prefixes of the names of inputs
ABSENT: Final = "absent"
OURS: Final = tuple(str(Path(__file__).resolve().parents[1] / name) + os.sep for name in ("estimators", "mjx_study"))
STANDARD: Final = tuple({str(Path(sysconfig.get_paths()[name])) + os.sep for name in ("stdlib", "platstdlib")})
INSTALLED: Final = ("site-packages", "dist-packages")
NO_DATA: Final = ("/proc/", "/sys/", "/dev/")
_RECORDED: dict[str, dict[str, str]] = defaultdict(dict)
_ACTIVE: list["_Observation"] = []


class _Observation:
    """Reads since a moment, by those modules for which they count."""

    def __init__(self, names: tuple[str, ...]):
        self.names, self.since, self.modules = names, time.time_ns(), set(sys.modules)
        self.read: set[str] = set()
        self.written: set[str] = set()
        self.variables: dict[str, str] = {}

    def settle(self) -> None:
        """Add digests of new inputs to those already recorded; files written meanwhile are not inputs."""
        loaded = [getattr(sys.modules[name], "__file__", None) for name in set(sys.modules) - self.modules]
        sources = {file for file in loaded if isinstance(file, str) and _owner(file) == "user"}
        self.modules |= set(sys.modules)
        found = dict(self.variables)
        for path in sources | (self.read - self.written):
            if (digest := _digest_of_file(path)) != ABSENT and os.stat(path).st_mtime_ns < self.since:
                found[FILE + _relative(path)] = digest
        self.read.clear()
        self.variables.clear()
        for name in self.names:
            _RECORDED[name].update(found)


@contextmanager
def observing(*names: str) -> Generator[None]:
    """Observe what user-defined code reads, on behalf of so named modules."""
    _install()
    observation = _Observation(names)
    _ACTIVE.append(observation)
    try:
        yield
    finally:
        _ACTIVE.remove(observation)
        observation.settle()


def inputs_read(names: Iterable[str]) -> dict[str, str]:
    """Return digests of the inputs read for modules so far in this process, by "file PATH" (relative to the current
    directory if within it) and "variable NAME"."""
    for observation in _ACTIVE:
        observation.settle()
    found = {name: digest for module in names for name, digest in _RECORDED[module].items()}
    return dict(sorted(found.items()))


def sources_and_inputs() -> dict[str, str]:
    """Return digests of all inputs read so far, and of the files of all user-defined modules that are loaded, by the
    names of `inputs_read`."""
    loaded = [getattr(module, "__file__", None) for module in list(sys.modules.values())]
    sources = {file for file in loaded if isinstance(file, str) and _owner(file) == "user"}
    return {FILE + _relative(path): _digest_of_file(path) for path in sources} | inputs_read(list(_RECORDED))


def inputs_now(names: Iterable[str]) -> Mapping[str, str]:
    """Return current digests of inputs by the same names."""
    readers = {FILE: _digest_of_file, VARIABLE: lambda name: _digest_of_text(os.environ.get(name))}
    kinds = {name: kind for name in names for kind in readers if name.startswith(kind)}
    return {name: readers[kind](name.removeprefix(kind)) for name, kind in kinds.items()}


def _digest_of_text(text: str | None) -> str:
    return ABSENT if text is None else hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _digest_of_file(path: str) -> str:
    try:
        if not os.path.isfile(path):
            return ABSENT
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:16]
    except OSError:
        return ABSENT


def _relative(path: str) -> str:
    """A path relative to the current directory if it is within it."""
    absolute, here = os.path.abspath(path), os.getcwd()
    return os.path.relpath(absolute, here) if absolute.startswith(here.rstrip(os.sep) + os.sep) else absolute


@cache
def _owner(file: str) -> str:
    """Whose code a file holds: ours, the standard library's, an installed library's, or the user's."""
    if file.startswith(("<frozen ", "<string>", "<__array_function__")):
        return "standard"
    path = os.path.abspath(file)
    if path.startswith(OURS):
        return "ours"
    if any(part in INSTALLED for part in Path(path).parts):
        return "library"
    return "standard" if path.startswith(STANDARD) else "user"


@no_type_check
def _reader(frame: FrameType | None, *, through: tuple[str, ...]) -> str:
    """Whose code reads: the innermost frame whose owner is none of those passed through."""
    while frame is not None:
        owner = _owner(frame.f_code.co_filename)
        if owner not in through:
            return owner
        frame = frame.f_back
    return "standard"


@no_type_check
def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    """Audit hook: note files that user-defined code opens, by itself or through a library."""
    if not _ACTIVE or event != "open":
        return
    path, mode, flags = arguments
    if not isinstance(path, str | bytes | os.PathLike):
        return
    name = os.path.abspath(os.fsdecode(path))
    writes = any(each in mode for each in "wax+") if isinstance(mode, str) else bool(flags & (os.O_WRONLY | os.O_RDWR))
    if name.endswith(".pyc") or name.startswith(NO_DATA) or _within_caches(name) or _owner(name) != "user":
        return
    if _reader(sys._getframe(1), through=("standard", "library")) == "user":
        for observation in _ACTIVE:
            (observation.written if writes else observation.read).add(name)


def _within_caches(path: str) -> bool:
    """Whether a file is in the user's cache or JAX's, whose files libraries can recreate."""
    roots = [os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")]
    if "jax" in sys.modules:
        roots.append(sys.modules["jax"].config.jax_compilation_cache_dir or roots[0])
    return path.startswith(tuple(os.path.abspath(root) + os.sep for root in roots))


@cache
def _install() -> None:
    """Install hooks for opened files and variables that are read; they stay, idle outside `observing`."""
    sys.addaudithook(_audit)
    kind: Any = type(os.environ)
    whole = kind.__getitem__

    @no_type_check
    def getitem(self: Any, key: Any) -> Any:
        if _ACTIVE and isinstance(key, str) and _reader(sys._getframe(1), through=("standard",)) == "user":
            value = self._data.get(self.encodekey(key))
            digest = _digest_of_text(None if value is None else self.decodevalue(value))
            for observation in _ACTIVE:
                observation.variables[VARIABLE + key] = digest
        return whole(self, key)

    kind.__getitem__ = getitem
