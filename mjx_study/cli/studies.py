"""Shared by the commands that run studies: configuration from options, the folder, numbers and figures."""

import argparse
import dataclasses
import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import xarray as xr

from mjx_study.cli.options import UsageError, attempt, computing, configure_process, finish, print_report, usage_errors
from mjx_study.cli.parameters import theta_of
from mjx_study.plots.study import plot_study
from mjx_study.plots.style import save_figures
from mjx_study.study.cluster import connected
from mjx_study.study.configuration import StudyConfig
from mjx_study.study.dataset import as_plain
from mjx_study.study.forecast import forecast
from mjx_study.study.plan import StudyPlan
from mjx_study.study.run import open_store, run_study, warnings_of
from mjx_study.study.store import StudyError

RESUMABLE = "the same command resumes where it stopped"
KEPT = "results.nc (every number), study.json (the configuration), cells/ (checkpoints)"


def study_fields(options: argparse.Namespace) -> dict[str, Any]:
    """Fields of a `StudyConfig` set by the options."""
    given = {field.name: getattr(options, field.name, None) for field in dataclasses.fields(StudyConfig)}
    given |= {"theta": theta_of(options)} if hasattr(options, "theta") else {}
    given |= {"tasks": (options.task,)} if hasattr(options, "task") else {}
    return {name: value for name, value in given.items() if value is not None}


def as_document(dataset: xr.Dataset, own: Callable[[xr.Dataset], dict[str, Any]]) -> dict[str, Any]:
    """A study as plain data: configuration, warnings, and the command's own summary."""
    document = {name: json.loads(dataset.attrs[name]) for name in ("config", "resolved", "environment")}
    return as_plain(document | {"warnings": warnings_of(dataset)} | own(dataset))


def run_one(
    options: argparse.Namespace,
    planned: Callable[[argparse.Namespace], StudyPlan],
    own: Callable[[xr.Dataset], dict[str, Any]],
    lines_of: Callable[[xr.Dataset, dict[str, Any]], list[str]],
    offer: str,
    also: Callable[[dict[str, Any], Path], list[Path]] = lambda document, folder: [],
) -> int:
    """Run a command about one study: plan, compute, draw if an output folder is given, print.

    Args:
        planned: returns the plan requested by the options.
        own: see `as_document`.
        lines_of: formats the study and its document as text.
        offer: what `--output` would add.
        also: writes further files of the document into the folder, and returns their paths.
    """
    with usage_errors():
        configure_process(options)
        plan = planned(options)
    if options.dry_run:
        return announce(plan, options)
    dataset, unwritten = _compute(plan, options)
    document, folder, failures = as_document(dataset, own), options.output, [unwritten]
    written: list[Path] = []
    if folder is not None and not unwritten:
        for write in (lambda: also(document, folder), lambda: save_figures(plot_study(dataset), folder)):
            paths, failure = attempt(write)
            written, failures = written + paths, [*failures, failure]
    lines = [*lines_of(dataset, document), *(f"warning: {message}" for message in document["warnings"])]
    lines += [f"add --output DIR for {offer}"] if folder is None else []
    if folder is not None and not dataset.attrs["computed_cells"] and not dataset.attrs["missing_cells"]:
        lines.append(f"nothing was computed: {folder} already holds all {len(plan.cells)} cells")
    if folder is not None and not unwritten:
        lines.append(f"written to {folder}: {', '.join([*(path.name for path in written), KEPT])}")
    print_report(options, document, lines)
    return finish(*failures)


def _compute(plan: StudyPlan, options: argparse.Namespace) -> tuple[xr.Dataset, str | None]:
    """Run a study, in its folder if one is given; what a full disk rejects is kept in memory.

    Returns:
        The numbers, and why they could not be written, if so.

    Raises:
        UsageError: the folder holds another study or a damaged one, or cannot be used.
    """
    if options.output is None:
        if getattr(options, "cluster", None) is not None:
            raise UsageError("--cluster needs a folder for the study: give --output")
        with computing() as progress:
            return run_study(plan, progress=progress), None
    try:
        with usage_errors():
            store = open_store(plan, options.output, options.command_line, accept_versions=options.accept_versions)
        with ExitStack() as stack:
            if (cluster := getattr(options, "cluster", None)) is not None:
                with usage_errors():
                    cluster = stack.enter_context(connected(cluster))
            progress = stack.enter_context(computing(RESUMABLE))
            dataset = run_study(plan, store, progress, keep_going=True, cluster=cluster)
    except StudyError as error:
        raise UsageError(str(error)) from error
    reason = dataset.attrs.pop("unwritten", None)
    return dataset, reason and f"{reason}; existing files are complete, and the same command resumes"


def announce(plan: StudyPlan, options: argparse.Namespace) -> int:
    """Print the forecast cost of a study."""
    with usage_errors():
        found = forecast(
            plan, options.output, accept_versions=options.accept_versions, cluster=getattr(options, "cluster", None)
        )
    warnings = [f"warning: {message}" for message in plan.warnings]
    print_report(options, dataclasses.asdict(found) | {"warnings": list(plan.warnings)}, [*found.lines, *warnings])
    return 0
