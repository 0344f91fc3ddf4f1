"""Measurements, tables and figures behind the pages of docs/, not installed and not imported by the library.

Each module runs from the root of a checkout as `python -m experiments.NAME`; its docstring gives the arguments.
"""

import json
import re
from pathlib import Path
from typing import Any, Final

ROOT: Final = Path(__file__).parents[1]
DOCS: Final = ROOT / "docs"
DATA: Final = Path(__file__).parent / "data"


def write_json(path: Path, document: Any) -> None:
    """Write a document, each of its innermost lists and objects in one line."""
    text = json.dumps(document, indent=1, allow_nan=False)
    innermost = r"[\[{][^][{}]*[]}]"
    path.write_text(re.sub(innermost, lambda match: re.sub(r"\n *", " ", match[0]), text) + "\n")
