"""Numbers as text, and ranges FROM:TO:COUNT of them."""

import math
import sys
from typing import Any, Final

from estimators.intervals import short

MAX_VALUES: Final = 10_000
"""Maximum number of values in a list or range."""


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
