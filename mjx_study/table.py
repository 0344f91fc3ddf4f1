"""Plain-text tables, and numbers as text."""

import math
from collections.abc import Iterable, Mapping, Sequence


def format_table(rows: Sequence[Sequence[str]], header: Sequence[str]) -> list[str]:
    """Format right-aligned columns two spaces apart."""
    widths = [max(map(len, cells)) for cells in zip(header, *rows, strict=True)]
    return ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in (header, *rows)]


def number(value: float | None, digits: int = 3) -> str:
    """Format a number in few characters; `-` for None, `nan` and `inf` unchanged."""
    if value is None:
        return "-"
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if 1e-3 <= abs(value) < 1e4:
        rounded = float(f"{value:.{digits}g}")
        return f"{rounded:.0f}" if abs(rounded) >= 10 ** (digits - 1) else f"{rounded:.{digits}g}"
    mantissa, exponent = f"{value:.{digits - 1 if digits > 3 else 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def described(meanings: Mapping[str, str]) -> str:
    """Format names with what they mean, a line each."""
    width = max(map(len, meanings))
    return "\n".join(f"  {name:<{width}}  {meaning}" for name, meaning in meanings.items())


def digits_to_tell_apart(values: Iterable[float | int], least: int = 6) -> int:
    """Significant digits, at least `least`, that give different values different texts; 17 suffice for any."""
    distinct = set(values)
    return next(
        (digits for digits in range(least, 17) if len({f"{value:.{digits}g}" for value in distinct}) == len(distinct)),
        17,
    )


def count(number: int) -> str:
    """Format a count to four digits, in groups of three."""
    return f"{float(f'{number:.4g}'):,.0f}"


def size(number: int | float) -> str:
    """Format a number of bytes to two digits, in a suitable unit."""
    unit, least = next((each for each in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)) if number >= each[1]), ("bytes", 1))
    return f"{_rounded(number / least)} {unit}"


def duration(seconds: float | int) -> str:
    """Format a time to two digits, in a suitable unit."""
    longer = (("days", 86400), ("h", 3600), ("min", 60))
    unit, length = next((each for each in longer if seconds >= 2 * each[1]), ("s", 1))
    return f"{_rounded(seconds / length)} {unit}"


def _rounded(number: float | int) -> str:
    two_digits = float(f"{number:.2g}")
    return f"{two_digits:,.0f}" if two_digits >= 10 else f"{two_digits:g}"
