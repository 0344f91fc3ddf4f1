"""Measurements, tables and figures behind the pages of docs/, not installed and not imported by the library.

Each module runs from the root of a checkout as `python -m experiments.NAME`; its docstring gives the arguments.
"""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).parents[1]
DOCS: Final = ROOT / "docs"
DATA: Final = Path(__file__).parent / "data"


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects of a file of JSON lines; none if there is no such file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def append_line(path: Path, found: Mapping[str, Any]) -> None:
    """Append an object to a file of JSON lines."""
    with path.open("a") as file:
        file.write(json.dumps(found) + "\n")


def write_json(path: Path, document: Any) -> None:
    """Write a document, each of its innermost lists and objects in one line."""
    text = json.dumps(document, indent=1, allow_nan=False)
    innermost = r"[\[{][^][{}]*[]}]"
    path.write_text(re.sub(innermost, lambda match: re.sub(r"\n *", " ", match[0]), text) + "\n")
