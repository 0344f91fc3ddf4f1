"""Reports of progress from what computes to whoever shows it."""

from collections.abc import Callable
from typing import TypeAlias

Progress: TypeAlias = Callable[[int, int, str], None]
"""Called with the work done, the total work, and a description of what is computed next: a stage, and after "; " what
changes within it."""


def silent(done: int, total: int, what: str) -> None:
    """Report nothing."""
