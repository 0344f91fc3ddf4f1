"""Progress of a command on standard error: what is traced, compiled, built and computed, and for how long.

JAX announces when it begins to trace, lower or compile a program, so no computation needs to report that. A thread
looks every second whether it is time for a sign of life.
"""

import re
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from itertools import chain
from operator import itemgetter
from typing import Final

from mjx_study.table import grouped

EVENTS: Final = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowering",
    "/jax/core/compile/backend_compile_duration": "compiling",
}
"""JAX's events, by what they say."""
PROGRAMS: Final = {
    "value": "rollouts",
    "gradient": "gradients",
    "corrected": "gradients with the onset term",
    "steps": "rollouts by step",
    "step gradient": "gradients by step",
    "numbers of seeds": "statistics",
    "descent": "an iteration of a descent",
}
"""Programs that have other names in the code."""
SHORT: Final = 0.5
"""Time up to which a build is not worth a word [s]."""
FIRST: Final = 1.0
SILENCE: Final = 8.0
"""Time without a line before the first sign of life, and before each later one [s]."""
WITHIN: Final = 5.0
"""Shortest time between lines of one stage [s]."""
TICK: Final = 1.0
"""Interval between looks [s]."""
Show = Callable[[int, int, str, str], None]
"""Called with the work done, the total work, what is computed, and a sign of life, empty if a new stage begins."""


class Activity:
    """What JAX traces and compiles, and the compiler of native code builds, in any thread of this process."""

    def __init__(self, clock: Callable[[], float] = time.monotonic):
        self._clock = clock
        self._running: dict[int, list[tuple[str, float]]] = {}

    def began(self, event: str, value: float, **details: str | int) -> None:
        """Note what this thread begins to build."""
        if event in EVENTS:
            name = re.sub(r"^jit\((.*)\)$", r"\1", str(details.get("fun_name", ""))).strip("_<>").replace("_", " ")
            running = self._running.setdefault(threading.get_ident(), [])
            running.append((f"{EVENTS[event]} {PROGRAMS.get(name, name)}", self._clock()))

    def ended(self, event: str, duration_secs: float, **details: str | int) -> None:
        """Note that this thread has built what it began last."""
        if event in EVENTS and (running := self._running.get(threading.get_ident())):
            running.pop()

    def describe(self) -> str:
        """The outermost build of each thread with its time so far, and the number of libraries that are built."""
        from mjx_study.graph.build import libraries_pending

        now, outermost = self._clock(), list(chain(*(each[:1] for each in list(self._running.values()))))
        same = grouped((each for each in outermost if now - each[1] >= SHORT), itemgetter(0))
        found = [
            f"{what}{f' ({len(each)} at once)' if each[1:] else ''}, {now - min(since for _, since in each):.0f} s"
            for what, each in same.items()
        ]
        pending = libraries_pending()
        libraries = f"building {pending} {'library' if pending == 1 else 'libraries'} of native code"
        return "; ".join([*found, *([libraries] if pending else [])])

    @contextmanager
    def listening(self) -> Generator[None]:
        from jax import monitoring

        monitoring.register_scalar_listener(self.began)
        monitoring.register_event_duration_secs_listener(self.ended)
        try:
            yield
        finally:
            with suppress(ValueError):  # listeners may have been cleared
                monitoring.unregister_scalar_listener(self.began)
                monitoring.unregister_event_duration_listener(self.ended)


class Display:
    """Progress whose counters never run backwards, with a sign of life after each silence; see `WITHIN`, `SILENCE`."""

    def __init__(
        self,
        show: Show,
        activity: Activity,
        clock: Callable[[], float] = time.monotonic,
        within: float = WITHIN,
        silence: float = SILENCE,
    ):
        self._show, self._activity, self._clock, self._within = show, activity, clock, within
        self._lock = threading.Lock()
        self._done, self._total, self._what = 0, 0, "starting"
        self._begun = self._first = self._last = 0, clock()
        self._said, self._silence, self._longest = clock(), min(FIRST, silence), silence

    def report(self, done: int, total: int, what: str) -> None:
        """Report progress, as a `mjx_study.progress.Progress`."""
        with self._lock:
            if total != self._total:
                self._begun = self._first = self._last = done, self._clock()
            elif done > self._done:
                self._last = done, self._clock()
                self._first = self._last if self._first == self._begun else self._first
            self._done = max(done, self._done) if total == self._total else done
            before, self._total, self._what = self._what, total, what
            same = what.partition("; ")[0] == before.partition("; ")[0]
            if what != before and not (same and self._clock() - self._said < self._within):
                self._say("")

    def tick(self) -> None:
        """Give a sign of life if it is time for one."""
        with self._lock:
            if self._clock() - self._said >= self._silence:
                self._silence = self._longest
                self._say(self._life())

    def _say(self, life: str) -> None:
        self._said = self._clock()
        self._show(self._done, self._total, self._what, life)

    def _life(self) -> str:
        """What is built, or how far the stage is and how long the rest takes at this pace, at most if there was only
        the first advance, which includes building."""
        if building := self._activity.describe():
            return building
        share = f", {self._done} of {self._total}" if self._total > 1 else f": {self._what}"
        known = self._first[0] < self._last[0]
        (first, begun), (last, moved) = self._first if known else self._begun, self._last
        if first < last < self._total:
            left = (moved - begun) / (last - first) * (self._total - last) - (self._clock() - moved)
            share += f", {'about' if known else 'at most'} {left:.0f} s left" if left > 1 else ""
        return f"computing{share}"


@contextmanager
def ticking(tick: Callable[[], None], seconds: float = TICK) -> Generator[None]:
    ended = threading.Event()

    def look() -> None:
        while not ended.wait(seconds):
            tick()

    threading.Thread(target=look, name="display", daemon=True).start()
    try:
        yield
    finally:
        ended.set()
