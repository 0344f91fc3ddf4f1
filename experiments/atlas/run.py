"""Compute the cells of the atlas on many cores, and keep them in one file of columns."""

import concurrent.futures
import dataclasses
import itertools
import json
import math
import multiprocessing
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import jax
import mujoco
import numpy as np

from experiments import DATA
from experiments.atlas.design import (
    CELLS,
    FAMILIES,
    LAWS,
    POINTS,
    PROGRAMS,
    REFUSED,
    TASKS,
    Cell,
    cells_of,
    contact_of,
    law_cells,
    task_of,
)
from experiments.atlas.programs import SAMPLES, SEED, Programs, measure
from mjx_study.disk import write_whole
from mjx_study.runtime import configure, environment

RESULTS: Final = DATA / "atlas.npz"
BLOCK: Final = 16  # cells computed together
DIGITS: Final = 10  # bits of the mantissa that are kept: a relative error of 5e-4, and a third of the size
FEWEST: Final = 60.0  # remaining time below which no job starts [s]
LARGEST: Final = 200.0  # maximum run time of a job, without compilation [s]; longer ones are split


@dataclasses.dataclass(frozen=True)
class Job:
    """Every `parts`-th cell of a task and timestep, under MuJoCo's law or another one by name."""

    program: int
    part: int
    parts: int
    law: str = ""

    @property
    def name(self) -> str:
        return f"{self.program:02d}-{self.law}{self.part}-of-{self.parts}"

    @property
    def label(self) -> str:
        name, timestep = PROGRAMS[self.program]
        return f"{name} at {timestep:g} s, {self.law or f'{self.part + 1} of {self.parts}'}"

    @property
    def seconds(self) -> float:
        """Rough computing time [s]."""
        name, timestep = PROGRAMS[self.program]
        steps = task_of(name, timestep).horizon
        return TASKS[name].cost * steps * POINTS * (1 if self.law else len(FAMILIES)) / self.parts

    def cells(self, families: Sequence[str]) -> list[Cell]:
        """The job's cells under some contact families, by the compiled programs that they need."""
        if self.law:
            return sorted(law_cells(self.program, self.law), key=lambda cell: cell.smoothing)
        return [cell for cell in list(cells_of(self.program))[self.part :: self.parts] if cell.contact in families]


def jobs(families: Sequence[str] = FAMILIES) -> list[Job]:
    """Return all jobs of some contact families, longest first."""
    found = []
    for program, (name, _) in enumerate(PROGRAMS):
        found += [Job(program, 0, 1, law) for law in LAWS if law in families and (name, law) not in REFUSED]
        if set(families) & set(FAMILIES):
            parts = math.ceil(Job(program, 0, 1).seconds / LARGEST)
            found += [Job(program, part, parts) for part in range(parts)]
    return sorted(found, key=lambda job: -job.seconds)


def blocks(cells: Sequence[Cell]) -> list[Sequence[Cell]]:
    """Split cells into blocks of the same compiled programs."""
    found: list[Sequence[Cell]] = []
    for _, group in itertools.groupby(cells, lambda cell: cell.smoothing if cell.contact in LAWS else 0.0):
        alike = list(group)
        found += [alike[at : at + BLOCK] for at in range(0, len(alike), BLOCK)]
    return found


def compute(
    job: Job, folder: Path, done: frozenset[int], end: float, most: int | None, families: Sequence[str] = FAMILIES
) -> int:
    """Compute the missing cells of a job until time is up; return their number.

    Args:
        done: indices of the cells that exist.
        end: time limit, as `time.time`.
        most: maximum number of cells of each job; None for all.
        families: contact families.
    """
    configure(cpu_devices=1)
    mujoco.set_mju_user_warning(lambda message: None)
    missing = [cell for cell in job.cells(families)[:most] if cell.index not in done]
    if not missing or time.time() > end - FEWEST:
        return 0
    task, parts, longest = task_of(*PROGRAMS[job.program]), [], 0.0
    usual = programs = Programs(task)
    for index, block in enumerate(blocks(missing)):
        begun = time.time()
        if begun + 1.5 * longest > end:
            break
        law = contact_of(task, block[0]).law
        if law != programs.law:
            programs = Programs(task, law, usual)
        found = measure(programs, (list(block) * BLOCK)[:BLOCK])
        parts.append({name: each[: len(block)] for name, each in found.items()})
        write(folder / f"part-{job.name}-{os.getpid()}.npz", parts)
        longest = max(longest, time.time() - begun) if index else 0.0  # the first one compiles
    return sum(len(part["index"]) for part in parts)


def write(path: Path, parts: Sequence[dict[str, np.ndarray]], **more: Any) -> None:
    """Write the columns of all parts as float32 with `DIGITS` bits, sorted by cell and without duplicates; NaN where a
    part lacks a column."""
    whole = [
        {name: np.full(len(part["index"]), np.nan) for name in itertools.chain(*parts)} | dict(part) for part in parts
    ]
    joined = {name: np.concatenate([part[name] for part in whole]) for name in whole[0]}
    _, kept = np.unique(joined["index"], return_index=True)
    indices = joined["index"][kept].astype(np.int32)
    columns = {name: rounded(each[kept]) for name, each in joined.items()} | {"index": indices}
    write_whole(path, lambda file: np.savez_compressed(file, **columns, **more))


def rounded(values: np.ndarray) -> np.ndarray:
    """Round to float32 with `DIGITS` bits of the mantissa."""
    with np.errstate(over="ignore"):
        single = np.asarray(values, np.float32)
    finite = np.isfinite(single)
    bits = single.view(np.uint32)
    half = np.uint32(1 << (22 - DIGITS))
    cut = ((bits + half) & ~np.uint32((1 << (23 - DIGITS)) - 1)).view(np.float32)
    return np.where(finite, cut, single)


def read(path: Path) -> dict[str, np.ndarray]:
    """Read the columns of a file."""
    with np.load(path) as file:
        return {name: file[name] for name in file.files if name != "about"}


def about(path: Path) -> dict[str, Any]:
    """Read the description of a file: machines, samples, seed, programs, families."""
    with np.load(path) as file:
        return json.loads(str(file["about"]))


def merge(path: Path, into: Path = RESULTS) -> None:
    """Add the cells of a file to another; those of the first replace their like."""
    found, environments = [], about(into)["environments"]
    for each in (path, into):
        made, columns = about(each)["environments"], read(each)
        environments += [one for one in made if one not in environments]
        places = np.array([environments.index(one) for one in made])
        found.append(columns | {"environment": places[columns["environment"].astype(int)]})
    write(into, found, about=described(environments))


def described(environments: list[Any]) -> str:
    """What a file says of itself; see `about`."""
    tasks = [task_of(*program) for program in PROGRAMS]
    text = {"environments": environments, "samples": SAMPLES, "seed": SEED, "programs": PROGRAMS}
    text |= {"families": FAMILIES + LAWS, "durations": [task.horizon * task.scene.timestep for task in tasks]}
    return json.dumps(text | {"params": [task.policy.num_params for task in tasks]})


def condense(folder: Path) -> int:
    """Join the parts in a folder into its atlas.npz, and delete them; return the number of cells.

    The column `environment` is an index into the description's `environments`.
    """
    joined = folder / RESULTS.name
    found, environments = [], []
    if joined.exists():
        found.append(read(joined))
        environments += about(joined)["environments"]
    if parts := sorted(path for path in folder.glob("*.npz") if path != joined):
        here = json.loads(json.dumps(environment()))
        if here not in environments:
            environments.append(here)
        for columns in map(read, parts):
            found.append(columns | {"environment": np.full(len(columns["index"]), environments.index(here))})
    if not found:
        return 0
    write(joined, found, about=described(environments))
    for path in parts:
        path.unlink()
    return len(read(joined)["index"])


def run(
    folder: Path,
    workers: int,
    seconds: float,
    most: int | None = None,
    only: Sequence[str] = ("",),
    families: Sequence[str] = FAMILIES,
) -> None:
    """Compute the cells of some contact families in as many processes as workers until time is up."""
    end = time.time() + seconds
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["JAX_PLATFORMS"] = "cpu"
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)  # as in the workers, for `environment`
    before = condense(folder)
    done = frozenset(read(folder / RESULTS.name)["index"].tolist()) if before else frozenset()
    chosen = [job for job in jobs(families) if any(part in job.label for part in only)]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, context, max_tasks_per_child=1) as pool:
        waiting = {pool.submit(compute, job, folder, done, end, most, families): job for job in chosen}
        for future in concurrent.futures.as_completed(waiting):
            left = max(0.0, end - time.time())
            outcome = future.exception() or f"{future.result()} cells"
            print(f"{waiting[future].label}: {outcome}; {left:.0f} s left", flush=True)
    total = CELLS + sum(len(job.cells(families)) for job in jobs(LAWS))
    print(f"{condense(folder)} of {total} cells in {folder / RESULTS.name}; {before} existed before", flush=True)
