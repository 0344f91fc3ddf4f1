"""mjx-study landscape."""

import argparse
from typing import Any

import numpy as np
import xarray as xr

from mjx_study.cli.console import number
from mjx_study.cli.options import scene_options
from mjx_study.cli.studies import run_one, study_fields
from mjx_study.study.configuration import StudyConfig, takes_stiffness
from mjx_study.study.findings import curves_of, findings
from mjx_study.study.plan import StudyPlan, plan_study
from mjx_study.table import format_table
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import REFERENCE


def run(options: argparse.Namespace) -> int:
    return run_one(options, _plan, curves, _lines, "a figure and the numbers")


def _plan(options: argparse.Namespace) -> StudyPlan:
    """Plan the task's contact models at the middle stiffness of its sweep, and its analytic reference if it has one."""
    fields, task = study_fields(options), make_task(options.task, **scene_options(options, "horizon", "model"))
    fields.setdefault("contact", task.defaults.families)
    if not options.no_reference and task.reference is not None and fields.get("onset", "none") == "none":
        fields["contact"] = tuple(dict.fromkeys((REFERENCE, *fields["contact"]))) if fields["contact"] else ()
    if takes_stiffness(fields["contact"]):
        fields.setdefault("stiffness", (task.defaults.middle_stiffness,))
    return plan_study(StudyConfig(**fields, kind="landscapes", seeds=1), {options.task: task})


def curves(dataset: xr.Dataset) -> dict[str, Any]:
    """Findings, and a curve per contact model."""
    found = [
        {"label": label, "contact": one["contact"].item(), "stiffness": one["stiffness"].item() or None}
        | {str(name): one[name].values for name in one if "entry" not in str(one[name].dims)}
        for label, one in curves_of(dataset)
    ]
    return {"findings": findings(dataset), "estimators": dataset["estimator"].values, "curves": found}


def _lines(dataset: xr.Dataset, document: dict[str, Any]) -> list[str]:
    config, found = document["config"], curves_of(dataset)
    low, high = found[0][1]["position"].values[[0, -1]]
    where = f"t, along direction {config['direction'] or 'random'}," if dataset.attrs["many_parameters"] else "theta"
    samples, sigmas = ([f"{value:g}" for value in dataset[name].values] for name in ("samples", "sigma"))
    lines = [
        f"{', '.join(config['tasks'])}: {where} from {low:.3g} to {high:.3g} in {config['points']} points, "
        f"sigma {', '.join(sigmas)},",
        f"{', '.join(samples)} samples at each, seed {config['seed']}, {document['environment']['precision']}",
        "",
        "where the mean cost is least on the line:",
    ]
    rows = []
    for label, one in found:
        smoothed, error = one["smoothed"].values, one["smoothed_se"].values
        best = int(np.nanargmin(smoothed)) if np.any(np.isfinite(smoothed)) else 0
        least = f"{number(smoothed[best], 4)} ± {number(error[best], 1)}"
        rows.append([label, f"{one['position'].values[best]:.3g}", least])
    return [*lines, *format_table(rows, ["contact", "at", "mean cost"]), "", *document["findings"]]
