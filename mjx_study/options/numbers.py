"""Numbers as text: intervals in words, ranges FROM:TO:COUNT, and numbers in messages."""

import dataclasses
import math
import sys
from numbers import Integral
from typing import Any, Final

MAX_VALUES: Final = 10_000
"""Maximum number of values in a list or range."""


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


def parse_number(text: str, kind: type) -> Any:
    """Read an int or float, 1e5 as an int too; other text is returned unchanged, for a check to refuse.

    ValueError for a number such as 1e400, which Python reads as infinity.
    """
    try:
        value = float(text)
    except ValueError:
        return text
    if math.isinf(value) and "inf" not in text.lower():
        raise ValueError(f"must be at most {sys.float_info.max:.2g} in size, got {short(text)}")
    if kind is float:
        return value
    try:
        return int(text)
    except ValueError:
        return int(value) if value.is_integer() else text


def expand_range(text: str, kind: type) -> list[Any]:
    """Expand FROM:TO:COUNT (evenly spaced) or FROM:TO:COUNT:log (equal ratios); both ends are exact."""
    parts = text.split(":")
    log = parts[3:] == ["log"]
    try:
        if len(parts) not in (3, 4) or (len(parts) == 4 and not log):
            raise ValueError
        start, stop, count = float(parts[0]), float(parts[1]), int(parts[2])
        if count < 2 or not math.isfinite(stop - start) or (log and not 0 < stop / start < math.inf):
            raise ValueError
    except (ValueError, ZeroDivisionError):
        raise ValueError(
            f"takes numbers and ranges FROM:TO:COUNT or FROM:TO:COUNT:log, COUNT at least 2; got {short(text)}"
        ) from None
    if count > MAX_VALUES:
        raise ValueError(f"takes at most {MAX_VALUES} values, got the range {short(text)}")
    shares = [index / (count - 1) for index in range(count)]
    if log:
        ratio, sign = math.log(stop / start), math.copysign(1.0, start)
        inner = [sign * float(f"{abs(start) * math.exp(share * ratio):.12g}") for share in shares]
    else:
        inner = [float(f"{start + share * (stop - start):.12g}") for share in shares]
    values = [start, *inner[1:-1], stop]
    return [int(value) if kind is int and value.is_integer() else value for value in values]
