"""Documents of studies whose cells hold whatever a test writes into them."""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
import xarray as xr

from mjx_study.execution.cells import Cells, compute_here
from mjx_study.experiment.gradients import Gradients
from mjx_study.experiment.study import Checkpoint, Computation, StudyCell, StudyPlan, done
from mjx_study.progress import silent
from mjx_study.results.kind import find_kind
from mjx_study.storage.arrays import required, sizes_of
from mjx_study.storage.manifest import document_of, sealed

MEASURED: Final = ("seconds", "seconds_per_sample")
"""Measured times, the only variables that differ from run to run."""


def study_document(cells: int, **changes: Any) -> dict[str, Any]:
    """What a study.json holds, of as many cells along the contact models; `changes` go into its configuration."""
    config: dict[str, Any] = {"kind": "gradients", "tasks": ["test"], "estimators": ["zobg"], "seeds": 1}
    axes: dict[str, list[Any]] = {"task": ["test"], "timestep": [0.1], "cone": ["pyramidal"]}
    axes |= {"model": [f"model {index}" for index in range(cells)], "sigma": [0.1], "samples": [4]}
    places = [dict.fromkeys(axes, 0) | {"model": index} for index in range(cells)]
    return {
        "config": config | {"iterations": None} | changes,
        "contents": {},
        "versions": {},
        "warnings": [],
        "environment": {"versions": {}},
        "models": [{"contact": "model", "stiffness": float(index)} for index in range(cells)],
        "axes": axes,
        "resolved": [{"horizon": [1], "noise": "gaussian", "estimators": {}}],
        "cells": [{"label": str(index), "at": at} for index, at in enumerate(places)],
    }


def cell_arrays(document: Mapping[str, Any], index: int = 0, **given: Any) -> dict[str, np.ndarray]:
    """What the schema asks of a cell: NaN, and 0 for counts, but for the arrays that are given."""
    kind, sizes = find_kind(document["config"]["kind"]), sizes_of(document, index)
    variables = {name: kind.variables[name] for name in required(kind)}
    blank = {
        name: np.full([sizes[dim] for dim in each.dims], np.nan if each.digits else 0.0)
        for name, each in variables.items()
    }
    return blank | {name: np.asarray(value) for name, value in given.items()}


def planned_arrays(plan: StudyPlan, cell: StudyCell, **given: Any) -> dict[str, np.ndarray]:
    """The same for a cell of a plan."""
    return cell_arrays(document_of(plan, None), plan.cells.index(cell), **given)


def numbers_of(plan: StudyPlan, cell: StudyCell | None = None) -> dict[str, np.ndarray]:
    """Compute a cell of a plan, its first unless given."""
    index = 0 if cell is None else plan.cells.index(cell)
    return dict(compute_here(Cells(plan, plan.kind.computation(plan), silent), [index]))[index]


def stub_cells(patch: pytest.MonkeyPatch, compute: Callable[[StudyPlan, StudyCell], dict[str, np.ndarray]]) -> None:
    """Let cells of gradients have made-up numbers."""

    class Stubbed(Computation):
        def __init__(self, plan: StudyPlan):
            self.plan = plan

        def compute(self, cell: StudyCell, unit: int, checkpoint: Checkpoint) -> Any:
            return done(compute(self.plan, cell))

    patch.setattr(Gradients, "computation", lambda self, plan: Stubbed(plan))


def content(folder: Path) -> dict[Path, bytes]:
    """Every file in a folder."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def same(one: xr.Dataset, other: xr.Dataset) -> bool:
    """Whether all but measured times is equal, bit for bit."""
    return one.drop_vars(MEASURED, errors="ignore").equals(other.drop_vars(MEASURED, errors="ignore"))


def altered(path: Path, **changes: Any) -> None:
    """Change keys of a study.json, which gets a digest that matches."""
    path.write_bytes(sealed(json.loads(path.read_text()) | changes))


def stages_of(told: str) -> list[str]:
    """The stages that a command names on standard error where that is no terminal, without their times and the signs of
    life between them."""
    lines = told.splitlines()
    assert all(re.match(r" *\d+\.\d s  ", line) for line in lines), told
    return [found for line in lines if (found := line.partition(" s  ")[2]).startswith("[")]
