"""How large a plan may be; what is beyond is refused before anything is computed, with what to change."""

from typing import Final

MOST_MODELS: Final = 5_000
"""Contact models of one task."""
MOST_CELLS: Final = 50_000
"""Cells of a sweep, each of which is a file."""
MOST_PROGRAMS: Final = 500
"""Programs that a sweep compiles: a timestep, cone or task needs its own."""
MOST_PARAMS: Final = 10_000_000
"""Parameters of a network."""
MOST_LAYERS: Final = 100
"""Hidden layers of a network."""
MOST_STEPS: Final = 1_000_000
"""Of a rollout."""
MOST_GIB: Final = 16.0
"""Memory of the arrays that are held at once [GiB], as `mjx_study.study.memory.check_memory` counts them."""


def check_count(count: int, what: str, limit: int, change: str) -> None:
    """Refuse more than a limit.

    Raises:
        ValueError: with the limit and what to change.
    """
    if count > limit:
        raise ValueError(f"{count} {what} are planned, and the limit is {limit}: {change}")
