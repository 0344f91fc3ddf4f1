"""mjx-study sweep."""

import argparse
import dataclasses
import itertools
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import xarray as xr
from pydantic import BaseModel, BeforeValidator, ConfigDict, create_model

from mjx_study.cli.options import (
    Commands,
    UsageError,
    add_command,
    add_estimator_options,
    add_option,
    add_options,
    add_process_options,
    add_versions_option,
    computing,
    configure_process,
    finish,
    print_report,
    usage_errors,
)
from mjx_study.cli.studies import RESUMABLE
from mjx_study.files import read_toml
from mjx_study.option import MOST_VALUES, OPTIONS, Interval, Option
from mjx_study.study.run import (
    StudyConfig,
    StudyPlan,
    load_study,
    open_store,
    plan_study,
    run_study,
    warnings_of,
)
from mjx_study.study.store import StudyError
from mjx_study.table import digits_to_tell_apart
from mjx_study.tasks import task_names

EPILOG = """\
Every combination of task, contact model, timestep, cone, sigma and number of samples is a cell: all its seeds and
estimators are computed at once and written to DIR as one file. Stop it when you like, with Ctrl-C or kill -9; the same
command computes what is missing, to the same numbers. Two of them at once share the work.

Gradients are estimated where each task starts. With --iterations, policies are optimised; with --points, landscapes
are drawn: the cost along a line, and the slope that every estimator sees.

Numbers may be lists (10,100,1000) or ranges: FROM:TO:COUNT, or FROM:TO:COUNT:log for equal ratios.

examples:
  mjx-study sweep pusher --stiffness 10:1e5:13:log --contact penalty,mujoco --output out
  mjx-study sweep pusher --stiffness 10:1e4:7:log --iterations 500 --samples 10 --seeds 5 --output descents
  mjx-study sweep momentum_transfer --contact mujoco,smooth_onset --points 31 --timestep 0.001,0.002 --output slopes
  mjx-study sweep pusher,ball_wall --timestep 0.001,0.0025,0.005 --samples 30,100,300 --output steps
  mjx-study sweep ball_wall --solref='-1e5:-1e3:5:log;-10' --solimp 0.9,0.95,0.001,0.5,2 --output solref
  mjx-study sweep --config study.toml --output out
  mjx-study plot out
  mjx-study report out

A TOML file holds the same options by the names of their flags, with _ for -:
  tasks = ["pusher"]
  contact = ["penalty", "mujoco"]
  stiffness = "10:1e5:13:log"
  samples = [30, 100]
  seeds = 10
"""
NUMBERS = Option("numbers", float, "X", "", Interval("(-inf, inf)"), many=True)
TASKS = Option("tasks", str, "TASK", "", many=True)


def add(commands: Commands) -> None:
    """Register the command."""
    command = add_command(commands, "sweep", "sweep contact models, noise and samples; resumable", run, EPILOG)
    choices = f"of: {', '.join(task_names())}, or module:name"
    command.add_argument("tasks", nargs="?", type=TASKS.parse, metavar="TASK[,TASK]", help=choices)
    command.add_argument("--config", type=Path, metavar="FILE.toml", help="options from a file; flags go before it")
    add_options(command, StudyConfig, "contact", "stiffness", "damping")
    add_option(command, OPTIONS["solref"], read=_solref)
    add_option(command, OPTIONS["solimp"], read=_solimp)
    add_options(command, StudyConfig, "timestep", "cone", "sigma", "samples")
    add_options(command, StudyConfig, "seeds", "estimators", seeds={"unset": "10; 1 of landscapes"})
    add_options(command, StudyConfig, "kind", "network", "confidence")
    add_options(command, StudyConfig, "iterations", iterations={"line": "optimise policies, N steps each", "unset": ""})
    add_options(command, StudyConfig, "points", points={"line": "landscapes, on N points of a line through theta"})
    add_options(command, StudyConfig, "span", "direction")
    add_options(command, StudyConfig, "optimizer", "learning_rate", "decay", optimizer={"unset": "sgd"})
    add_options(command, StudyConfig, "reference_samples", reference_samples={"unset": "600"})
    add_options(command, StudyConfig, "evaluation_samples", evaluation_samples={"unset": "200"})
    add_estimator_options(command, StudyConfig)
    add_options(command, StudyConfig, "horizon", "model", "chunk_size")
    add_process_options(command, seed=None)
    command.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder of the study")
    add_versions_option(command)


def run(options: argparse.Namespace) -> int:
    """Plan, compute what is missing, print."""
    with usage_errors():
        configure_process(options)
        plan = plan_study(StudyConfig(**_fields(options)))
        store = open_store(plan, options.output, options.command_line, accept_versions=options.accept_versions)
        missing = len(store.missing)
    if not options.json:
        print("\n".join(_head(plan, missing)), flush=True)
    unwritten = None
    try:
        with computing(RESUMABLE) as progress:
            dataset = run_study(plan, store, progress)
    except StudyError as error:
        raise UsageError(str(error)) from error
    except OSError as error:
        with usage_errors():
            dataset = load_study(options.output)
        reason = f"cannot write to {options.output}: {error.strerror or error}"
        unwritten = f"{reason}; what is there is complete, and the same command goes on"
    computed = dataset.attrs.get("computed_cells", missing - dataset.attrs["missing_cells"])
    drawn = f"written to {options.output}: results.nc; mjx-study plot {options.output} draws it"
    lines = [*_tail(dataset, computed, plan), *([drawn] if unwritten is None else [])]
    print_report(options, _document(dataset, computed, options.output), lines)
    return finish(unwritten)


def _fields(options: argparse.Namespace) -> dict[str, Any]:
    """The configuration's fields: flags first, then the file's."""
    given = {field.name: getattr(options, field.name, None) for field in dataclasses.fields(StudyConfig)}
    kept = {} if options.config is None else read_toml(options.config, _schema())
    merged = kept | {name: value for name, value in given.items() if value is not None}
    if "tasks" not in merged:
        raise ValueError("no task: name one, or give --config")
    if merged.get("solref") or merged.get("solimp"):
        merged.setdefault("contact", ())
    return merged


def _schema() -> type[BaseModel]:
    """Of a TOML file: the configuration's fields as their options read them."""
    own = {"tasks": TASKS.read, "direction": _direction, "solref": _solref, "solimp": _solimp}

    def reader(name: str) -> Callable[[Any], Any]:
        return own[name] if name in own else StudyConfig.option(name).read

    fields = {
        field.name: (Annotated[Any, BeforeValidator(reader(field.name))], None)
        for field in dataclasses.fields(StudyConfig)
    }
    return create_model("Sweep", __config__=ConfigDict(extra="forbid"), **fields)  # type: ignore[call-overload]


def _direction(value: Any) -> str:
    return OPTIONS["direction"].read(str(value) if isinstance(value, int) and not isinstance(value, bool) else value)


def _solref(value: Any) -> tuple[tuple[float, ...], ...]:
    """Rows of numbers; of text, the first column's numbers with every one of the second."""
    if not isinstance(value, str):
        return _rows(value)
    columns = [NUMBERS.parse(column) for column in value.split(";")]
    if len(columns) != 2:
        raise ValueError("must be two columns separated by ;, such as -1000,-10000;-5")
    if len(columns[0]) * len(columns[1]) > MOST_VALUES:
        raise ValueError(f"must be at most {MOST_VALUES} contact models, got {len(columns[0]) * len(columns[1])}")
    return tuple(itertools.product(*columns))


def _solimp(value: Any) -> tuple[tuple[float, ...], ...]:
    """Rows of numbers; of text, separated by ;."""
    return tuple(NUMBERS.parse(part) for part in value.split(";")) if isinstance(value, str) else _rows(value)


def _rows(value: Any) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, list):
        raise ValueError(f"must be a list of lists of numbers, got {value!r:.60}")
    return tuple(NUMBERS.read(row) for row in value)


def _head(plan: StudyPlan, missing: int) -> list[str]:
    """The configuration as it was resolved."""
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
            f"about {plan.memory / 1e9:.2g} GB for the batches of a cell"
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
    """What was computed, and what there is to warn about beyond what the head said."""
    sizes = ", ".join(f"{name} {size}" for name, size in dataset.sizes.items())
    lines = [f"computed {computed} cells; {sizes}"]
    lines += [f"warning: {message}" for message in warnings_of(dataset) if message not in plan.warnings]
    return lines
