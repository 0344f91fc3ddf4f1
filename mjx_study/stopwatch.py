"""Run times of compiled programs during a study: their calls, and the tracing and compilation before the first one.

    with Stopwatch().running() as watch:
        with timed("rollouts", calls=4): ...
    watch.spent["rollouts"].each

Without a running stopwatch, `timed` does nothing. Times are those of its own thread, without nested timings.
"""

import dataclasses
import math
import time
from collections import defaultdict
from collections.abc import Callable, Generator, Hashable
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar, copy_context
from functools import partial
from typing import Any, Final

import jax
import numpy as np

TRACING: Final = ("/jax/core/compile/jaxpr_trace_duration", "/jax/core/compile/jaxpr_to_mlir_module_duration")
COMPILING: Final = "/jax/core/compile/backend_compile_duration"
"""JAX's event for XLA compilation, or for reading a compiled program."""
SAVED: Final = "/jax/compilation_cache/compile_time_saved_sec"
"""JAX's event for the compilation time saved by reading."""


@dataclasses.dataclass
class Spent:
    """Times of one program [s]."""

    calls: int = 0
    seconds: float = 0.0  # of calls without compilation
    setups: int = 0  # compilations
    first_calls: int = 0  # calls timed with them
    first: float = 0.0  # total time of these, of which JAX reports:
    traced: float = 0.0  # tracing
    read: float = 0.0  # compiling, or reading a compiled program
    compiled: float = 0.0  # what compiling takes without a cache

    def add(self, calls: int, seconds: float, traced: float = 0.0, read: float = 0.0, compiled: float = 0.0) -> None:
        if compiled == 0:
            self.calls, self.seconds = self.calls + calls, self.seconds + seconds
            return
        self.setups, self.first_calls, self.first = self.setups + 1, self.first_calls + calls, self.first + seconds
        self.traced, self.read, self.compiled = self.traced + traced, self.read + read, self.compiled + compiled

    @property
    def each(self) -> float:
        """Seconds per call, estimated from first calls if there are no others."""
        if self.calls:
            return self.seconds / self.calls
        return max(0.0, self.first - self.traced - self.read) / max(1, self.first_calls)

    @property
    def tracing(self) -> float:
        """Seconds before a first call, without compilation."""
        return self._setup * self.traced / (self.traced + self.read) if self.setups else 0.0

    @property
    def compiling(self) -> float:
        """Seconds of a compilation, as if there were no cache."""
        return self._setup * self.compiled / (self.traced + self.read) if self.setups else 0.0

    @property
    def _setup(self) -> float:
        """Seconds of tracing, and compiling or reading, by this clock, which may differ from JAX's."""
        return max(0.0, self.first - self.first_calls * self.each) / self.setups


class Stopwatch:
    """Times by program, for one thread; `saved` is when they were last written to disk [s], by `time.monotonic`."""

    clock = staticmethod(time.perf_counter)

    def __init__(self) -> None:
        self.spent: dict[Hashable, Spent] = defaultdict(Spent)
        self.saved = -math.inf
        self._events = np.zeros(3)  # tracing; reading or compiling; compiling as if there were no cache
        self._within = np.zeros(4)  # wall time and events of nested timings

    @contextmanager
    def running(self) -> Generator["Stopwatch"]:
        """Make this stopwatch the target of `timed` in this thread."""
        jax.monitoring.register_event_duration_secs_listener(self._hear)
        token = _RUNNING.set(self)
        try:
            yield self
        finally:
            _RUNNING.reset(token)
            jax.monitoring.unregister_event_duration_listener(self._hear)

    @contextmanager
    def timed(self, program: Hashable, calls: int) -> Generator[None]:
        outside, self._within, begun = self._within, np.zeros(4), self._now()
        whole = False
        try:
            yield
            whole = True
        finally:
            spent = self._now() - begun
            own, self._within = spent - self._within, outside + spent
            if whole:
                self.spent[program].add(calls, *map(float, own))

    def _now(self) -> np.ndarray:
        return np.array([self.clock(), *self._events])

    def _hear(self, event: str, duration_secs: float, **_: Any) -> None:
        if _UNHEARD.get():
            return
        compiling = event == COMPILING
        self._events += duration_secs * np.array([event in TRACING, compiling, compiling or event == SAVED])


_UNHEARD: ContextVar[bool] = ContextVar("unheard", default=False)
_RUNNING: ContextVar[Stopwatch | None] = ContextVar("stopwatch", default=None)


@contextmanager
def timed(program: Hashable, calls: int = 1) -> Generator[None]:
    """Time consecutive calls of a program if a stopwatch runs; the first time includes tracing and compilation, see
    `Spent`."""
    watch = _RUNNING.get()
    with nullcontext() if watch is None else watch.timed(program, calls):
        yield


def tell(program: Hashable, calls: int, seconds: float) -> None:
    """Add calls timed elsewhere, such as in another thread, if a stopwatch runs."""
    if (watch := _RUNNING.get()) is not None:
        watch.spent[program].add(calls, seconds)


def unheard(call: Callable[[], Any]) -> Callable[[], Any]:
    """Wrap a call for an untimed thread, so that its compilations are not attributed to any program."""

    def told() -> Any:
        _UNHEARD.set(True)
        return call()

    return partial(copy_context().run, told)
