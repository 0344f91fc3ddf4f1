"""Faults on purpose: disks that fill up, processes that die at any system call, files that are none.

Calls of the operating system that a write makes are counted, and the n-th one fails; or a process that writes is traced
and killed at its n-th system call. Each test runs n through all of them.
"""

import ctypes
import io
import os
import signal
import socket
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

from mjx_study.disk import write_whole
from mjx_study.storage import arrays as cell_files

CALLS: Final = ("open", "mkdir", "fsync", "fchmod", "replace")
"""Functions of `os` that change the disk; writes to open files count as well."""
PTRACE_TRACEME, PTRACE_SYSCALL = 0, 24
NO_FILES: Final = ("fifo", "socket", "folder", "device")
"""What may stand where a regular file belongs."""


class Faults:
    """Fails the n-th call that changes the disk, and all after it where the fault lasts.

    Attributes:
        calls: how many there were.
    """

    def __init__(self, patch: pytest.MonkeyPatch, at: int, code: int, *, lasting: bool = False):
        self.calls, self._at, self._code, self._lasting = 0, at, code, lasting
        for name in CALLS:
            patch.setattr(os, name, self._counted(getattr(os, name)))
        patch.setattr(os, "fdopen", self._opened(os.fdopen))

    def _tick(self) -> None:
        at, self.calls = self.calls, self.calls + 1
        if at == self._at or (self._lasting and at > self._at):
            raise OSError(self._code, os.strerror(self._code))

    def _counted(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def called(path: Any, *args: Any, **kwargs: Any) -> Any:
            flags = args[0] if args else kwargs.get("flags", 0)
            if function.__name__ != "open" or flags & (os.O_WRONLY | os.O_RDWR):
                self._tick()
            return function(path, *args, **kwargs)

        return called

    def _opened(self, fdopen: Callable[..., Any]) -> Callable[..., Any]:
        faults = self

        class Counted(io.FileIO):
            def write(self, data: Any, /) -> int:
                faults._tick()
                return super().write(data)

        def called(descriptor: int, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
            if mode != "wb":
                return fdopen(descriptor, mode, *args, **kwargs)
            return io.BufferedWriter(Counted(descriptor, mode))

        return called


class Killed(BaseException):
    """Ends a study as a kill would."""


def kill_after(patch: pytest.MonkeyPatch, last: Callable[[Path, int], bool], *others: Any) -> list[Path]:
    """Kill after a write of cells, or of other modules, for which `last` of path and number is true; those written."""
    written: list[Path] = []

    def killed(path: Path, write: Any) -> Path:
        written.append(write_whole(path, write))
        if last(path, len(written)):
            raise Killed
        return path

    for module in (cell_files, *others):
        patch.setattr(module, "write_whole", killed)
    return written


def every_fault(code: int, work: Callable[[], Any], *, lasting: bool = False) -> Generator[int]:
    """Runs work with a fault at its first call, its second, and so on; ends with the first run without a fault."""
    at = 0
    while True:
        with pytest.MonkeyPatch.context() as patch:
            faults = Faults(patch, at, code, lasting=lasting)
            try:
                work()
            except (OSError, ValueError):
                pass
        if faults.calls <= at:
            return
        yield at
        at += 1


def killed_at_every_system_call(work: Callable[[], Any]) -> Generator[int]:
    """Runs work in a child that is killed before and after its first system call, its second, and so on.

    Ends with the run that is through before it is killed. The caller must not have started threads.
    """
    ptrace = ctypes.CDLL(None, use_errno=True).ptrace
    ptrace.argtypes = (ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p)
    ptrace.restype = ctypes.c_long
    at = 0
    while True:
        child = os.fork()
        if child == 0:
            os._exit(_traced(ptrace, work))
        _, status = os.waitpid(child, 0)
        for _ in range(at):
            if not os.WIFSTOPPED(status):
                break
            ptrace(PTRACE_SYSCALL, child, None, None)
            _, status = os.waitpid(child, 0)
        if not os.WIFSTOPPED(status):
            if os.waitstatus_to_exitcode(status) != 0:
                raise ChildProcessError(f"the traced child ended with status {status}")
            return
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        yield at
        at += 1


def _traced(ptrace: Any, work: Callable[[], Any]) -> int:
    if ptrace(PTRACE_TRACEME, 0, None, None) != 0:
        return 3
    os.kill(os.getpid(), signal.SIGSTOP)
    work()
    return 0


@contextmanager
def deadline(seconds: float, error: type[BaseException] = TimeoutError) -> Generator[None]:
    """Raises an error inside once the time is up, also out of a system call that waits."""

    def late(*_: object) -> None:
        raise error(f"no answer in {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def put_no_file(path: Path, kind: str) -> None:
    """One of `NO_FILES` at a path."""
    path.unlink(missing_ok=True)
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "socket":
        here = os.getcwd()
        os.chdir(path.parent)  # a socket's path is short
        try:
            with socket.socket(socket.AF_UNIX) as bound:
                bound.bind(path.name)
        finally:
            os.chdir(here)
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
