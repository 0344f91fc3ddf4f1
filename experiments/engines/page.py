"""The tables of docs/engines.md, from data/engines.jsonl alone."""

import itertools
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from experiments import DATA, DOCS, read_lines
from experiments.engines.catalog import ENGINES, ENVIRONMENTS
from experiments.engines.judge import combined, verdict
from experiments.engines.scenes import SCENES, TIMESTEPS, scene_named
from mjx_study.table import markdown_table

CELLS: Final = DATA / "engines.jsonl"
CHECKS: Final = DATA / "engines_checks.jsonl"  # cells of variants of the scenes
TRIAL: Final = DATA / "engines_trial.jsonl"  # seconds that cells of `--quick` took
PAGE: Final = DOCS / "engines.md"
Cells = Mapping[tuple[str, str, float], Mapping[str, Any]]


def cells(path: Path) -> Cells:
    """Read cells by engine, scene and timestep; none if there is no file."""
    return {(each["engine"], each["scene"], each["timestep"]): each for each in read_lines(path)}


def tables(found: Cells, checks: Cells) -> dict[str, str]:
    """Return the page's tables: verdicts by engine and scene, each scene's numbers, times, versions, and `checks`."""
    matrix = []
    for name, engine in ENGINES.items():
        rows = [[found.get((name, scene, step)) for step in TIMESTEPS] for scene in SCENES]
        matrix.append([engine.label, engine.how, *(combined(row).replace("right", "**right**") for row in rows)])
    kinds = {"matrix": markdown_table(matrix, ("engine", "differentiated in", *SCENES))}
    kinds |= {"reasons": _reasons(found), "times": _times(found)}
    kinds |= {"versions": _versions(found), "checks": _checks(found, checks), "trial": _trial(cells(TRIAL))}
    return kinds | {each: _numbers(found, each) for each in SCENES}


def _times(found: Cells) -> str:
    """Milliseconds per gradient by engine and scene, at the longer timestep."""
    rows = []
    for name, engine in ENGINES.items():
        cells = [found.get((name, scene, TIMESTEPS[0]), {}) for scene in SCENES]
        times = [cell.get("seconds_per_gradient") for cell in cells]
        if any(times):
            rows.append([engine.label, *(f"{float(f'{1000 * time:.2g}'):g}" if time else "-" for time in times)])
    return markdown_table(rows, ("engine", *SCENES))


def _trial(found: Cells) -> str:
    """Minutes that cells of `--quick` took, by engine."""
    rows = []
    for name, engine in ENGINES.items():
        seconds = [cell["seconds"] for key, cell in found.items() if key[0] == name]
        if seconds:
            rows.append([engine.label, len(seconds), f"{sum(seconds) / 60:.1f}"])
    return markdown_table(rows, ("engine", "cells", "minutes"))


def _versions(found: Cells) -> str:
    """Versions that the cells of each engine record, with numbers of cells, beside the pins of its environment."""
    rows, names = [], {"mujoco": "MuJoCo", "jax": "JAX", "torch": "torch"}
    for name, engine in ENGINES.items():
        counts: Counter[str] = Counter()
        for key, cell in found.items():
            if key[0] == name:
                with_ = cell.get("versions") or {}
                counts[", ".join(f"{names[p]} {with_[p]}" for p in names if p in with_) or "not recorded"] += 1
        if counts:
            said = "; ".join(f"{versions} ({count})" for versions, count in sorted(counts.items()))
            pins = " ".join(ENVIRONMENTS[engine.environment].packages).replace("<", "&lt;")
            rows.append([engine.label, said, pins or "this project's"])
    return markdown_table(rows, ("engine", "measured with (cells)", "pinned"))


def _checks(found: Cells, checks: Cells) -> str:
    """Cells of variants of the toss, each engine's on the matrix's first."""
    rows = []
    for (name, _, step), cell in checks.items():
        for each in (found.get((name, "toss", step)), cell):
            if each is None or "slope" not in each:
                continue
            scene = scene_named(each["scene"])
            numbers = (_both(each, "slope", "slope_by_differences"), _both(each, "mean", "mean_of_strata"))
            setting = (f"{1000 * step:g}", f"{scene.center:g}", f"{100 * scene.sigma:g}")
            rows.append((ENGINES[name].label, *setting, *numbers, verdict(each)))
    header = ("engine", "timestep [ms]", "from [m]", "noise [cm]", "slope", "E[FoBG]", "verdict")
    return markdown_table(dict.fromkeys(rows), header)


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
        rows.append([label, ", ".join(named), reason])
    return markdown_table(rows, ("engine", "scenes", "reason"))


def _numbers(found: Cells, scene: str) -> str:
    """Slope, mean of the derivatives and their error at points of one scene; engines without a cell are left out."""
    rows, steps = [], " and ".join(f"{1000 * step:g}" for step in TIMESTEPS)
    for name, engine in ENGINES.items():
        cells = [found.get((name, scene, step)) for step in TIMESTEPS]
        if any(cell and "slope" in cell for cell in cells):
            slopes = (_both(cell, "slope", "slope_by_differences") for cell in cells)
            means = (_both(cell, "mean", "mean_of_strata") for cell in cells)
            shares = (f"{cell['point_share']:.0%}" if cell and "slope" in cell else "-" for cell in cells)
            rows.append([engine.label, *map(", ".join, (slopes, means, shares))])
    return markdown_table(rows, ("engine", f"slope, {steps} ms", "E[FoBG]", "right at points"))


def _both(cell: Mapping[str, Any] | None, *ways: str) -> str:
    """Both ways to measure a number where they differ in what is printed."""
    if cell is None or ways[0] not in cell:
        return "-"
    first, other = (cell[way] for way in ways)
    return f"{first:.3g}" if abs(first - other) < 0.01 * abs(first) else f"{first:.3g} or {other:.3g}"
