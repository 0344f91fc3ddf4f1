"""Measurements, tables and figures behind the pages of docs/, not installed and not imported by the library.

Each module runs from the root of a checkout as `python -m experiments.NAME`; its docstring gives the arguments.
"""

from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
DOCS: Final = ROOT / "docs"
DATA: Final = Path(__file__).parent / "data"
