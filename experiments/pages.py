"""Markdown tables between the markers of a page, and small PNGs."""

import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from matplotlib.figure import Figure
from PIL import Image

from experiments import DOCS

DPI: Final = 130


def markdown_row(*cells: Any) -> str:
    """Format one row of a Markdown table, for scripts that print as they measure."""
    return f"| {' | '.join(map(str, cells))} |"


def replace_tables(text: str, tables: Mapping[str, str]) -> str:
    """Replace what stands between `<!-- table: NAME -->` and `<!-- end -->` in a page's text.

    Raises:
        ValueError: the page does not have exactly one table of a name.
    """
    for name, table in tables.items():
        block = rf"(<!-- table: {re.escape(name)} -->\n)(?:(?!<!--).)*(<!-- end -->)"
        text, found = re.subn(block, lambda match, table=table: f"{match[1]}{table}\n{match[2]}", text, flags=re.DOTALL)
        if found != 1:
            raise ValueError(f"the page must have one table {name}, it has {found}")
    return text


def write_tables(page: Path, tables: Mapping[str, str]) -> None:
    """Replace tables of a page, and print where."""
    page.write_text(replace_tables(page.read_text(), tables))
    print(f"written: {page}")


def save_figure(figure: Figure, name: str) -> None:
    """Write docs/NAME.png with 256 colours, which takes a third of the size, and print where."""
    path, picture = DOCS / f"{name}.png", io.BytesIO()
    figure.savefig(picture, dpi=DPI)
    Image.open(picture).convert("RGB").quantize(256, kmeans=3, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"written: {path}, {path.stat().st_size // 1000} kB")
