"""End a run whose computation stands still.

A call into XLA that never returns blocks its thread in C code, where no exception reaches it. A daemon thread watches
the process's processor time meanwhile; whoever waits for computation marks it by `awaited`.
"""

import os
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import partial
from typing import Final

import jax

SECONDS: Final = 60
"""Time without progress after which a run is ended [s]."""
LEAST: Final = 0.02
"""Share of a core that a computation uses at the least; drawing a progress bar takes half of that."""
STANDSTILL: Final = (
    "the computation stands still: no processor time for {} s; "
    "try again with --devices 1 or, without native code, a smaller --chunk-size (existing files are complete)"
)
NAME: Final = "watchdog"
_AWAITED: Final[list[int]] = []
_ELSEWHERE: Final[list[int]] = []


@contextmanager
def _marked(marks: list[int]) -> Generator[None]:
    marks.append(0)
    try:
        yield
    finally:
        marks.pop()


awaited = partial(_marked, _AWAITED)
"""Mark that a thread waits for computation of this process."""
elsewhere = partial(_marked, _ELSEWHERE)
"""Mark that another process, such as a compiler, works for this one."""


def watch(complain: Callable[[str], None], seconds: int = SECONDS, tick: float = 1.0) -> None:
    """Start a thread that ends the process with exit code 1 once awaited computation gets no processor time.

    Seconds are counted in ticks, of which a suspended process has none. On accelerators there is nothing to watch: the
    host has no work while they compute. A process is watched at most once.

    Args:
        complain: called with a line that says what to do.
        seconds: time without progress to wait [s].
        tick: interval between looks [s].
    """

    if jax.default_backend() != "cpu" or any(thread.name == NAME for thread in threading.enumerate()):
        return

    def look() -> None:
        still, before = 0, _spent()
        while True:
            time.sleep(tick)
            if not _AWAITED or _ELSEWHERE or _spent() - before > LEAST * tick * (still + 1):
                still, before = 0, _spent()
                continue
            still += 1
            if still * tick >= seconds:
                try:
                    complain(STANDSTILL.format(seconds))
                    sys.stderr.flush()
                finally:
                    os._exit(1)

    threading.Thread(target=look, name=NAME, daemon=True).start()


def _spent() -> float:
    """Processor time [s] of the process without this thread."""
    return time.process_time() - time.thread_time()
