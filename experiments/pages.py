"""Where pages and data lie, tables between a page's markers, and small PNGs."""

import io
import re
from pathlib import Path
from typing import Final

from matplotlib.figure import Figure
from PIL import Image

ROOT: Final = Path(__file__).parents[1]
DOCS: Final = ROOT / "docs"
DATA: Final = Path(__file__).parent / "data"
DPI: Final = 130


def with_table(text: str, name: str, table: str) -> str:
    """Return a page's text with the table between `<!-- table: NAME -->` and `<!-- end -->` replaced."""
    block = rf"(<!-- table: {re.escape(name)} -->\n).*?(\n<!-- end -->)"
    text, found = re.subn(block, lambda match: f"{match[1]}{table}{match[2]}", text, flags=re.DOTALL)
    if found != 1:
        raise ValueError(f"a page needs one table {name}, this one has {found}")
    return text


def save_figure(figure: Figure, path: Path) -> None:
    """Write a PNG of 256 colours, which is a third of the size."""
    picture = io.BytesIO()
    figure.savefig(picture, dpi=DPI)
    Image.open(picture).convert("RGB").quantize(256, kmeans=3, dither=Image.Dither.NONE).save(path, optimize=True)
