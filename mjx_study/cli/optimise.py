"""mjx-study optimise."""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mjx_study.cli.console import number
from mjx_study.cli.options import scene_options
from mjx_study.cli.studies import run_one, study_fields
from mjx_study.disk import write_whole
from mjx_study.plots.style import style_of
from mjx_study.study.configuration import StudyConfig, takes_stiffness
from mjx_study.study.iteration import REASONS
from mjx_study.study.plan import StudyPlan, plan_study
from mjx_study.study.variables import HISTORY, METRIC, START
from mjx_study.table import format_table
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import REFERENCE

WRAPPED = ("contact", "stiffness", "sigma", "cone", "samples", "backward")
"""Options with a single value here and a list in a study."""


def run(options: argparse.Namespace) -> int:
    offer = "a figure, the policies, and a run that can be resumed"
    return run_one(options, _plan, descents, _lines, offer, _save_policies)


def _plan(options: argparse.Namespace) -> StudyPlan:
    """Plan a single contact model, the given one or the task's own."""
    fields, task = study_fields(options), make_task(options.task, **scene_options(options, "horizon", "model"))
    if options.reference:
        if options.contact not in (None, REFERENCE):
            raise ValueError(f"--reference replaces --contact {options.contact}; omit one of them")
        fields["contact"] = REFERENCE
    fields.setdefault("contact", task.defaults.main_family)
    if takes_stiffness((fields["contact"],)):
        fields.setdefault("stiffness", task.defaults.middle_stiffness)
    fields |= {name: (fields[name],) for name in WRAPPED if name in fields}
    return plan_study(StudyConfig(**fields, kind="descents"), {options.task: task})


def descents(dataset: xr.Dataset) -> dict[str, Any]:
    """Descents of every estimator, with histories by iteration and seed."""
    config, resolved = json.loads(dataset.attrs["config"]), json.loads(dataset.attrs["resolved"])[0]
    one = dataset.isel({name: 0 for name in ("task", "timestep", "cone", "model", "sigma", "samples")})
    place = {name: one[name].item() for name in ("contact", "stiffness", "cone", "sigma", "samples")}
    place["stiffness"] = place["stiffness"] or None
    return {
        "config": config | resolved["recipe"] | place | {"task": config["tasks"][0], "noise": resolved["noise"]},
        "start_cost": [one["start_cost"].item(), one["start_cost_se"].item()],
        "start_metrics": {str(name)[len(START) :]: one[name].item() for name in one if str(name).startswith(START)},
        "runs": [_run(one.sel(estimator=name)) for name in config["estimators"]],
    }


def _run(one: xr.Dataset) -> dict[str, Any]:
    final, stopped_at = one["final_cost"].values, one["stopped_at"].values
    known = np.flatnonzero(np.isfinite(one["seconds"].values))
    length = int(known[-1]) + 1 if len(known) else 0
    stopped = [
        {"seed": seed, "iteration": int(stopped_at[seed]), "reason": REASONS[int(one["reason"].values[seed])]}
        for seed in np.flatnonzero(np.isfinite(stopped_at)).tolist()
    ]
    return {
        "estimator": one["estimator"].item(),
        "final_cost": final,
        "final_cost_se": one["final_cost_se"].values,
        "metrics": {str(name)[len(METRIC) :]: one[name].values for name in one if str(name).startswith(METRIC)},
        "best_seed": int(np.nanargmin(final)) if np.any(np.isfinite(final)) else 0,
        "stopped": stopped,
        "rollouts_per_iteration": int(one["rollouts"]),
        "seconds": one["seconds"].values[:length],
        "history": {name: one[name].transpose("iteration", "seed").values[:length] for name in HISTORY},
        "theta": one["theta"].transpose("seed", "param").values,
    }


def _save_policies(document: dict[str, Any], folder: Path) -> list[Path]:
    config, written = document["config"], []
    kept = {name: config[name] for name in ("task", "stiffness", "damping", "cone", "model", "network")}
    kept |= {"contact": None if config["contact"] == REFERENCE else config["contact"], "horizon": config["horizon"]}
    for run in document["runs"]:
        best = run["best_seed"]
        policy = kept | {"estimator": run["estimator"], "seed": best, "cost": run["final_cost"][best]}
        content = (json.dumps(policy | {"theta": run["theta"][best]}) + "\n").encode()
        name = f"policy-{run['estimator'].replace(':', '.')}.json"
        written.append(write_whole(folder / name, lambda file, data=content: file.write(data)))
    return written


def _lines(dataset: xr.Dataset, document: dict[str, Any]) -> list[str]:
    config = document["config"]
    where = "analytic reference" if config["contact"] == REFERENCE else config["contact"]
    if config["contact"] != REFERENCE and config["stiffness"]:
        where = f"{where}, K = {config['stiffness']:g} N/m"
    metrics = "".join(f", {name} {number(value, 3)}" for name, value in document["start_metrics"].items())
    decay = f" / i^{config['decay']:g}" if config["decay"] else ""
    mean, error = document["start_cost"]
    lines = [
        f"{config['task']}: {where}; {config['optimizer']}, learning rate {config['learning_rate']:g}{decay}, "
        f"{config['iterations']} iterations",
        f"{config['samples']} samples in each batch, {config['seeds']} seeds from {config['seed']}, "
        f"sigma {config['sigma']:g}; cost at the start {number(mean, 4)} ± {number(error, 2)}{metrics}",
        "",
        *format_table(
            [_row(run) for run in document["runs"]],
            ["estimator", "cost", "best", *document["start_metrics"], "alpha", "rollouts", "seconds"],
        ),
    ]
    for run in document["runs"]:
        for stop in run["stopped"]:
            label, _, _ = style_of(run["estimator"])
            lines.append(f"{label}, seed {stop['seed']}: stopped at iteration {stop['iteration']}, {stop['reason']}")
    return lines


def _row(run: dict[str, Any]) -> list[str]:
    costs = _finite(run["final_cost"])
    length = len(run["seconds"])
    weights = _finite([weight for row in run["history"]["alpha"][-max(1, length // 10) :] for weight in row])
    return [
        style_of(run["estimator"])[0],
        _mean_and_spread(costs, 4),
        number(float(np.min(costs)), 4) if len(costs) else "nan",
        *(_mean_and_spread(_finite(values), 3) for values in run["metrics"].values()),
        f"{np.mean(weights):.3f}" if len(weights) else "-",
        str(run["rollouts_per_iteration"] * length),
        f"{run['seconds'][-1]:.1f}" if length else "-",
    ]


def _finite(values: list[float | None]) -> np.ndarray:
    return np.array([value for value in values if value is not None and math.isfinite(value)])


def _mean_and_spread(values: np.ndarray, digits: int) -> str:
    if len(values) == 0:
        return "nan"
    spread = f" ± {number(float(np.std(values, ddof=1)), 2)}" if len(values) > 1 else ""
    return number(float(np.mean(values)), digits) + spread
