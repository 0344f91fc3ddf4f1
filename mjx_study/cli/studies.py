"""Shared by the commands that run studies: options to configuration, the folder, figures."""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import xarray as xr

from mjx_study.cli.options import UsageError, attempt, computing, print_report, usage_errors
from mjx_study.plots.study import plot_study
from mjx_study.plots.style import save_figures
from mjx_study.study.configuration import StudyConfig
from mjx_study.study.forecast import forecast
from mjx_study.study.plan import StudyPlan
from mjx_study.study.run import open_store, run_study
from mjx_study.study.store import StudyError

RESUMABLE = "the same command goes on where it stopped"


def study_fields(options: argparse.Namespace) -> dict[str, Any]:
    """Fields of a `StudyConfig` set by the options."""
    given = {field.name: getattr(options, field.name, None) for field in dataclasses.fields(StudyConfig)}
    return {name: value for name, value in given.items() if value is not None and name not in ("tasks", "theta")}


def compute(plan: StudyPlan, options: argparse.Namespace) -> tuple[xr.Dataset, str | None]:
    """Run a study, in its folder where one is given; what a full disk refuses is kept in memory.

    Returns:
        The numbers, and why they could not be written, if so.

    Raises:
        UsageError: the folder holds another study, or a damaged one, or cannot be used.
    """
    if options.output is None:
        with computing() as progress:
            return run_study(plan, progress=progress), None
    try:
        with usage_errors():
            store = open_store(plan, options.output, options.command_line, accept_versions=options.accept_versions)
        with computing(RESUMABLE) as progress:
            dataset = run_study(plan, store, progress, keep_going=True)
    except StudyError as error:
        raise UsageError(str(error)) from error
    reason = dataset.attrs.pop("unwritten", None)
    return dataset, reason and f"{reason}; what is there is complete, and the same command goes on"


def announce(plan: StudyPlan, options: argparse.Namespace) -> int:
    """Print what a study would take."""
    with usage_errors():
        found = forecast(plan, options.output, accept_versions=options.accept_versions)
    warnings = [f"warning: {message}" for message in plan.warnings]
    print_report(options, dataclasses.asdict(found) | {"warnings": list(plan.warnings)}, [*found.lines, *warnings])
    return 0


def draw(dataset: xr.Dataset, folder: Path | None, unwritten: str | None) -> tuple[list[Path], str | None]:
    """The figures of a study in its folder; what was written, and why something was not."""
    if folder is None or unwritten:
        return [], None
    return attempt(lambda: save_figures(plot_study(dataset), folder))
