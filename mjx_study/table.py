"""Results as text tables, numbers as text, and both as plain data."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Final, TypeVar

Item = TypeVar("Item")
Key = TypeVar("Key")
ROUNDING: Final = 1e-12
"""Error over the value below which it is one of rounding."""


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of a text table.

    Attributes:
        heading: its heading.
        text: formats a row's cell.
        meaning: its explanation in the help of a command.
    """

    heading: str
    text: Callable[[Any], str]
    meaning: str = ""


def tabulate(rows: Iterable[Any], columns: Sequence[Column], *, omit: str | None = None) -> list[str]:
    """Format a line per row below the headings; columns in which every cell is `omit` are left out."""
    rows = list(rows)
    shown = [column for column in columns if not rows or any(column.text(row) != omit for row in rows)]
    return format_table([[column.text(row) for column in shown] for row in rows], [each.heading for each in shown])


def format_table(rows: Sequence[Sequence[str]], header: Sequence[str]) -> list[str]:
    """Format right-aligned columns two spaces apart."""
    widths = [max(map(len, cells)) for cells in zip(header, *rows, strict=True)]
    return ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in (header, *rows)]


def markdown_table(rows: Iterable[Sequence[Any]], header: Sequence[str]) -> str:
    """Format a table in Markdown, without a line feed at its end."""
    lines = [f"| {' | '.join(map(str, row))} |" for row in (header, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(header), *lines[1:]])


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


def with_error(value: float, error: float | None, digits: int = 3) -> str:
    """Format a number and its error to the error's second digit; the number alone if its error is unknown."""
    if error is None or not (math.isfinite(value) and math.isfinite(error)):
        return number(value, digits)
    if error <= ROUNDING * abs(value):
        return f"{number(value, digits)} ± 0"
    decimals = 1 - math.floor(math.log10(error))
    return f"{_to_decimals(value, decimals)} ± {_to_decimals(error, decimals)}"


def _to_decimals(value: float, decimals: int) -> str:
    """Format to a number of decimals, which is negative for large errors."""
    rounded = round(value, decimals)
    if rounded == 0 or 1e-4 <= abs(rounded) < 1e6:
        return f"{rounded:.{max(0, decimals)}f}" if rounded else "0"
    mantissa, exponent = f"{rounded:.{max(0, decimals + math.floor(math.log10(abs(rounded))))}e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def plural(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Group items by a key, in the order in which the keys occur."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def percent(share: float, digits: int = 0) -> str:
    return f"{100 * share:.{digits}f} %"


def described(meanings: Mapping[str, str]) -> str:
    """Format names with what they mean, a line each."""
    width = max(map(len, meanings))
    return "\n".join(f"  {name:<{width}}  {meaning}" for name, meaning in meanings.items())


def as_plain(document: Any) -> Any:
    """Convert to JSON types: arrays and tuples to lists, nonfinite numbers to null, an infinite gamma to "inf"."""
    if isinstance(document, Mapping):
        infinite = {"gamma": "inf"} if document.get("gamma") == math.inf else {}
        return {str(key): as_plain(item) for key, item in {**document, **infinite}.items()}
    if hasattr(document, "tolist"):  # of NumPy or JAX
        return as_plain(document.tolist())
    if isinstance(document, list | tuple):
        return [as_plain(item) for item in document]
    return None if isinstance(document, float) and not math.isfinite(document) else document


def explain(*columns: Column) -> str:
    """Format the headings of columns with their meanings, a line each."""
    return described({column.heading: column.meaning for column in columns})


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
    rounded = float(f"{number / least:.2g}")
    return f"{rounded:,.0f} {unit}" if rounded >= 10 else f"{rounded:g} {unit}"
