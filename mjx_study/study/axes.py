"""The grid of a study: coordinates along every dimension, and each cell's indices."""

import dataclasses
from collections import Counter, defaultdict
from typing import Any, Final

import numpy as np

from mjx_study.study.plan import StudyCell, StudyPlan
from mjx_study.table import digits_to_tell_apart

SORTED: Final = ("timestep", "sigma", "samples")
"""Dimensions sorted in ascending order; the others keep the order of the configuration."""


@dataclasses.dataclass(frozen=True)
class Axes:
    """The grid of a sweep.

    Attributes:
        values: coordinates by dimension; tasks, cones and contact models by name, all different.
        models: contact family and stiffness [N/m] of each contact model.
        places: each cell's index along every dimension.
    """

    values: dict[str, list[Any]]
    models: tuple[dict[str, Any], ...]
    places: tuple[dict[str, int], ...]


def axes_of(plan: StudyPlan) -> Axes:
    """Return the grid of a plan. Values are compared exactly, not by their printed names."""
    exact = [_exact(plan, cell) for cell in plan.cells]
    values = {name: list(dict.fromkeys(each[name] for each in exact)) for name in exact[0]}
    for name in SORTED:
        values[name].sort()
    index = {name: {value: place for place, value in enumerate(along)} for name, along in values.items()}
    places = tuple({name: index[name][value] for name, value in each.items()} for each in exact)
    models = tuple({"contact": family, "stiffness": stiffness} for family, stiffness in values["model"])
    named = values | {"task": _task_names(plan, values["task"]), "model": _model_names(values["model"])}
    return Axes(named, models, places)


def solver_parameters(cell: StudyCell) -> dict[str, list[float] | None]:
    """solref and solimp of a cell's contact; None if the MJCF's apply."""
    contact = cell.model.contact
    if contact is None:
        return {"solref": None, "solimp": None}
    return {"solref": np.asarray(contact.solref).tolist(), "solimp": np.asarray(contact.solimp).tolist()}


def solver_arrays(cell: dict[str, Any]) -> dict[str, np.ndarray]:
    """solref and solimp of a cell in a study.json; NaN if the MJCF's apply."""
    sizes = {"solref": 2, "solimp": 5}
    return {
        name: np.full(size, np.nan) if cell.get(name) is None else np.array(cell[name]) for name, size in sizes.items()
    }


def _exact(plan: StudyPlan, cell: StudyCell) -> dict[str, Any]:
    group = plan.groups[cell.group]
    return {
        "task": group.name,
        "timestep": group.timestep,
        "cone": group.cone,
        "model": (cell.model.family, cell.model.stiffness),
        "sigma": cell.sigma,
        "samples": cell.samples,
    }


def _task_names(plan: StudyPlan, configured: list[str]) -> list[str]:
    """The tasks' own names, or the configuration's where several tasks share one."""
    own = {group.name: group.task.name for group in plan.groups}
    shared = Counter(own[name] for name in configured)
    return [name if shared[own[name]] > 1 else own[name] for name in configured]


def _model_names(models: list[tuple[str, float]]) -> list[str]:
    """Family and stiffness, with enough digits to distinguish a family's stiffnesses."""
    by_family = defaultdict(list)
    for family, stiffness in models:
        by_family[family].append(stiffness)
    digits = {family: digits_to_tell_apart(values) for family, values in by_family.items()}
    return [f"{family} {stiffness:.{digits[family]}g}" if stiffness else family for family, stiffness in models]
