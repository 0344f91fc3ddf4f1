"""Sweeps over contact, timestep, noise and sample count, cell by cell into a folder that survives being killed.

A cell is one task, timestep, cone, contact model, sigma and sample count, with all seeds and estimators. It depends on
the configuration alone, not on which cells were computed before it or by whom. Timestep and cone need a compilation of
their own; everything else is traced.
"""

import dataclasses
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Key

import estimators
from estimators import ESTIMATORS, ORACLES
from mjx_study.configuration import Progress
from mjx_study.objective import Simulator
from mjx_study.optimise import Backend, optimise
from mjx_study.results import prepare_folder
from mjx_study.runtime import environment
from mjx_study.store import Store, StudyError, assemble, git_revision, write_dataset
from mjx_study.study import UNCONVERGED, estimate_numbers, reference_of, residuals_of
from mjx_study.sweep_plan import (
    LARGEST_BATCH,
    SweepCell,
    SweepConfig,
    SweepPlan,
    descent_plan,
    estimator_options,
    plan_sweep,
)

WAIT_SECONDS: Final = 0.5
"""Between looks at cells that another process computes."""

GRADIENT_VARIABLES: Final[dict[str, tuple[tuple[str, ...], str, str]]] = {
    "variance": (("seed", "estimator"), "gradient^2", "variance of one sample, the trace of the covariance"),
    "norm_90": (("seed", "estimator"), "gradient", "90 % quantile of the samples' norms"),
    "norm_max": (("seed", "estimator"), "gradient", "largest norm of a sample"),
    "gradient_norm": (("seed", "estimator"), "gradient", "norm of the mean"),
    "relative_error": (("seed", "estimator"), "1", "distance of the mean to the reference, over its norm"),
    "relative_error_se": (("seed", "estimator"), "1", "standard error of that"),
    "cosine": (("seed", "estimator"), "1", "of the angle between mean and reference"),
    "alpha": (("seed", "estimator"), "1", "weight of the first-order batch"),
    "epsilon": (("seed", "estimator"), "gradient", "confidence radius of the zeroth-order mean"),
    "discrepancy": (("seed", "estimator"), "gradient", "distance between the two means"),
    "bias_p_value": (("seed", "estimator"), "1", "of no bias against the reference"),
    "nonfinite": (("seed", "estimator"), "1", "samples that were left out"),
    "pooled_error": (("estimator",), "1", "distance of the mean over all seeds to the reference, over its norm"),
    "squared_bias": (("estimator",), "1", "unbiased estimate of the squared bias, over the reference's squared norm"),
    "squared_bias_se": (("estimator",), "1", "standard error of that"),
    "reference_norm": ((), "gradient", "norm of the reference gradient"),
    "reference_uncertainty": ((), "1", "standard error of the reference, over its norm"),
    "residual": ((), "1", "largest relative residual of the solver"),
    "unconverged": ((), "1", "rollouts whose solver residual is too large"),
    "seconds_per_sample": (("estimator",), "s", "computing time of one sample, measured; compilation excluded"),
}
DESCENT_VARIABLES: Final[dict[str, tuple[tuple[str, ...], str, str]]] = {
    "final_cost": (("seed", "estimator"), "cost", "mean cost of the final policy"),
    "final_cost_se": (("seed", "estimator"), "cost", "standard error of that"),
    "start_cost": ((), "cost", "mean cost of the start's policy"),
    "stopped_at": (("seed", "estimator"), "1", "iteration at which a seed stopped before the end; NaN for none"),
    "cost": (("iteration", "seed", "estimator"), "cost", "mean cost of the batch, before the update"),
    "alpha": (("iteration", "seed", "estimator"), "1", "weight of the first-order batch"),
    "rollouts": (("estimator",), "1", "simulated in one iteration of one seed"),
    "seconds": (("iteration", "estimator"), "s", "since the start, measured; compilation excluded"),
}
MEASURED: Final = ("seconds", "seconds_per_sample")
"""Variables that are times, and so the only ones that differ from run to run."""
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


def open_store(plan: SweepPlan, folder: Path) -> Store:
    """The folder of a plan, new or begun; one that was begun keeps its chunk size unless the plan gives another.

    Raises:
        ValueError: it cannot be written to, or holds another study.
    """
    config = dataclasses.asdict(plan.config)
    config["kind"] = "gradients" if plan.config.iterations is None else "descents"
    if plan.config.chunk_size is None:
        begun = (folder / "study.json").exists()
        config["chunk_size"] = Store.open(folder).document["config"]["chunk_size"] if begun else plan.chunk_size
    document = {
        "config": config,
        "warnings": list(plan.warnings),
        "environment": environment(),
        "revision": git_revision(),
        "command": shlex.join(["mjx-study", *sys.argv[1:]]),
        "models": _models(plan),
        "axes": {name: list(values) for name, values in _axes(plan).items()},
        "cells": [{"label": plan.label(cell), "at": _place(plan, cell)} for cell in plan.cells],
    }
    return Store.create(prepare_folder(folder), document)


def run_sweep(plan: SweepPlan, folder: Path, progress: Progress = lambda done, total, what: None) -> SweepResult:
    """Compute what is missing of a study, beside any other process that does the same.

    Raises:
        ValueError: the folder holds another study, or cannot be written to.
        StudyError: a file of the study is damaged.
        OSError: a cell could not be written; what was written before is kept.
    """
    store = open_store(plan, folder)
    chunk = store.document["config"]["chunk_size"]
    plan = dataclasses.replace(plan, config=dataclasses.replace(plan.config, chunk_size=chunk))
    for index in range(len(plan.cells)):
        if store.has(index):
            store.read(index)  # a damaged file is refused before anything is computed
    compute = _compute_descent(plan) if plan.config.iterations is not None else _compute_gradients(plan)
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


def _compute_gradients(plan: SweepPlan) -> Callable[[SweepCell], dict[str, np.ndarray]]:
    """A function that computes a cell; it keeps what is compiled."""
    config = plan.config
    needed = {"evaluation", *(oracle for name in config.estimators for oracle in ESTIMATORS[name].needs)}
    oracles = tuple(name for name in ORACLES if name in needed)
    compiled: dict[int, Simulator] = {}
    warm: set[tuple[int, bool]] = set()

    def compute(cell: SweepCell) -> dict[str, np.ndarray]:
        if cell.group not in compiled:
            compiled[cell.group] = Simulator(plan.groups[cell.group].task, chunk_size=config.chunk_size)  # type: ignore[arg-type]
        objective = dataclasses.replace(compiled[cell.group].objective(cell.model.contact), sigma=cell.sigma)
        theta = plan.groups[cell.group].task.theta
        if (cell.group, cell.model.contact is None) not in warm:  # so that no cell's time holds a compilation
            for name in oracles:
                getattr(objective, ORACLES[name].method)(theta, jax.random.split(jax.random.key(0), 1))
            warm.add((cell.group, cell.model.contact is None))
        keys = _cell_keys(config.seed, config.seeds)
        drawn, seconds, residuals = _draw(objective, theta, keys, oracles, cell.samples, config.seeds)
        pilot = jax.tree.map(lambda leaf: leaf[0], drawn["evaluation"])
        odd, candidate = (
            jax.random.split(stream, size)
            for stream, size in zip(keys["reference"], (config.reference_samples, 100), strict=True)
        )
        reference = reference_of(objective, odd, candidate, pilot, [])
        tests = jax.random.split(keys["test"], config.seeds)
        numbers = jax.device_get(
            _seed_numbers(drawn, reference, tests, config.estimators, estimator_options(plan, cell))
        )
        arrays = {
            name: np.stack([np.full(config.seeds, np.nan) if row[name] is None else row[name] for row in numbers], 1)
            for name in ("variance", "norm_90", "norm_max", "gradient_norm", "relative_error", "relative_error_se",
                         "cosine", "alpha", "epsilon", "discrepancy", "bias_p_value", "nonfinite")
        }  # fmt: skip
        arrays |= {name: np.asarray(numbers[0][name][0]) for name in ("reference_norm", "reference_uncertainty")}
        means = [jnp.asarray(row["gradient"]) for row in numbers]
        squared = [estimators.squared_bias_of_means(each, reference) for each in means]
        square = float(jnp.sum(reference.mean**2))
        arrays["squared_bias"], arrays["squared_bias_se"] = (
            np.array(each, float) / square for each in zip(*squared, strict=True)
        )
        gaps = [jnp.linalg.norm(jnp.mean(each, axis=0) - reference.mean) for each in means]
        arrays["pooled_error"] = np.array(gaps, float) / square**0.5
        arrays["residual"] = np.asarray(np.max(np.where(np.isfinite(residuals), residuals, np.inf)))
        arrays["unconverged"] = np.asarray(np.sum(~(residuals <= UNCONVERGED[str(residuals.dtype)])))
        per_sample = [sum(seconds[oracle] for oracle in ESTIMATORS[name].needs) for name in config.estimators]
        arrays["seconds_per_sample"] = np.array(per_sample) / (cell.samples * config.seeds)
        return {name: np.asarray(array, float) for name, array in arrays.items()}

    return compute


def _cell_keys(seed: int, seeds: int) -> dict[str, Any]:
    """Independent keys, the same in every cell: of each seed's batches, of the reference and of the tests."""
    zeroth, first, odd, candidate, test = jax.random.split(jax.random.key(seed), 5)
    by_order = [jax.random.split(stream, seeds) for stream in (zeroth, first)]
    return {"order": by_order, "reference": (odd, candidate), "test": test}


def _draw(objective: Any, theta: Array, keys: dict[str, Any], oracles: Sequence[str], samples: int, seeds: int):
    """Batches of every oracle with an axis of seeds, the seconds that each took, and every rollout's residual."""
    together = max(1, LARGEST_BATCH // samples)
    drawn, seconds, residuals = {}, {}, []
    for name in oracles:
        streams: Key[Array, " seeds"] = keys["order"][ORACLES[name].order]
        parts, seconds[name] = [], 0.0
        for start in range(0, seeds, together):
            some = jax.random.clone(streams[start : start + together])
            flat = jax.vmap(lambda key: jax.random.split(key, samples))(some).reshape(-1)
            begun = time.perf_counter()
            batch = jax.block_until_ready(getattr(objective, ORACLES[name].method)(theta, flat))
            seconds[name] += time.perf_counter() - begun
            residuals.append(residuals_of(batch))
            parts.append(jax.tree.map(lambda leaf: leaf.reshape(-1, samples, *leaf.shape[1:]), batch))
        drawn[name] = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return drawn, seconds, np.concatenate(residuals)


@partial(jax.jit, static_argnames=("names", "options"))
def _seed_numbers(drawn: dict[str, Any], reference: Any, keys: Key[Array, " seeds"], names: Any, options: Any):
    """The numbers of every estimator, with an axis of seeds."""
    return jax.vmap(lambda batches, key: estimate_numbers(batches, reference, key, names, options, 0.95))(drawn, keys)


def _compute_descent(plan: SweepPlan) -> Callable[[SweepCell], dict[str, np.ndarray]]:
    """A function that computes a cell; it keeps what is compiled."""
    backends: dict[tuple[int, float, int], Backend] = {}

    def compute(cell: SweepCell) -> dict[str, np.ndarray]:
        ready = descent_plan(plan, cell)
        key = (cell.group, cell.sigma, cell.samples)
        if key not in backends:
            backends[key] = Backend(ready)
        found = optimise(ready, backend=backends[key])
        iterations, seeds = ready.config.iterations or 0, ready.config.seeds
        arrays = {
            "final_cost": np.stack([run.final_cost for run in found.runs], 1),
            "final_cost_se": np.stack([run.final_cost_se for run in found.runs], 1),
            "start_cost": np.array(found.start_cost[0]),
            "stopped_at": np.full((seeds, len(found.runs)), np.nan),
            "rollouts": np.array([run.rollouts for run in found.runs]),
        }
        for column, run in enumerate(found.runs):
            for seed, (iteration, _) in run.stopped.items():
                arrays["stopped_at"][seed, column] = iteration
        for name in ("cost", "alpha"):
            arrays[name] = np.stack([_padded(run.history[name], iterations) for run in found.runs], -1)
        arrays["seconds"] = np.stack([_padded(run.seconds, iterations) for run in found.runs], -1)
        return {name: np.asarray(array, float) for name, array in arrays.items()}

    return compute


def _padded(values: np.ndarray, length: int) -> np.ndarray:
    """With NaN after its end, along the first axis."""
    missing = [(0, length - len(values))] + [(0, 0)] * (values.ndim - 1)
    return np.pad(np.asarray(values, float), missing, constant_values=np.nan)


def _models(plan: SweepPlan) -> list[dict[str, Any]]:
    """The contact models of all groups, each once."""
    found: dict[tuple[str, float], dict[str, Any]] = {}
    for group in plan.groups:
        for model in group.models:
            contact = model.contact
            found.setdefault(
                (model.family, model.stiffness),
                {
                    "contact": model.family,
                    "stiffness": model.stiffness,
                    "solref": None if contact is None else np.asarray(contact.solref).tolist(),
                    "solimp": None if contact is None else np.asarray(contact.solimp).tolist(),
                },
            )
    return list(found.values())


def _axes(plan: SweepPlan) -> dict[str, list[Any]]:
    """Values along each dimension of cells, in the order of the configuration."""
    groups = plan.groups
    return {
        "task": list(dict.fromkeys(group.task.name for group in groups)),
        "timestep": sorted({group.timestep for group in groups}),
        "cone": list(dict.fromkeys(group.cone for group in groups)),
        "model": [_model_name(model["contact"], model["stiffness"]) for model in _models(plan)],
        "sigma": sorted({cell.sigma for cell in plan.cells}),
        "samples": sorted({cell.samples for cell in plan.cells}),
    }


def _place(plan: SweepPlan, cell: SweepCell) -> dict[str, int]:
    group, axes = plan.groups[cell.group], _axes(plan)
    values = {
        "task": group.task.name,
        "timestep": group.timestep,
        "cone": group.cone,
        "model": _model_name(cell.model.family, cell.model.stiffness),
        "sigma": cell.sigma,
        "samples": cell.samples,
    }
    return {name: axes[name].index(value) for name, value in values.items()}


def _model_name(family: str, stiffness: float) -> str:
    return f"{family} {stiffness:g}" if stiffness else family


def load_study(folder: str | Path) -> xr.Dataset:
    """The numbers of a study as labelled arrays, those of an unfinished one too; NaN for what is missing.

    Dimensions: task, timestep, cone, model (a contact model, with its family as coordinate `contact` and its
    `stiffness`), sigma, samples, then seed, estimator and iteration.

    Raises:
        StudyError: there is no study, or a file of it is damaged.
    """
    store = Store.open(Path(folder))
    document = store.document
    config, axes, models = document["config"], document["axes"], document["models"]
    descents = config["kind"] == "descents"
    dimensions = dict(axes) | {"estimator": config["estimators"], "seed": list(range(config["seeds"]))}
    if descents:
        dimensions["iteration"] = list(range(1, config["iterations"] + 1))
    along = {
        "contact": ("model", [model["contact"] for model in models], ""),
        "stiffness": ("model", [model["stiffness"] for model in models], "N/m"),
    }
    return assemble(store, dimensions, DESCENT_VARIABLES if descents else GRADIENT_VARIABLES, along, UNITS)


def what_to_beware_of(dataset: xr.Dataset) -> tuple[str, ...]:
    """Warnings about the numbers of a study."""
    found = []
    if dataset.attrs["missing_cells"]:
        found.append(f"{dataset.attrs['missing_cells']} cells are not computed yet; the same command goes on")
    for name, says in (
        ("nonfinite", "samples overflowed or became NaN and were left out"),
        ("unconverged", "rollouts in which the contact solver did not converge"),
    ):
        if name in dataset and float(dataset[name].sum()) > 0:
            found.append(f"{int(dataset[name].sum())} {says}")
    if "stopped_at" in dataset and bool(dataset["stopped_at"].notnull().any()):
        found.append(f"{int(dataset['stopped_at'].notnull().sum())} descents stopped before their last iteration")
    return tuple(found)


__all__ = ["StudyError", "SweepConfig", "SweepPlan", "SweepResult", "load_study", "plan_sweep", "run_sweep"]
