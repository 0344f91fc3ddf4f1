"""Compute the cells of the atlas on many cores, and keep them in one file of columns."""

import concurrent.futures
import dataclasses
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
from experiments.atlas.design import CELLS, FAMILIES, POINTS, PROGRAMS, TASKS, cells_of, task_of
from experiments.atlas.programs import SAMPLES, SEED, Programs, measure
from mjx_study.disk import write_whole
from mjx_study.runtime import configure, environment

RESULTS: Final = DATA / "atlas.npz"
BLOCK: Final = 16
"""Cells computed together."""
DIGITS: Final = 10
"""Bits of the mantissa that are kept: a relative error of 5e-4, and a third of the size."""
FEWEST: Final = 60.0
"""Remaining time below which no job starts [s]."""
LARGEST: Final = 200.0
"""Maximum run time of a job, without compilation [s]; longer ones are split."""


@dataclasses.dataclass(frozen=True)
class Job:
    """Every `parts`-th cell of a task and timestep."""

    program: int
    part: int
    parts: int

    @property
    def name(self) -> str:
        return f"{self.program:02d}-{self.part}-of-{self.parts}"

    @property
    def label(self) -> str:
        name, timestep = PROGRAMS[self.program]
        return f"{name} at {timestep:g} s, {self.part + 1} of {self.parts}"

    @property
    def seconds(self) -> float:
        """Rough computing time [s]."""
        name, timestep = PROGRAMS[self.program]
        steps = task_of(name, timestep).horizon
        return TASKS[name].cost * steps * POINTS * len(FAMILIES) / self.parts


def jobs() -> list[Job]:
    """Return all jobs, longest first."""
    unsplit = [Job(program, 0, 1) for program in range(len(PROGRAMS))]
    counts = [math.ceil(job.seconds / LARGEST) for job in unsplit]
    split = [Job(job.program, part, parts) for job, parts in zip(unsplit, counts, strict=True) for part in range(parts)]
    return sorted(split, key=lambda job: -job.seconds)


def compute(job: Job, folder: Path, done: frozenset[int], end: float, most: int | None) -> int:
    """Compute the missing cells of a job until time is up; return their number.

    Args:
        done: indices of the cells that exist.
        end: time limit, as `time.time`.
        most: maximum number of cells of each job; None for all.
    """
    configure(cpu_devices=1)
    mujoco.set_mju_user_warning(lambda message: None)
    planned = list(cells_of(job.program))[job.part :: job.parts][:most]
    missing = [cell for cell in planned if cell.index not in done]
    if not missing or time.time() > end - FEWEST:
        return 0
    programs, parts, longest = Programs(task_of(*PROGRAMS[job.program])), [], 0.0
    for at in range(0, len(missing), BLOCK):
        begun = time.time()
        if begun + 1.5 * longest > end:
            break
        parts.append(measure(programs, (missing[at : at + BLOCK] * BLOCK)[:BLOCK]))
        parts[-1] = {name: each[: len(missing) - at] for name, each in parts[-1].items()}
        write(folder / f"part-{job.name}-{os.getpid()}.npz", parts)
        longest = max(longest, time.time() - begun) if at else 0.0  # the first one compiles
    return sum(len(part["index"]) for part in parts)


def write(path: Path, parts: Sequence[dict[str, np.ndarray]], **more: Any) -> None:
    """Write the columns of all parts as float32 with `DIGITS` bits, sorted by cell and without duplicates."""
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
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
    tasks = [task_of(*program) for program in PROGRAMS]
    described = {
        "environments": environments,
        "samples": SAMPLES,
        "seed": SEED,
        "programs": PROGRAMS,
        "families": FAMILIES,
    }
    described |= {"durations": [task.horizon * task.scene.timestep for task in tasks]}
    described |= {"params": [task.policy.num_params for task in tasks]}
    write(joined, found, about=json.dumps(described))
    for path in parts:
        path.unlink()
    return len(read(joined)["index"])


def run(folder: Path, workers: int, seconds: float, most: int | None = None, only: Sequence[str] = ("",)) -> None:
    """Compute in as many processes as workers until time is up."""
    end = time.time() + seconds
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["JAX_PLATFORMS"] = "cpu"
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)  # as in the workers, for `environment`
    before = condense(folder)
    done = frozenset(read(folder / RESULTS.name)["index"].tolist()) if before else frozenset()
    chosen = [job for job in jobs() if any(part in job.label for part in only)]
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(workers, context, max_tasks_per_child=1) as pool:
        waiting = {pool.submit(compute, job, folder, done, end, most): job for job in chosen}
        for future in concurrent.futures.as_completed(waiting):
            left = max(0.0, end - time.time())
            outcome = future.exception() or f"{future.result()} cells"
            print(f"{waiting[future].label}: {outcome}; {left:.0f} s left", flush=True)
    print(f"{condense(folder)} of {CELLS} cells in {folder / RESULTS.name}; {before} existed before", flush=True)
