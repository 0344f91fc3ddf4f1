"""Limits on the size of a plan; a larger one is refused before anything is computed."""

from typing import Final

MOST_MODELS: Final = 5_000
"""Most contact models of one task."""
MOST_CELLS: Final = 50_000
"""Most cells of a sweep; each is a file."""
MOST_PROGRAMS: Final = 500
"""Most programs that a sweep compiles: each timestep, cone and task needs its own."""
MOST_PARAMS: Final = 10_000_000
"""Most parameters of a network."""
MOST_LAYERS: Final = 100
"""Most hidden layers of a network."""
MOST_STEPS: Final = 1_000_000
"""Most steps of a rollout."""
MOST_GIB: Final = 16.0
"""Most memory for the arrays held at once [GiB], as `mjx_study.study.memory.check_memory` counts them."""


def check_count(count: int, what: str, limit: int, change: str) -> None:
    """Refuse a count above its limit.

    Raises:
        ValueError: names the limit and what to change.
    """
    if count > limit:
        raise ValueError(f"{count} {what} are planned, and the limit is {limit}: {change}")
