"""The tables of docs/engines.md, from data/engines.jsonl alone."""

import itertools
import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from experiments import DATA, DOCS
from experiments.engines.catalog import ENGINES, ENVIRONMENTS
from experiments.engines.judge import combined, verdict
from experiments.engines.scenes import SCENES, TIMESTEPS, scene_named
from experiments.pages import markdown_row

CELLS: Final = DATA / "engines.jsonl"
CHECKS: Final = DATA / "engines_checks.jsonl"  # cells of variants of the scenes
TRIAL: Final = DATA / "engines_trial.jsonl"  # seconds that cells of `--quick` took
PAGE: Final = DOCS / "engines.md"
Cells = Mapping[tuple[str, str, float], Mapping[str, Any]]


def cells(path: Path) -> Cells:
    """Read cells by engine, scene and timestep; none if there is no file."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {(each["engine"], each["scene"], each["timestep"]): each for each in map(json.loads, lines)}


def tables(found: Cells, checks: Cells) -> dict[str, str]:
    """Return the page's tables: verdicts by engine and scene, each scene's numbers, times, versions, and `checks`."""
    matrix = [markdown_row("engine", "differentiated in", *SCENES), "|---" * (len(SCENES) + 2) + "|"]
    for name, engine in ENGINES.items():
        rows = [[found.get((name, scene, step)) for step in TIMESTEPS] for scene in SCENES]
        verdicts = (combined(row).replace("right", "**right**") for row in rows)
        matrix.append(markdown_row(engine.label, engine.how, *verdicts))
    kinds = {"matrix": "\n".join(matrix), "reasons": _reasons(found), "times": _times(found)}
    kinds |= {"versions": _versions(found), "checks": _checks(found, checks), "trial": _trial(cells(TRIAL))}
    return kinds | {each: _numbers(found, each) for each in SCENES}


def _times(found: Cells) -> str:
    """Milliseconds per gradient by engine and scene, at the longer timestep."""
    rows = [markdown_row("engine", *SCENES), "|---" * (len(SCENES) + 1) + "|"]
    for name, engine in ENGINES.items():
        cells = [found.get((name, scene, TIMESTEPS[0]), {}) for scene in SCENES]
        times = [cell.get("seconds_per_gradient") for cell in cells]
        if any(times):
            rows.append(
                markdown_row(engine.label, *(f"{float(f'{1000 * time:.2g}'):g}" if time else "-" for time in times))
            )
    return "\n".join(rows)


def _trial(found: Cells) -> str:
    """Minutes that cells of `--quick` took, by engine."""
    rows = [markdown_row("engine", "cells", "minutes"), "|---|---|---|"]
    for name, engine in ENGINES.items():
        seconds = [cell["seconds"] for key, cell in found.items() if key[0] == name]
        if seconds:
            rows.append(markdown_row(engine.label, str(len(seconds)), f"{sum(seconds) / 60:.1f}"))
    return "\n".join(rows)


def _versions(found: Cells) -> str:
    """Versions that the cells of each engine record, with numbers of cells, beside the pins of its environment."""
    rows = [markdown_row("engine", "measured with (cells)", "pinned"), "|---|---|---|"]
    names = {"mujoco": "MuJoCo", "jax": "JAX", "torch": "torch"}
    for name, engine in ENGINES.items():
        counts: Counter[str] = Counter()
        for key, cell in found.items():
            if key[0] == name:
                with_ = cell.get("versions") or {}
                counts[", ".join(f"{names[p]} {with_[p]}" for p in names if p in with_) or "not recorded"] += 1
        if counts:
            said = "; ".join(f"{versions} ({count})" for versions, count in sorted(counts.items()))
            pins = " ".join(ENVIRONMENTS[engine.environment].packages).replace("<", "&lt;")
            rows.append(markdown_row(engine.label, said, pins or "this project's"))
    return "\n".join(rows)


def _checks(found: Cells, checks: Cells) -> str:
    """Cells of variants of the toss, each engine's on the matrix's first."""
    head = ("engine", "timestep [ms]", "from [m]", "noise [cm]", "slope", "E[FoBG]", "verdict")
    rows = [markdown_row(*head), "|---" * len(head) + "|"]
    for (name, _, step), cell in checks.items():
        for each in (found.get((name, "toss", step)), cell):
            if each is None or "slope" not in each:
                continue
            scene = scene_named(each["scene"])
            numbers = (_both(each, "slope", "slope_by_differences"), _both(each, "mean", "mean_of_strata"))
            setting = (f"{1000 * step:g}", f"{scene.center:g}", f"{100 * scene.sigma:g}")
            rows.append(markdown_row(ENGINES[name].label, *setting, *numbers, verdict(each)))
    return "\n".join(dict.fromkeys(rows))


def _reasons(found: Cells) -> str:
    """Why cells have no numbers: the engine's reason, or that of its cells which were not measured."""
    scenes: dict[tuple[str, str], dict[str, list[float]]] = {}
    for name, scene, step in itertools.product(ENGINES, SCENES, TIMESTEPS):
        cell = found.get((name, scene, step))
        if cell is None or "error" in cell:
            reason = ENGINES[name].left if cell is None else cell["error"]
            scenes.setdefault((ENGINES[name].label, reason), {}).setdefault(scene, []).append(step)
    rows = []
    for (label, reason), steps in scenes.items():
        named = (each + ("" if len(of) == len(TIMESTEPS) else f" at {1000 * of[0]:g} ms") for each, of in steps.items())
        rows.append(markdown_row(label, ", ".join(named), reason))
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
