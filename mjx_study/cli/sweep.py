"""mjx-study sweep."""

import argparse
import dataclasses
import json
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import xarray as xr
from pydantic import BaseModel, BeforeValidator, ConfigDict, create_model

from mjx_study.cli.options import UsageError, computing, configure_process, finish, print_report, usage_errors
from mjx_study.cli.parsers.sweep import TASKS, solimp, solref
from mjx_study.cli.studies import RESUMABLE, announce, study_fields
from mjx_study.files import read_toml
from mjx_study.option import OPTIONS
from mjx_study.study.cluster import connected
from mjx_study.study.run import StudyConfig, StudyPlan, load_study, open_store, plan_study, run_study, warnings_of
from mjx_study.study.store import StudyError
from mjx_study.table import digits_to_tell_apart, size


def run(options: argparse.Namespace) -> int:
    with usage_errors():
        configure_process(options)
        plan = plan_study(StudyConfig(**_fields(options)))
    if options.dry_run:
        return announce(plan, options)
    with usage_errors():
        store = open_store(plan, options.output, options.command_line, accept_versions=options.accept_versions)
        missing = len(store.missing)
    if not options.json:
        print("\n".join(_head(plan, missing)), flush=True)
    unwritten = None
    try:
        with ExitStack() as stack:
            if options.cluster is not None:
                with usage_errors():
                    options.cluster = stack.enter_context(connected(options.cluster))
            progress = stack.enter_context(computing(RESUMABLE))
            dataset = run_study(plan, store, progress, cluster=options.cluster)
    except StudyError as error:
        raise UsageError(str(error)) from error
    except OSError as error:
        with usage_errors():
            dataset = load_study(options.output)
        reason = f"cannot write to {options.output}: {error.strerror or error}"
        unwritten = f"{reason}; existing files are complete, and the same command resumes"
    computed = dataset.attrs.get("computed_cells", missing - dataset.attrs["missing_cells"])
    drawn = f"written to {options.output}: results.nc; mjx-study plot {options.output} draws it"
    lines = [*_tail(dataset, computed, plan), *([drawn] if unwritten is None else [])]
    print_report(options, _document(dataset, computed, options.output), lines)
    failed = len(json.loads(dataset.attrs.get("failed_cells", "{}")))
    return finish(unwritten, f"{failed} cells failed; the warnings say why" if failed else None)


def _fields(options: argparse.Namespace) -> dict[str, Any]:
    """Fields of the configuration; flags take precedence over the file."""
    merged = ({} if options.config is None else read_toml(options.config, _schema())) | study_fields(options)
    if "tasks" not in merged:
        raise ValueError("no task: name one, or give --config")
    if merged.get("solref") or merged.get("solimp"):
        merged.setdefault("contact", ())
    return merged


def _schema() -> type[BaseModel]:
    """Schema of a TOML file: the configuration's fields, parsed like their options."""
    own = {"tasks": TASKS.read, "direction": _direction, "solref": solref, "solimp": solimp}

    def reader(name: str) -> Callable[[Any], Any]:
        return own[name] if name in own else StudyConfig.option(name).read

    fields = {
        field.name: (Annotated[Any, BeforeValidator(reader(field.name))], None)
        for field in dataclasses.fields(StudyConfig)
    }
    return create_model("Sweep", __config__=ConfigDict(extra="forbid"), **fields)  # type: ignore[call-overload]


def _direction(value: Any) -> str:
    return OPTIONS["direction"].read(str(value) if isinstance(value, int) and not isinstance(value, bool) else value)


def _head(plan: StudyPlan, missing: int) -> list[str]:
    config, cells = plan.config, len(plan.cells)
    lengths = _listed(group.recipe.iterations for group in plan.groups if group.recipe)
    kind = {"descents": f"descents of {lengths} iterations", "landscapes": f"{config.points} points"}
    lines = [
        f"{', '.join(config.task_names)}: {kind.get(str(config.kind), config.kind)}, {', '.join(config.estimators)}, "
        f"seeds {config.batches}",
        f"contact models: {len({(c.model.family, c.model.stiffness) for c in plan.cells})}, "
        f"timestep {_listed(group.timestep for group in plan.groups)} s, "
        f"{', '.join(dict.fromkeys(group.cone for group in plan.groups))} cone, "
        f"sigma {_listed(cell.sigma for cell in plan.cells)}, "
        f"{_listed(cell.samples for cell in plan.cells)} samples",
        f"cells: {cells}, of which {missing} to compute"
        + (
            f"; {plan.compilations} programs to compile, chunks of {plan.chunk_size} samples, "
            f"about {size(plan.memory)} for the batches of a cell"
            if missing
            else ""
        ),
    ]
    return lines + [f"warning: {message}" for message in plan.warnings]


def _listed(values: Iterable[float]) -> str:
    distinct = list(dict.fromkeys(values))
    digits = digits_to_tell_apart(distinct)
    return ", ".join(f"{value:.{digits}g}" for value in distinct)


def _document(dataset: xr.Dataset, computed: int, folder: Path) -> dict[str, Any]:
    return {
        "folder": str(folder),
        "computed": computed,
        "cells": {name: int(size) for name, size in dataset.sizes.items()},
        "variables": [str(name) for name in dataset.data_vars],
        "warnings": list(warnings_of(dataset)),
    }


def _tail(dataset: xr.Dataset, computed: int, plan: StudyPlan) -> list[str]:
    """End of the output: what was computed, and warnings not already in the head."""
    sizes = ", ".join(f"{name} {size}" for name, size in dataset.sizes.items())
    lines = [f"computed {computed} cells; {sizes}"]
    lines += [f"warning: {message}" for message in warnings_of(dataset) if message not in plan.warnings]
    return lines
