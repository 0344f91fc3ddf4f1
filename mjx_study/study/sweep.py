"""Sweeps over contact, timestep, noise and sample count, cell by cell into a folder that survives being killed.

A cell is one task, timestep, cone, contact model, sigma and sample count, with all seeds and estimators. It depends on
the configuration alone, not on which cells were computed before it or by whom. Timestep and cone need a compilation of
their own; everything else is traced.
"""

import dataclasses
import time
from pathlib import Path
from typing import Final

import xarray as xr

from estimators import ENOUGH_EFFECTIVE
from mjx_study.disk import prepare_folder
from mjx_study.runtime import environment
from mjx_study.study.axes import axes_of, solver_parameters
from mjx_study.study.cells import COMPUTE, VARIABLES
from mjx_study.study.configuration import Progress
from mjx_study.study.identity import contents, estimator_contents, versions
from mjx_study.study.plan import SweepConfig, SweepPlan, plan_sweep
from mjx_study.study.revision import git_revision
from mjx_study.study.store import Store, StudyError, assemble, write_dataset
from mjx_study.tasks.task import Task

WAIT_SECONDS: Final = 0.5
"""Between looks at cells that another process computes."""

UNITS: Final = {"timestep": "s", "sigma": "unit of what the noise is added to", "samples": "1"}


@dataclasses.dataclass(frozen=True)
class SweepResult:
    """What a sweep left.

    Attributes:
        folder: where it is.
        dataset: all numbers, labelled.
        computed: cells that this run computed.
        warnings: about contact models, and about what the numbers hold.
    """

    folder: Path
    dataset: xr.Dataset
    computed: int
    warnings: tuple[str, ...]


def open_store(plan: SweepPlan, folder: Path, command: str | None = None, *, accept_versions: bool = False) -> Store:
    """The folder of a plan, new or begun; one that was begun keeps its chunk size unless the plan gives another.

    Args:
        plan: of the sweep.
        folder: where it is to be.
        command: that asked for it, to be kept; None where no command did.
        accept_versions: go on with a study that other versions began.

    Raises:
        ValueError: it cannot be written to, or holds another study.
    """
    config = dataclasses.asdict(plan.config)
    config |= {"kind": plan.config.kind, "seeds": plan.config.batches}
    if plan.config.chunk_size is None:
        begun = (folder / "study.json").exists()
        config["chunk_size"] = Store.open(folder).document["config"]["chunk_size"] if begun else plan.chunk_size
    axes = axes_of(plan)
    document = {
        "config": config,
        "warnings": list(plan.warnings),
        "contents": contents(_forms(plan)) | estimator_contents(*plan.config.estimators),
        "versions": versions(),
        "environment": environment(),
        "revision": git_revision(),
        "command": command,
        "models": list(axes.models),
        "axes": axes.values,
        "cells": [
            {"label": plan.label(cell), "at": at} | solver_parameters(cell)
            for cell, at in zip(plan.cells, axes.places, strict=True)
        ],
    }
    return Store.create(prepare_folder(folder), document, accept_versions=accept_versions)


def _forms(plan: SweepPlan) -> dict[str, list[Task]]:
    """By the configuration's name of a task, what it is with every timestep and cone."""
    forms: dict[str, list[Task]] = {}
    for group in plan.groups:
        forms.setdefault(group.name, []).append(group.task)
    return forms


def run_sweep(
    plan: SweepPlan,
    folder: str | Path,
    progress: Progress = lambda done, total, what: None,
    *,
    command: str | None = None,
    accept_versions: bool = False,
) -> SweepResult:
    """Compute what is missing of a study, beside any other process that does the same.

    Args:
        plan: of the sweep.
        folder: of the study, new or begun.
        progress: called before every cell.
        command: that asked for it, to be kept with a new study.
        accept_versions: go on with a study that other versions of JAX, MuJoCo or this package began.

    Raises:
        ValueError: the folder holds another study, or cannot be written to.
        StudyError: a file of the study is damaged.
        OSError: a cell could not be written; what was written before is kept.
    """
    folder = Path(folder)
    store = open_store(plan, folder, command, accept_versions=accept_versions)
    chunk = store.document["config"]["chunk_size"]
    plan = dataclasses.replace(plan, config=dataclasses.replace(plan.config, chunk_size=chunk))
    for index in range(len(plan.cells)):
        if store.has(index):
            store.read(index)  # a damaged file is refused before anything is computed
    compute = COMPUTE[plan.config.kind](plan)
    total, computed = len(plan.cells), 0
    while missing := store.missing:
        claimed = False
        for index in missing:
            progress(total - len(store.missing), total, plan.label(plan.cells[index]))
            with store.claim(index) as ours:
                if not ours or store.has(index):
                    continue
                store.write(index, compute(plan.cells[index]))
                claimed, computed = True, computed + 1
        if not claimed and store.missing:
            progress(total - len(store.missing), total, "another process computes the rest")
            time.sleep(WAIT_SECONDS)
    progress(total, total, "done")
    dataset = load_study(folder)
    write_dataset(dataset, folder / "results.nc")
    return SweepResult(folder, dataset, computed, plan.warnings + what_to_beware_of(dataset))


def load_study(folder: str | Path) -> xr.Dataset:
    """The numbers of a study as labelled arrays, those of an unfinished one too; NaN for what is missing.

    Dimensions: task, timestep, cone, model (a contact model, with its family as coordinate `contact` and its
    `stiffness`), sigma, samples, then seed, estimator, iteration and point, those that the variables have.

    Raises:
        StudyError: there is no study, or a file of it is damaged.
    """
    store = Store.open(Path(folder))
    document = store.document
    config, axes, models = document["config"], document["axes"], document["models"]
    dimensions = dict(axes) | {"estimator": config["estimators"], "seed": list(range(config["seeds"]))}
    dimensions["iteration"] = list(range(1, (config["iterations"] or 0) + 1))
    dimensions["point"] = list(range(config.get("points") or 0))
    along = {
        "contact": ("model", [model["contact"] for model in models], ""),
        "stiffness": ("model", [model["stiffness"] for model in models], "N/m"),
    }
    return assemble(store, dimensions, VARIABLES[config["kind"]], along, UNITS)


def what_to_beware_of(dataset: xr.Dataset) -> tuple[str, ...]:
    """Warnings about the numbers of a study."""
    found = []
    if dataset.attrs["missing_cells"]:
        found.append(f"{dataset.attrs['missing_cells']} cells are not computed yet; the same command goes on")
    if dataset.attrs.get("mixed_versions"):
        found.append(f"cells were computed with different versions: {dataset.attrs['mixed_versions']}")
    for name, says in (
        ("nonfinite", "samples overflowed or became NaN and were left out"),
        ("unconverged", "rollouts in which the contact solver did not converge"),
    ):
        if name in dataset and float(dataset[name].sum()) > 0:
            found.append(f"{int(dataset[name].sum())} {says}")
    if "effective_samples" in dataset and (few := int((dataset["effective_samples"] < ENOUGH_EFFECTIVE).sum())):
        found.append(
            f"{few} batches rest on fewer than {ENOUGH_EFFECTIVE:g} effective samples: do not believe their errors, "
            "p-values and variances (effective_samples says which)"
        )
    if "stopped_at" in dataset and bool(dataset["stopped_at"].notnull().any()):
        found.append(f"{int(dataset['stopped_at'].notnull().sum())} descents stopped before their last iteration")
    return tuple(found)


__all__ = ["StudyError", "SweepConfig", "SweepPlan", "SweepResult", "load_study", "plan_sweep", "run_sweep"]
