"""mjx-study sweep."""

import argparse
import dataclasses
import itertools
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mjx_study.choices import TASK_DESCRIPTIONS
from mjx_study.cli.options import Parser, UsageError, known_task
from mjx_study.options.configuration import StudyConfig
from mjx_study.options.option import BUILDER_OPTIONS, MOST_VALUES, OPTIONS, Interval, Option

if TYPE_CHECKING:
    from pydantic import BaseModel

EPILOG = """\
Every combination of task, contact model, timestep, cone, sigma and number of samples is a cell: all its seeds and
estimators are computed together and written to DIR as one file. Stop whenever you like, with Ctrl-C or kill -9: the
same command computes what is missing, with the same numbers. Two such processes at once share the work.

Gradients are estimated at each task's initial theta. With --iterations, policies are optimised instead; with --points,
landscapes are computed: the cost along a line, and the slope that every estimator sees.

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

A TOML file holds the same options under the names of their flags, with _ for -:
  tasks = ["pusher"]
  contact = ["penalty", "mujoco"]
  stiffness = "10:1e5:13:log"
  samples = [30, 100]
  seeds = 10
"""
NUMBERS = Option("numbers", float, "X", "", Interval("(-inf, inf)"), many=True)
TASKS = Option("tasks", str, "TASK", "", many=True)


def add(command: Parser) -> None:
    choices = f"one or more of: {', '.join(TASK_DESCRIPTIONS)}, or module:name"
    command.add_argument("tasks", nargs="?", type=_tasks, metavar="TASK[,TASK]", help=choices)
    command.add_argument("--config", type=Path, metavar="FILE.toml", help="options from a file; flags take precedence")
    command.add_fields("contact", "stiffness", "damping")
    command.add_option("solref", read=solref)
    command.add_option("solimp", read=solimp)
    command.add_fields("timestep", "cone", "sigma", "samples")
    command.add_fields(
        "seeds",
        "estimators",
        "kind",
        "network",
        "confidence",
        seeds={"line": "batches for each cell, or descents", "unset": "10; 1 for landscapes"},
    )
    command.add_fields("iterations", iterations={"line": "optimise policies, N iterations", "unset": ""})
    command.add_fields("points", points={"line": "landscapes, at N points of a line through theta"})
    command.add_fields("span", "direction", "optimizer", "learning_rate", "decay")
    command.add_fields("stiffness_schedule", "sigma_schedule", "reference_samples", "evaluation_samples")
    command.add_estimator_options()
    command.add_backward_options()
    command.add_fields(*BUILDER_OPTIONS, "chunk_size", "block_size")
    command.add_process_options(seed=None)
    command.add_argument("--output", type=Path, metavar="DIR", help="folder for the study; only --dry-run does without")
    command.add_cluster_option()
    command.add_resume_options()


def run(options: argparse.Namespace) -> int:
    if options.output is None and not options.dry_run:
        raise UsageError("no folder for the study: give --output, or --dry-run. See mjx-study sweep --help")
    from mjx_study.cli.studies import run_sweep
    from mjx_study.experiment.plan import plan_study

    return run_sweep(options, lambda: plan_study(StudyConfig(**sweep_fields(options))))


def sweep_fields(options: argparse.Namespace) -> dict[str, Any]:
    """Fields of a sweep's configuration; flags take precedence over the file."""
    from mjx_study.cli.studies import study_fields
    from mjx_study.options.files import read_toml

    fields = ({} if options.config is None else read_toml(options.config, _schema())) | study_fields(options)
    if "tasks" not in fields:
        raise ValueError("no task: name one, or give --config")
    if fields.get("solref") or fields.get("solimp"):
        fields.setdefault("contact", ())
    return fields


def _schema() -> type["BaseModel"]:
    """Schema of a TOML file: the configuration's fields, parsed like their options."""
    from pydantic import BeforeValidator, ConfigDict, create_model

    own = {"tasks": TASKS.read, "direction": _direction, "solref": solref, "solimp": solimp}
    names = [field.name for field in dataclasses.fields(StudyConfig)]
    readers = {name: own[name] if name in own else StudyConfig.option(name).read for name in names}
    fields = {name: (Annotated[Any, BeforeValidator(read)], None) for name, read in readers.items()}
    return create_model("Sweep", __config__=ConfigDict(extra="forbid"), **fields)  # type: ignore[call-overload]


def _direction(value: Any) -> str:
    return OPTIONS["direction"].read(str(value) if isinstance(value, int) and not isinstance(value, bool) else value)


def _tasks(text: str) -> tuple[str, ...]:
    return tuple(map(known_task, TASKS.parse(text)))


def solref(value: Any) -> tuple[tuple[float, ...], ...]:
    """Parse rows of numbers; in text, combine every number of the first column with every one of the second."""
    if not isinstance(value, str):
        return _rows(value)
    columns = [NUMBERS.parse(column) for column in value.split(";")]
    if len(columns) != 2:
        raise ValueError("must be two columns separated by ;, such as -1000,-10000;-5")
    if len(columns[0]) * len(columns[1]) > MOST_VALUES:
        raise ValueError(f"must be at most {MOST_VALUES} contact models, got {len(columns[0]) * len(columns[1])}")
    return tuple(itertools.product(*columns))


def solimp(value: Any) -> tuple[tuple[float, ...], ...]:
    """Parse rows of numbers, separated by ; in text."""
    return tuple(NUMBERS.parse(part) for part in value.split(";")) if isinstance(value, str) else _rows(value)


def _rows(value: Any) -> tuple[tuple[float, ...], ...]:
    if not isinstance(value, list):
        raise ValueError(f"must be a list of lists of numbers, got {value!r:.60}")
    return tuple(NUMBERS.read(row) for row in value)
