"""Interleaved timings: calls that are to be compared alternate, so that a machine that slows down slows all of them."""

import math
import time
from collections.abc import Callable, Hashable, Mapping
from typing import Any, TypeVar

Name = TypeVar("Name", bound=Hashable)


def interleaved(
    calls: Mapping[Name, Callable[[], Any]],
    repeats: int,
    *,
    clock: Callable[[], float] = time.perf_counter,
    limit: float = math.inf,
) -> dict[Name, list[float]]:
    """Time calls in turn; each must block until its result is there.

    Args:
        calls: the calls by name, compiled.
        repeats: number of rounds at most.
        clock: returns seconds.
        limit: total seconds after which no further round starts.

    Returns:
        Seconds of every round by name.
    """
    taken: dict[Name, list[float]] = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            begun = clock()
            call()
            taken[name].append(clock() - begun)
        if sum(map(sum, taken.values())) >= limit:
            break
    return taken
