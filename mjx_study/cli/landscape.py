"""mjx-study landscape."""

import argparse
import json
from typing import Any

import numpy as np
import xarray as xr

from mjx_study.cli.console import number
from mjx_study.cli.options import configure_process, finish, print_report, usage_errors
from mjx_study.cli.parameters import theta_of
from mjx_study.cli.studies import announce, compute, draw, study_fields
from mjx_study.study.configuration import StudyConfig, takes_stiffness
from mjx_study.study.dataset import as_plain
from mjx_study.study.findings import curves_of, findings
from mjx_study.study.plan import plan_study
from mjx_study.study.run import warnings_of
from mjx_study.table import format_table
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import REFERENCE


def run(options: argparse.Namespace) -> int:
    """Draw, print, and write where an output folder is given."""
    with usage_errors():
        configure_process(options)
        plan = plan_study(_configuration(options))
    if options.dry_run:
        return announce(plan, options)
    dataset, unwritten = compute(plan, options)
    written, undrawn = draw(dataset, options.output, unwritten)
    lines = _lines(dataset)
    if options.output is None:
        lines.append("add --output DIR for a figure and the numbers")
    elif written:
        lines.append(f"written to {options.output}: {', '.join(path.name for path in written)}")
    print_report(options, as_document(dataset), lines)
    return finish(unwritten, undrawn)


def _configuration(options: argparse.Namespace) -> StudyConfig:
    """The task's contact models at the middle stiffness of its sweep, and its analytic reference beside them."""
    fields = study_fields(options)
    task = make_task(options.task)
    fields.setdefault("contact", task.defaults.families)
    if not options.no_reference and task.reference is not None and fields.get("onset", "none") == "none":
        fields["contact"] = tuple(dict.fromkeys((REFERENCE, *fields["contact"]))) if fields["contact"] else ()
    if takes_stiffness(fields["contact"]):
        fields.setdefault("stiffness", (task.defaults.middle_stiffness,))
    return StudyConfig(**fields, tasks=(options.task,), kind="landscapes", theta=theta_of(options), seeds=1)


def as_document(dataset: xr.Dataset) -> dict[str, Any]:
    """A study of landscapes as plain data: a curve for each contact model."""
    curves = [
        {"label": label, "contact": one["contact"].item(), "stiffness": one["stiffness"].item() or None}
        | {str(name): one[name].values for name in one if "entry" not in str(one[name].dims)}
        for label, one in curves_of(dataset)
    ]
    found = {name: json.loads(dataset.attrs[name]) for name in ("config", "resolved", "environment")}
    told = {"findings": findings(dataset), "warnings": list(warnings_of(dataset))}
    return as_plain(found | told | {"estimators": dataset["estimator"].values, "curves": curves})


def _lines(dataset: xr.Dataset) -> list[str]:
    config, environment = (json.loads(dataset.attrs[name]) for name in ("config", "environment"))
    curves = curves_of(dataset)
    low, high = curves[0][1]["position"].values[[0, -1]]
    where = f"t, along direction {config['direction'] or 'random'}," if dataset.attrs["many_parameters"] else "theta"
    samples, sigmas = ([f"{value:g}" for value in dataset[name].values] for name in ("samples", "sigma"))
    lines = [
        f"{', '.join(config['tasks'])}: {where} from {low:.3g} to {high:.3g} in {config['points']} points, "
        f"sigma {', '.join(sigmas)},",
        f"{', '.join(samples)} samples at each, seed {config['seed']}, {environment['precision']}",
        "",
        "where the mean cost is least on the line:",
    ]
    rows = []
    for label, one in curves:
        smoothed, error = one["smoothed"].values, one["smoothed_se"].values
        best = int(np.nanargmin(smoothed)) if np.any(np.isfinite(smoothed)) else 0
        least = f"{number(smoothed[best], 4)} ± {number(error[best], 1)}"
        rows.append([label, f"{one['position'].values[best]:.3g}", least])
    lines += [*format_table(rows, ["contact", "at", "mean cost"]), "", *findings(dataset)]
    return lines + [f"warning: {message}" for message in warnings_of(dataset)]
