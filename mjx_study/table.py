"""Plain-text tables, and numbers as text."""

from collections.abc import Iterable, Sequence


def format_table(rows: Sequence[Sequence[str]], header: Sequence[str]) -> list[str]:
    """Right-aligned columns two spaces apart."""
    widths = [max(map(len, cells)) for cells in zip(header, *rows, strict=True)]
    return ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in (header, *rows)]


def digits_to_tell_apart(values: Iterable[float | int], least: int = 6) -> int:
    """Significant digits, `least` or more, with which different values get different texts; 17 do for any."""
    distinct = set(values)
    return next(
        (digits for digits in range(least, 17) if len({f"{value:.{digits}g}" for value in distinct}) == len(distinct)),
        17,
    )
