"""Intervals in standard notation, and numbers in messages."""

import dataclasses
import math
import sys
from numbers import Integral
from typing import Any


@dataclasses.dataclass(frozen=True)
class Interval:
    """An interval in standard notation, such as "(0, 1]"; a square bracket at an infinite end includes infinity."""

    text: str

    @property
    def low(self) -> float:
        return float(self.text[1:-1].split(",")[0])

    @property
    def high(self) -> float:
        return float(self.text[1:-1].split(",")[1])

    def __contains__(self, value: Any) -> bool:
        if abs(value) > sys.float_info.max and isinstance(value, Integral):  # too large for a float
            return False
        above = value >= self.low if self.text[0] == "[" else value > self.low
        below = value <= self.high if self.text[-1] == "]" else value < self.high
        return bool(above and below)

    def __str__(self) -> str:
        bracket, low, high = self.text[0], plain(self.low), plain(self.high)
        lower = f"at least {low}" if bracket == "[" else "positive" if self.low == 0 else f"greater than {low}"
        upper = "finite" if self.high == math.inf else f"less than {high}"
        upper = upper if self.text[-1] == ")" else f"at most {high}"
        parts = [lower] * (self.low > -math.inf) + [upper] * (self.high < math.inf or self.text[-1] == ")")
        return " and ".join(parts)


def plain(value: Any) -> str:
    """Format a number briefly for messages."""
    try:
        return f"{int(value)}" if value == int(value) and abs(value) < 1e16 else f"{value:g}"
    except (OverflowError, ValueError):
        return short(value)


def short(value: Any) -> str:
    """Truncated repr of a value."""
    try:
        text = repr(value)
    except ValueError:  # an integer with more digits than Python prints
        return "a number with thousands of digits"
    return text if len(text) <= 60 else f"{text[:50]}..."
