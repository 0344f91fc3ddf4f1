"""mjx-study landscape."""

import argparse
import json
from typing import Any

import numpy as np
import xarray as xr

from mjx_study.cli.console import number
from mjx_study.cli.options import (
    Commands,
    add_command,
    add_contact_options,
    add_option,
    add_options,
    add_process_options,
    add_task_argument,
    configure_process,
    finish,
    print_report,
    usage_errors,
)
from mjx_study.cli.parameters import add_theta_option, theta_of
from mjx_study.cli.studies import add_folder_options, compute, draw, study_fields
from mjx_study.option import OPTIONS
from mjx_study.study.configuration import StudyConfig, takes_stiffness
from mjx_study.study.dataset import as_plain
from mjx_study.study.findings import curves_of, findings
from mjx_study.study.plan import plan_study
from mjx_study.study.run import warnings_of
from mjx_study.table import format_table
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import REFERENCE

EPILOG = """\
examples:
  mjx-study landscape ball_wall --output out             the launch angle's whole range, reference and MJX
  mjx-study landscape momentum_transfer --contact penalty,mujoco_default --stiffness 3000,100000
  mjx-study landscape pusher --direction 0 --span=-2,2   the first of 200 forces

Top row of the figure: the cost without noise, and the mean cost with noise (its smoothed objective) with a 95 % band.
Bottom row: the mean of ZoBG and of FoBG along the line, with theirs. Where the smoothed objective has a slope that the
mean of FoBG does not have, the cost jumps: a first-order gradient does not see jumps.

The scalar parameter of an initial-state policy with a fixed start also gets both slopes without sampling error, by
quadrature over 1500 rollouts and gradients of each contact model (more where --noise has heavy tails), whatever
--points and --samples.
"""
POINTS, SAMPLES = 41, (100,)
ESTIMATORS = ("zobg", "fobg")


def add(commands: Commands) -> None:
    """Register the command."""
    summary = "draw the cost along a line of parameters, its smoothed cost and the slope that each estimator sees"
    command = add_command(commands, "landscape", summary, run, EPILOG)
    add_task_argument(command)
    add_options(command, StudyConfig, "sigma", "cone", "horizon", "model", "noise")
    add_process_options(command)
    add_contact_options(command, "the middle one of the task's sweep")
    add_theta_option(command, "parameters that the line goes through")
    add_option(command, StudyConfig.option("estimators"), ESTIMATORS)
    add_option(command, StudyConfig.option("samples"), SAMPLES)
    add_option(command, OPTIONS["points"], POINTS)
    add_options(command, StudyConfig, "span", "direction", "onset", "chunk_size")
    command.add_argument("--no-reference", action="store_true", help="leave out the analytic reference")
    add_folder_options(command)


def run(options: argparse.Namespace) -> int:
    """Draw, print, and write where an output folder is given."""
    with usage_errors():
        configure_process(options)
        plan = plan_study(_configuration(options))
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
