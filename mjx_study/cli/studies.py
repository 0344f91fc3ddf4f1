"""Shared by the commands that run studies: configuration from options, the folder, numbers and figures."""

import argparse
import dataclasses
import json
import textwrap
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import xarray as xr

from mjx_study.cli.options import configure_process, usage_errors
from mjx_study.cli.output import INTERRUPTED, RESUMABLE, attempt, computing, print_report
from mjx_study.diagnose.means import MeanCheck, check_terms, term_lines
from mjx_study.execution.cluster import connected
from mjx_study.execution.forecast import forecast_study
from mjx_study.execution.lost import all_lost
from mjx_study.execution.run import run_study
from mjx_study.experiment.study import StudyError, StudyPlan
from mjx_study.options.parser import UsageError
from mjx_study.plots.study import plot_study
from mjx_study.plots.style import save_figures
from mjx_study.results.kind import findings_of
from mjx_study.results.rows import meanings_of, numbers_of
from mjx_study.results.warnings import warnings_of
from mjx_study.storage.folder import Store, load_study, open_store
from mjx_study.table import as_plain, digits_to_tell_apart, format_table, size

KEPT = "results.nc (every number), study.json (the configuration), cells/ (checkpoints)"
MOST_ROWS = 40  # maximum number of rows of the table at the end of a sweep; the report has all
INTACT = "existing files are complete, and the same command resumes"


def as_document(dataset: xr.Dataset, own: Callable[[xr.Dataset], dict[str, Any]]) -> dict[str, Any]:
    """A study as plain data: configuration, warnings, and the command's own summary."""
    document = {name: json.loads(dataset.attrs[name]) for name in ("config", "resolved", "environment")}
    return as_plain(document | {"warnings": warnings_of(dataset)} | own(dataset))


def run_one(
    options: argparse.Namespace,
    planned: Callable[[], StudyPlan],
    own: Callable[[xr.Dataset], dict[str, Any]],
    lines_of: Callable[[xr.Dataset, dict[str, Any]], list[str]],
    offer: str,
    also: Callable[[dict[str, Any], Path], list[Path]] = lambda document, folder: [],
    thetas: Callable[[dict[str, Any]], Mapping[str, Any]] | None = None,
) -> int:
    """Run a command about one study: plan, compute, draw if an output folder is given, print.

    Args:
        planned: returns the plan requested by the options.
        own: see `as_document`.
        lines_of: formats the study and its document as text.
        offer: what `--output` would add.
        also: writes further files of the document into the folder, and returns their paths.
        thetas: parameters at which to check means with an onset term, see `check_terms`; None not to check.
    """
    with usage_errors():
        configure_process(options)
        plan = planned()
    if options.dry_run:
        return _announce(plan, options)
    dataset, unwritten = _compute(plan, options)
    document, folder, failures = as_document(dataset, own), options.output, [unwritten]
    written: list[Path] = []
    if folder is not None and not unwritten:
        for write in (lambda: also(document, folder), lambda: save_figures(plot_study(dataset), folder)):
            paths, failure = attempt(write)
            written, failures = written + paths, [*failures, failure]
    checks: list[MeanCheck] = []
    if thetas:
        with computing(INTERRUPTED if folder is None else RESUMABLE) as progress:
            checks = check_terms(plan, thetas(document), progress)
    document |= {"means": [each.as_dict() for each in checks]} if checks else {}
    about = term_lines(checks, plan.config.onset)
    lines = [*lines_of(dataset, document), *about, *(f"warning: {message}" for message in document["warnings"])]
    lines += [f"add --output DIR for {offer}"] if folder is None else []
    if folder is not None and not dataset.attrs["computed_cells"] and not dataset.attrs["missing_cells"]:
        lines.append(f"nothing was computed: {folder} already holds all {len(plan.cells)} cells")
    if folder is not None and not unwritten:
        lines.append(f"written to {folder}: {', '.join([*(path.name for path in written), KEPT])}")
    return print_report(options, document, lines, *failures, all_lost(plan, dataset))


def _compute(plan: StudyPlan, options: argparse.Namespace) -> tuple[xr.Dataset, str | None]:
    """Run a study, in its folder if one is given; a full disk costs no number, and its reason is returned as well."""
    if options.output is None:
        for name in ("cluster", "accept_versions"):
            if getattr(options, name, None):
                raise UsageError(f"--{name.replace('_', '-')} needs a folder for the study: give --output")
        with computing() as progress:
            return run_study(plan, progress=progress), None
    dataset = _compute_in(_store(plan, options), plan, options, keep_going=True)
    reason = dataset.attrs.pop("unwritten", None)
    return dataset, reason and f"{reason}; {INTACT}"


def _store(plan: StudyPlan, options: argparse.Namespace) -> Store:
    with usage_errors():
        return open_store(plan, options.output, options.command_line, accept_versions=options.accept_versions)


def _compute_in(store: Store, plan: StudyPlan, options: argparse.Namespace, *, keep_going: bool) -> xr.Dataset:
    try:
        with ExitStack() as stack:
            if (cluster := getattr(options, "cluster", None)) is not None:
                with usage_errors():
                    cluster = stack.enter_context(connected(cluster))
            progress = stack.enter_context(computing(RESUMABLE))
            return run_study(plan, store, progress, keep_going=keep_going, cluster=cluster)
    except StudyError as error:
        raise UsageError(str(error)) from error


def _announce(plan: StudyPlan, options: argparse.Namespace) -> int:
    with usage_errors():
        found = forecast_study(plan, options.output, accept_versions=options.accept_versions)
    lines = [*found.lines, *(f"warning: {message}" for message in plan.warnings)]
    return print_report(options, dataclasses.asdict(found) | {"warnings": list(plan.warnings)}, lines)


def run_sweep(options: argparse.Namespace, planned: Callable[[], StudyPlan]) -> int:
    """Run a study of any size in its folder: plan, say what is to compute, compute, say where it is."""
    with usage_errors():
        configure_process(options)
        plan = planned()
    if options.dry_run:
        return _announce(plan, options)
    store, folder, unwritten = _store(plan, options), options.output, None
    with usage_errors():
        missing = len(store.missing)
    if not options.json:
        print("\n".join(_sweep_head(plan, missing)), flush=True)
    try:
        dataset = _compute_in(store, plan, options, keep_going=False)
    except OSError as error:
        with usage_errors():
            dataset = load_study(folder)
        unwritten = f"cannot write to {folder}: {error.strerror or error}; {INTACT}"
    computed = dataset.attrs.get("computed_cells", missing - dataset.attrs["missing_cells"])
    sizes = ", ".join(f"{name} {length}" for name, length in dataset.sizes.items() if length > 1)
    titles, rows = numbers_of(dataset) or ([], [])
    findings = findings_of(dataset)
    lines = [*format_table(rows, titles), "", *_meanings(dataset, titles)] if 0 < len(rows) <= MOST_ROWS else []
    lines += [*(f"{sentence}." for sentence in findings), f"computed {computed} cells{sizes and f'; {sizes}'}"]
    lines += [f"warning: {message}" for message in warnings_of(dataset) if message not in plan.warnings]
    lines += [f"written to {folder}: results.nc; mjx-study plot {folder} draws it"] if unwritten is None else []
    document = {
        "folder": str(folder),
        "computed": computed,
        "cells": {name: int(length) for name, length in dataset.sizes.items()},
        "variables": [str(name) for name in dataset.data_vars],
        "findings": findings,
        "warnings": list(warnings_of(dataset)),
    }
    failed = len(json.loads(dataset.attrs.get("failed_cells", "{}")))
    failure = f"{failed} cells failed; the warnings say why" if failed else None
    return print_report(options, document, lines, unwritten, failure, all_lost(plan, dataset))


def _meanings(dataset: xr.Dataset, titles: Iterable[str]) -> list[str]:
    found = "; ".join(f"{name}: {meaning}" for name, meaning in meanings_of(dataset).items() if name in titles)
    seeds = ", of several seeds medians" if dataset.sizes.get("seed", 1) > 1 else ""
    return [*textwrap.wrap(f"{found}. After ±: a standard error; in brackets: a confidence interval{seeds}.", 140), ""]


def _sweep_head(plan: StudyPlan, missing: int) -> list[str]:
    config = plan.config
    models = {(cell.model.family, cell.model.stiffness) for cell in plan.cells}
    work = missing and (
        f"; {plan.compilations} programs to compile, chunks of {plan.chunk_size} samples, "
        f"about {size(plan.memory)} for the batches of a cell"
    )
    return [
        f"{', '.join(config.task_names)}: {plan.kind.describe(plan)}, "
        f"{', '.join(config.estimator_names)}, seeds {config.seeds}",
        f"contact models: {len(models)}, timestep {_listed(group.timestep for group in plan.groups)} s, "
        f"{', '.join(dict.fromkeys(group.cone for group in plan.groups))} cone, "
        f"sigma {_listed(cell.sigma for cell in plan.cells)}, {_listed(cell.samples for cell in plan.cells)} samples",
        f"cells: {len(plan.cells)}, of which {missing} to compute{work or ''}",
        *(f"warning: {message}" for message in plan.warnings),
    ]


def _listed(values: Iterable[float]) -> str:
    distinct = list(dict.fromkeys(values))
    digits = digits_to_tell_apart(distinct)
    return ", ".join(f"{value:.{digits}g}" for value in distinct)
