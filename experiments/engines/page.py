"""The tables of docs/engines.md, from data/engines.jsonl alone."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from experiments import DATA, DOCS
from experiments.engines.catalog import ENGINES
from experiments.engines.judge import combined
from experiments.engines.scenes import TIMESTEPS
from experiments.pages import markdown_row

CELLS: Final = DATA / "engines.jsonl"
PAGE: Final = DOCS / "engines.md"
SHOWN: Final = ("toss", "ball_wall", "slide")
"""Scenes that are measured and shown."""

Cells = Mapping[tuple[str, str, float], Mapping[str, Any]]


def cells(path: Path) -> Cells:
    """Read cells by engine, scene and timestep; none if there is no file."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {(each["engine"], each["scene"], each["timestep"]): each for each in map(json.loads, lines)}


def tables(found: Cells) -> dict[str, str]:
    """Return the page's tables: verdicts by engine and scene, and the numbers of each scene."""
    matrix = [markdown_row("engine", "differentiated in", *SHOWN), "|---" * (len(SHOWN) + 2) + "|"]
    for name, engine in ENGINES.items():
        rows = [[found.get((name, scene, step)) for step in TIMESTEPS] for scene in SHOWN]
        matrix.append(markdown_row(engine.label, engine.how, *map(combined, rows)))
    return {"matrix": "\n".join(matrix), **{scene: _numbers(found, scene) for scene in SHOWN}}


def _numbers(found: Cells, scene: str) -> str:
    """Slope, mean of the derivatives and their error at points of one scene; engines without a cell are left out."""
    steps = " and ".join(f"{1000 * step:g}" for step in TIMESTEPS)
    lines = [markdown_row("engine", f"slope, {steps} ms", "E[FoBG]", "right at points"), "|---|---|---|---|"]
    for name, engine in ENGINES.items():
        row = [found.get((name, scene, step)) for step in TIMESTEPS]
        if any(row):
            lines.append(
                markdown_row(
                    engine.label,
                    ", ".join(_both(cell, "slope", "slope_by_differences") for cell in row),
                    ", ".join(_both(cell, "mean", "mean_of_strata") for cell in row),
                    ", ".join("-" if cell is None else f"{cell.get('point_share', 0):.0%}" for cell in row),
                )
            )
    return "\n".join(lines)


def _both(cell: Mapping[str, Any] | None, *ways: str) -> str:
    """Both ways to measure a number where they differ in what is printed."""
    if cell is None or ways[0] not in cell:
        return "-"
    first, other = (cell[way] for way in ways)
    return f"{first:.3g}" if abs(first - other) < 0.01 * abs(first) else f"{first:.3g} or {other:.3g}"
