"""The tables of docs/engines.md, from data/engines.jsonl alone."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from experiments import DATA, DOCS
from experiments.engines.catalog import ENGINES
from experiments.engines.judge import combined
from experiments.engines.scenes import SCENES, TIMESTEPS
from experiments.pages import markdown_row

CELLS: Final = DATA / "engines.jsonl"
PAGE: Final = DOCS / "engines.md"
Cells = Mapping[tuple[str, str, float], Mapping[str, Any]]


def cells(path: Path) -> Cells:
    """Read cells by engine, scene and timestep; none if there is no file."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {(each["engine"], each["scene"], each["timestep"]): each for each in map(json.loads, lines)}


def tables(found: Cells) -> dict[str, str]:
    """Return the page's tables: verdicts by engine and scene, and the numbers of each scene."""
    matrix = [markdown_row("engine", "differentiated in", *SCENES), "|---" * (len(SCENES) + 2) + "|"]
    for name, engine in ENGINES.items():
        rows = [[found.get((name, scene, step)) for step in TIMESTEPS] for scene in SCENES]
        verdicts = (combined(row).replace("right", "**right**") for row in rows)
        matrix.append(markdown_row(engine.label, engine.how, *verdicts))
    return {"matrix": "\n".join(matrix), "reasons": _reasons(found)} | {each: _numbers(found, each) for each in SCENES}


def _reasons(found: Cells) -> str:
    """Why scenes were not measured: the engines' reasons, and their cells."""
    cells: dict[tuple[str, str], list[str]] = {}
    for (name, scene, step), cell in found.items():
        if "error" in cell and step == TIMESTEPS[0]:
            cells.setdefault((ENGINES[name].label, cell["error"]), []).append(scene)
    rows = [markdown_row(label, ", ".join(scenes), reason) for (label, reason), scenes in cells.items()]
    return "\n".join([markdown_row("engine", "scenes", "reason"), "|---|---|---|", *rows])


def _numbers(found: Cells, scene: str) -> str:
    """Slope, mean of the derivatives and their error at points of one scene; engines without a cell are left out."""
    steps = " and ".join(f"{1000 * step:g}" for step in TIMESTEPS)
    lines = [markdown_row("engine", f"slope, {steps} ms", "E[FoBG]", "right at points"), "|---|---|---|---|"]
    for name, engine in ENGINES.items():
        row = [found.get((name, scene, step)) for step in TIMESTEPS]
        if any(cell and "slope" in cell for cell in row):
            lines.append(
                markdown_row(
                    engine.label,
                    ", ".join(_both(cell, "slope", "slope_by_differences") for cell in row),
                    ", ".join(_both(cell, "mean", "mean_of_strata") for cell in row),
                    ", ".join(f"{cell['point_share']:.0%}" if cell and "slope" in cell else "-" for cell in row),
                )
            )
    return "\n".join(lines)


def _both(cell: Mapping[str, Any] | None, *ways: str) -> str:
    """Both ways to measure a number where they differ in what is printed."""
    if cell is None or ways[0] not in cell:
        return "-"
    first, other = (cell[way] for way in ways)
    return f"{first:.3g}" if abs(first - other) < 0.01 * abs(first) else f"{first:.3g} or {other:.3g}"
