"""mjx-study sweep."""

import argparse
import dataclasses
import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args, get_type_hints

from mjx_study.cli.options import (
    Commands,
    UsageError,
    add_command,
    add_estimator_options,
    add_process_options,
    computing,
    configure_process,
    names,
    print_report,
    usage_errors,
)
from mjx_study.contact import FAMILIES
from mjx_study.scene import CONES
from mjx_study.store import StudyError
from mjx_study.sweep import SweepConfig, SweepPlan, SweepResult, open_store, plan_sweep, run_sweep
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
RESUMABLE = "mjx-study: interrupted; the same command goes on where it stopped"
LISTS = {"tasks": str, "estimators": str, "contact": str, "cone": str, "stiffness": float, "timestep": float,
         "sigma": float, "samples": int, "span": float}  # fmt: skip


def add(commands: Commands) -> None:
    """Register the command."""
    command = add_command(commands, "sweep", "sweep contact models, noise and samples; resumable", run, EPILOG)
    command.add_argument(
        "tasks", nargs="?", type=names, metavar="TASK[,TASK]", help=f"of: {', '.join(task_names())}, or module:name"
    )
    command.add_argument("--config", type=Path, metavar="FILE.toml", help="options from a file; flags go before it")
    command.add_argument("--contact", type=names, metavar="FAMILY[,FAMILY]", help=f"of: {', '.join(FAMILIES)}")
    command.add_argument("--stiffness", metavar="K", help="contact stiffnesses in N/m (default: the task's)")
    command.add_argument("--damping", type=float, metavar="B", help="contact damping in N s/m")
    command.add_argument("--solref", metavar="A;B", help="contact models in MuJoCo's terms, every A with every B")
    command.add_argument("--solimp", metavar="D0,D1,W,M,P", help="with them; several separated by ;")
    command.add_argument("--timestep", metavar="H", help="in s (default: the MJCF's)")
    command.add_argument("--cone", type=names, metavar="CONE[,CONE]", help=f"of: {', '.join(CONES)}")
    command.add_argument("--sigma", metavar="S", help="noise, in the unit of what it is added to")
    command.add_argument("--samples", metavar="N", help="in each batch (default: 100)")
    command.add_argument(
        "--seeds", type=int, metavar="N", help="batches, or descents, of each (default: 10; 1 of landscapes)"
    )
    command.add_argument("--estimators", type=names, metavar="NAME[,NAME]", help="default: zobg,fobg,aobg")
    command.add_argument("--iterations", type=int, metavar="N", help="optimise policies, N steps each")
    command.add_argument("--points", type=int, metavar="N", help="landscapes, on N points of a line through theta")
    command.add_argument("--span", metavar="LO,HI", help="of that line (default: each task's)")
    command.add_argument("--direction", metavar="DIR", help="of it: random, or a parameter's index (default: random)")
    command.add_argument("--optimizer", metavar="NAME", help="of optax (default: sgd)")
    command.add_argument("--learning-rate", type=float, metavar="R", help="default: the task's")
    command.add_argument("--decay", type=float, metavar="A", help="learning rate / i^A (default: the task's)")
    command.add_argument("--reference-samples", type=int, metavar="N", help="pairs behind a reference (default: 600)")
    command.add_argument("--evaluation-samples", type=int, metavar="N", help="behind a final cost (default: 200)")
    add_estimator_options(command)
    command.add_argument("--horizon", type=int, metavar="H", help="steps (default: the task's)")
    command.add_argument("--model", metavar="FILE.xml", help="an MJCF in place of the task's own")
    command.add_argument("--chunk-size", type=int, metavar="N", help="samples per device and call")
    add_process_options(command)
    command.set_defaults(seed=None)  # so that a file may say it
    command.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder of the study")


def run(options: argparse.Namespace) -> int:
    """Plan, compute what is missing, print."""
    with usage_errors():
        configure_process(options)
        plan = plan_sweep(SweepConfig(**_fields(options)))
        store = open_store(plan, options.output, options.command_line)
        missing = len(store.missing)
    if not options.json:
        print("\n".join(_head(plan, missing)), flush=True)
    try:
        with computing(RESUMABLE) as progress:
            result = run_sweep(plan, options.output, progress)
    except StudyError as error:
        raise UsageError(str(error)) from error
    except OSError as error:
        raise UsageError(
            f"cannot write to {options.output}: {error.strerror or error}; what is there is complete, and the same "
            "command goes on"
        ) from error
    print_report(options, _document(result), _tail(result, plan))
    return 0


def _fields(options: argparse.Namespace) -> dict[str, Any]:
    """The configuration's fields: flags first, then the file's."""
    fields = {field.name for field in dataclasses.fields(SweepConfig)}
    given = {name: getattr(options, name) for name in fields if getattr(options, name, None) is not None}
    kept = {} if options.config is None else _from_file(options.config, fields)
    merged = {name: _value(name, value) for name, value in (kept | given).items()}
    if "tasks" not in merged:
        raise ValueError("no task: name one, or give --config")
    if merged.get("solref") or merged.get("solimp"):
        merged.setdefault("contact", ())
    return merged


def _from_file(path: Path, fields: set[str]) -> dict[str, Any]:
    try:
        found = tomllib.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"cannot read {path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not TOML: {error}") from error
    unknown = sorted(set(found) - fields)
    if unknown:
        raise ValueError(f"{path}: unknown option {', '.join(unknown)}; there are {', '.join(sorted(fields))}")
    if isinstance(found.get("direction"), int):
        found["direction"] = str(found["direction"])
    for name, value in found.items():
        _check_kind(path, name, value)
    return found


def _check_kind(path: Path, name: str, value: Any) -> None:
    """Raises ValueError for a single value of a file that is of another kind than its option's."""
    if name in LISTS or name in ("solref", "solimp"):
        return
    kinds = get_type_hints(SweepConfig)[name]
    accepted = tuple(kind for kind in (*get_args(kinds), kinds) if kind in (int, float, str))
    number = (int,) if float in accepted else ()
    if isinstance(value, bool) or not isinstance(value, accepted + number):
        told = "a whole number" if accepted == (int,) else "text" if accepted == (str,) else "a number"
        raise ValueError(f"{path}: {name} must be {told}, got {value!r}")


def _value(name: str, value: Any) -> Any:
    """A field from what a flag or a file gave."""
    try:
        if name in ("solref", "solimp"):
            return _solver_values(name, value)
        if name in LISTS:
            return _many(value, LISTS[name])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {error}") from error
    return value


def _many(value: Any, kind: type) -> tuple[Any, ...]:
    """A tuple from text, a number or a list; text may be a range."""
    if isinstance(value, str) and kind is not str:
        return tuple(_whole(each) if kind is int else each for part in value.split(",") for each in _range(part))
    if isinstance(value, str | int | float):
        value = [value]
    for each in value:
        if isinstance(each, bool) or not isinstance(each, (int, float) if kind is float else kind):
            raise ValueError(f"{each!r} is no {'name' if kind is str else 'number'}")
    return tuple(kind(each) for each in value)


def _whole(value: float) -> int:
    if value != round(value):
        raise ValueError(f"{value:g} is not a whole number")
    return round(value)


def _range(text: str) -> list[float]:
    """10, or 10:1000:3:log."""
    parts = text.strip().split(":")
    try:
        if len(parts) == 1:
            return [float(text)]
        log = parts[3:] == ["log"]
        if len(parts) not in (3, 4) or (len(parts) == 4 and not log):
            raise ValueError
        start, stop, count = float(parts[0]), float(parts[1]), int(parts[2])
        if count < 2 or (log and start * stop <= 0):
            raise ValueError
    except ValueError:
        raise ValueError(
            f"{text!r} is neither a number nor a range FROM:TO:COUNT or FROM:TO:COUNT:log, COUNT at least 2"
        ) from None
    shares = [index / (count - 1) for index in range(count)]
    if log:
        ratio, sign = math.log(stop / start), math.copysign(1.0, start)
        inner = [sign * float(f"{abs(start) * math.exp(share * ratio):.12g}") for share in shares]
    else:
        inner = [float(f"{start + share * (stop - start):.12g}") for share in shares]
    return [start, *inner[1:-1], stop]


def _solver_values(name: str, value: Any) -> tuple[tuple[float, ...], ...]:
    """solref: the first numbers with every second one; solimp: as they are."""
    if not isinstance(value, str):
        return tuple(tuple(map(float, each)) for each in value)
    if name == "solimp":
        return tuple(tuple(float(number) for number in part.split(",")) for part in value.split(";"))
    columns = [[each for part in column.split(",") for each in _range(part)] for column in value.split(";")]
    if len(columns) != 2:
        raise ValueError("two columns separated by ;, such as -1000,-10000;-5")
    return tuple((first, second) for first in columns[0] for second in columns[1])


def _head(plan: SweepPlan, missing: int) -> list[str]:
    """The configuration as it was resolved."""
    config, cells = plan.config, len(plan.cells)
    kind = {"descents": f"descents of {config.iterations} iterations", "landscapes": f"{config.points} points"}
    lines = [
        f"{', '.join(config.tasks)}: {kind.get(config.kind, config.kind)}, {', '.join(config.estimators)}, "
        f"seeds {config.batches}",
        f"contact models: {len({(c.model.family, c.model.stiffness) for c in plan.cells})}, "
        f"timestep {_listed(group.timestep for group in plan.groups)} s, "
        f"{', '.join(dict.fromkeys(group.cone for group in plan.groups))} cone, "
        f"sigma {_listed(cell.sigma for cell in plan.cells)}, "
        f"{', '.join(map(str, config.samples))} samples",
        f"cells: {cells}, of which {missing} to compute"
        + (f"; {plan.compilations} programs to compile, chunks of {plan.chunk_size} samples" if missing else ""),
    ]
    return lines + [f"warning: {message}" for message in plan.warnings]


def _listed(values: Iterable[float]) -> str:
    distinct = list(dict.fromkeys(values))
    digits = digits_to_tell_apart(distinct)
    return ", ".join(f"{value:.{digits}g}" for value in distinct)


def _document(result: SweepResult) -> dict[str, Any]:
    return {
        "folder": str(result.folder),
        "computed": result.computed,
        "cells": {name: int(size) for name, size in result.dataset.sizes.items()},
        "variables": [str(name) for name in result.dataset.data_vars],
        "warnings": list(result.warnings),
    }


def _tail(result: SweepResult, plan: SweepPlan) -> list[str]:
    """What was computed, and what there is to warn about beyond what the head said."""
    sizes = ", ".join(f"{name} {size}" for name, size in result.dataset.sizes.items())
    lines = [f"computed {result.computed} cells; {sizes}"]
    lines += [f"warning: {message}" for message in result.warnings if message not in plan.warnings]
    return [*lines, f"written to {result.folder}: results.nc; mjx-study plot {result.folder} draws it"]
