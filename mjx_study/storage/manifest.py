"""study.json: what a plan writes into it, and its schema; files from elsewhere are validated before use."""

import dataclasses
import json
from collections import Counter, defaultdict
from typing import Annotated, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from estimators import find_estimator
from estimators.choices import ORACLES
from estimators.intervals import Interval
from estimators.registry import ESTIMATORS, label_of
from mjx_study.choices import KINDS, ONSETS
from mjx_study.experiment.study import StudyPlan, check_numbers, estimators_of
from mjx_study.graph.native import computes_steps
from mjx_study.identity import git_revision, versions
from mjx_study.options.configuration import OPTIONS
from mjx_study.options.files import digest_of_json, validated
from mjx_study.runtime import environment
from mjx_study.table import digits_to_tell_apart

SEEDS: Final = Interval(OPTIONS["seeds"].interval)
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Name = Annotated[str, Field(min_length=1, max_length=1000)]
Count = Annotated[int, Field(ge=1, le=10_000_000)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")


class _Config(_Part):
    kind: Literal[tuple(KINDS)]  # type: ignore[valid-type]
    tasks: list[Name] = Field(min_length=1)
    estimators: list[Name] = Field(min_length=1)
    seeds: int = Field(ge=1, le=int(SEEDS.high))
    iterations: Count | None
    points: Count | None = None
    confidence: Annotated[float, Field(gt=0, lt=1)] = 0.95
    damping: Finite | None = None
    onset: Literal[ONSETS] = "none"  # type: ignore[valid-type]


class _Described(_Part):
    label: Name
    needs: list[Literal[tuple(ORACLES)]] = Field(min_length=1)  # type: ignore[valid-type]


class _Axes(_Part):
    task: list[Name] = Field(min_length=1)
    timestep: list[Finite] = Field(min_length=1)
    cone: list[Name] = Field(min_length=1)
    model: list[Name] = Field(min_length=1)
    sigma: list[Finite] = Field(min_length=1)
    samples: list[Count] = Field(min_length=1)


class _Model(_Part):
    contact: str
    stiffness: Finite


class _Cell(_Part):
    label: str
    at: dict[str, Annotated[int, Field(ge=0)]]
    solref: Annotated[list[Finite], Field(min_length=2, max_length=2)] | None = None
    solimp: Annotated[list[Finite], Field(min_length=5, max_length=5)] | None = None


class _Resolved(_Part):
    horizon: list[Count]
    noise: Name
    estimators: dict[str, dict[str, Any]]
    parameters: Count = 1
    unit: str = ""
    damping: Finite = 0.0


class _Environment(_Part):
    versions: dict[str, str]


class StudyDocument(_Part):
    """The parts of a study.json that are read; other keys may hold anything."""

    digest: str
    config: _Config
    contents: dict[str, str]
    seen: dict[str, str] = {}
    versions: dict[str, str]
    warnings: list[str]
    environment: _Environment
    revision: str | None = None
    command: str | None = None
    described: dict[str, _Described] = {}
    models: list[_Model]
    axes: _Axes
    resolved: list[_Resolved]
    cells: list[_Cell] = Field(min_length=1)

    @model_validator(mode="after")
    def _fits_together(self) -> "StudyDocument":
        axes = {name: len(values) for name, values in vars(self.axes).items()}
        for name, values in vars(self.axes).items():
            if len(set(values)) < len(values):
                raise ValueError(f"axes.{name} has a value twice")
        if len(self.resolved) != axes["task"]:
            raise ValueError(f"there are {len(self.resolved)} entries of resolved, and {axes['task']} tasks")
        if len(self.models) != axes["model"]:
            raise ValueError(f"there are {len(self.models)} models, and {axes['model']} values of axes.model")
        for index, cell in enumerate(self.cells):
            if list(cell.at) != list(axes) or any(place >= axes[name] for name, place in cell.at.items()):
                raise ValueError(f"cells.{index}.at is no place on the axes")
        config = self.config
        for name in config.estimators:
            if name not in ESTIMATORS and name not in self.described:
                raise ValueError(f"config.estimators has {name!r}, which is neither built in nor described")
        check_numbers(vars(self.axes), vars(config))
        return self


def sealed(document: dict[str, Any]) -> bytes:
    """Write a study.json, with a digest of everything else in it."""
    return (json.dumps(document | {"digest": digest_of_json(document)}, indent=1) + "\n").encode()


def read_document(content: bytes | str) -> dict[str, Any]:
    """Read a study.json as plain data, without its digest; ValueError names the key that violates the schema, or says
    that the digest does not match."""
    validated(StudyDocument, content)
    document = json.loads(content)
    if document.pop("digest") != digest_of_json(document):
        raise ValueError("its digest does not match")
    return document


def document_of(plan: StudyPlan, command: str | None) -> dict[str, Any]:
    """The document of a plan. Coordinates are compared exactly, not by their printed names."""
    axes = plan.axes
    index = {name: {value: place for place, value in enumerate(along)} for name, along in axes.items()}
    places = [{name: index[name][value] for name, value in each.items()} for each in plan.coordinates]
    named = zip(plan.config.estimator_names, map(find_estimator, plan.config.estimators), strict=True)
    return {
        "config": plan.fields,
        "warnings": list(plan.warnings),
        "contents": plan.contents,
        "seen": plan.seen,
        "versions": versions(),
        "environment": environment() | {"steps": computes_steps()},
        "revision": git_revision(),
        "command": command,
        # what figures and reports need of an estimator, so that reading a study imports none
        "described": {
            name: {"label": found.own_label() or label_of(name), "needs": list(found.needs)} for name, found in named
        },
        "models": [{"contact": family, "stiffness": stiffness} for family, stiffness in axes["model"]],
        "axes": axes | {"task": _task_names(plan, axes["task"]), "model": _model_names(axes["model"])},
        "resolved": _resolved(plan, places, len(axes["task"])),
        "cells": [
            {"label": plan.label(cell), "at": at}
            | {name: getattr(cell.model.contact, name, None) for name in ("solref", "solimp")}  # None: the MJCF's
            for cell, at in zip(plan.cells, places, strict=True)
        ],
    }


def _resolved(plan: StudyPlan, places: list[dict[str, int]], tasks: int) -> list[dict[str, Any]]:
    """Settings that differ between tasks: noise, horizons and estimator options."""
    found: list[dict[str, Any]] = [{} for _ in range(tasks)]
    for cell, at in zip(plan.cells, places, strict=True):
        group, entry = plan.groups[cell.group], found[at["task"]]
        horizons = entry.setdefault("horizon", [])
        if group.task.horizon not in horizons:
            horizons.append(group.task.horizon)
        if "noise" not in entry:
            chosen = zip(plan.config.estimator_names, estimators_of(plan, cell), strict=True)
            entry["noise"] = group.task.noise
            entry["estimators"] = {name: dataclasses.asdict(estimator) for name, estimator in chosen}
            entry["recipe"] = {} if group.recipe is None else dataclasses.asdict(group.recipe)
            entry |= {"parameters": group.task.policy.num_params, "unit": getattr(group.task.policy, "unit", "")}
            entry["damping"] = group.task.defaults.damping or 0.0
    return found


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
