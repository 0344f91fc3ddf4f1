"""Hostile inputs of every kind, the same ones each time, and how they are answered: `python -m tests.fuzz`."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from tests.fuzz import flips, forgeries, planning
from tests.fuzz.answers import Row

Fuzzer = Callable[[str, int, Path], Row]
"""Answers so many inputs of a kind; fuzzers share a folder for what they need."""
FUZZERS: Final[dict[str, tuple[Fuzzer, int]]] = {
    **{kind: (planning.fuzz, 400) for kind in planning.CASES},
    "options of every command": (planning.fuzz, 2600),
    "TOML files": (planning.fuzz, 800),
    **{kind: (flips.flip, count) for kind, count in flips.FLIPS.items()},
    **dict.fromkeys(forgeries.FORGERIES, (forgeries.forge, 100)),
}
"""Fuzzers by kind of input, and the number of inputs at full size."""


def fuzz(kind: str, folder: Path, share: float = 1.0) -> Row:
    """Answer inputs of a kind: all of them, or a share."""
    fuzzer, count = FUZZERS[kind]
    return fuzzer(kind, max(1, round(share * count)), folder)
