"""Times of programs, recorded by runs in the cache of compiled programs and read by forecasts.

A program is identified by its content (model, costs, kind of policy, noise, onset term, kind of contact, precision and
processor), the number of steps and the rows of a call. A call takes about steps x (rows + overhead) times a rate. The
rate comes from the program's own record, or from the same content with other rows or steps, or is a rough one that
grows with degrees of freedom and constraint rows, scaled by this machine's records of other programs.
"""

import dataclasses
import functools
import hashlib
import json
import math
import statistics
import time
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import jax
from pydantic import BaseModel, Field

from mjx_study.caches import read_cached, write_cached
from mjx_study.digest import digest_of
from mjx_study.identity import versions
from mjx_study.runtime import precision, processor_name
from mjx_study.simulation.scene import num_constraint_rows
from mjx_study.stopwatch import Spent, Stopwatch
from mjx_study.tasks.task import Task

OVERHEAD: Final = {"cpu": 25, "gpu": 50_000, "tpu": 50_000}
"""Number of rows that take as long as the overhead of a call, by backend."""
RATE: Final = {"cpu": 4e-7, "gpu": 3.4e-10, "tpu": 3.4e-10}
"""Time of a rollout step without degrees of freedom and constraints [s per row]."""
POWERS: Final = (0.6, 0.3)
"""Exponents of 1 + degrees of freedom and 1 + constraint rows in the time of a step."""
FACTORS: Final = {
    "value": 1.0, "gradient": 4.0, "corrected": 5.0, "steps": 1.0, "step_gradient": 4.0, "linearisation": 5.0,
    "quadrature": 4.0,
}  # fmt: skip
"""Time of each kind of batch relative to rollouts."""
SETUP: Final = (1.0, 2.0)
"""Times of tracing and compilation of a rollout program without degrees of freedom and constraints [s]; other kinds
scale with the square root of their factor."""
OTHERS: Final = {"statistics": (2.5e-8, 5e6), "analytic": (1e-7, 1.5e6)}
"""Time of a cell's statistics [s per number held by its batches] or of an analytic system [s per step of a row], and
how many of these take as long as the overhead of a cell."""
OTHERS_SETUP: Final = (2.0, 3.0)
"""Times of tracing and compilation of these [s]."""
SUFFIX: Final = ".times"
"""Suffix of a record's file."""
SAVE_SECONDS: Final = 5.0
READING: Final = 0.1
"""Time of reading a compiled program relative to compiling it."""
BASES: Final[tuple[str, str, str]] = ("measured here", "scaled from what was measured here", "rough: never run here")
MEASURED, SCALED, ROUGH = BASES


@dataclasses.dataclass(frozen=True)
class Program:
    """Quantities that determine the time of a call of a program, or of a cell's statistics."""

    kind: str  # one of `objective.SamplePrograms`, several joined by "+" in descents, or one of `OTHERS`
    content: str  # digest of what else is compiled, and of the machine
    steps: int  # of a rollout; 1 for statistics
    rows: int  # rollouts in a call; for statistics, numbers
    dof: int = 0
    constraints: int = 0  # rows

    @property
    def work(self) -> float:
        """Measure of work: the time of a call is proportional to it within one content."""
        if self.kind in OTHERS:
            return self.steps * self.rows + OTHERS[self.kind][1]
        return float(self.steps * (self.rows + OVERHEAD[jax.default_backend()]))

    @property
    def rough(self) -> float:
        """Rough estimate of the time of a call [s]."""
        if self.kind in OTHERS:
            return self.work * OTHERS[self.kind][0]
        return self.work * RATE[jax.default_backend()] * statistics.fmean(self._factors) * self._size

    @property
    def _factors(self) -> list[float]:
        return [FACTORS.get(part, 1.0) for part in self.kind.split("+")]

    @property
    def rough_setup(self) -> tuple[float, float]:
        """Rough estimates of tracing and compilation times [s]."""
        if self.kind in OTHERS:
            return OTHERS_SETUP
        grown = self._size * sum(factor**0.5 for factor in self._factors)
        return SETUP[0] * grown, SETUP[1] * grown

    @property
    def _size(self) -> float:
        return float((1 + self.dof) ** POWERS[0] * (1 + self.constraints) ** POWERS[1])


class Record(BaseModel):
    """Recorded times of a program: per call, tracing, and compilation if not cached [s]."""

    kind: str
    content: str
    steps: int = Field(ge=1)
    rows: int = Field(ge=0)
    dof: int
    constraints: int
    each: float = Field(ge=0, allow_inf_nan=False)
    calls: int
    tracing: float = Field(ge=0, allow_inf_nan=False)
    compiling: float = Field(ge=0, allow_inf_nan=False)
    versions: dict[str, str]

    @property
    def program(self) -> Program:
        return Program(**{field.name: getattr(self, field.name) for field in dataclasses.fields(Program)})


def program_of(kind: str, task: Task, contact: Any, rows: int) -> Program:
    """Return a program of a task, given the structure of the contact model's arrays."""
    content, dof = _content(task, str(contact)), int(task.scene.host.nv)
    return Program(kind, content, task.horizon, rows, dof, num_constraint_rows(task.scene.template))


def other_program(kind: str, rows: int, *content: str, steps: int = 1) -> Program:
    """The work of a cell besides its batches."""
    return Program(kind, _digest(_machine(), *content), steps, rows)


@functools.lru_cache(maxsize=32)
def _content(task: Task, contact: str) -> str:
    parts = task.scene, task.running_cost, task.final_cost, type(task.policy), task.noise, task.onset
    return _digest(digest_of(parts), contact, _machine())


def _machine() -> str:
    device = jax.local_devices()[0]
    return _digest(precision(), device.platform, device.device_kind, processor_name())


def _digest(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


def times_folder() -> Path | None:
    """Folder of the records, in the cache of compiled programs; None without such a folder."""
    cache = jax.config.values["jax_compilation_cache_dir"]
    return None if not cache or "://" in cache else Path(cache) / "times"


@contextmanager
def recording(watch: Stopwatch | None = None) -> Generator[None]:
    """Record the times of programs run within, for later forecasts; failures to write are ignored.

    The latest run of a program counts, so concurrent processes need not wait for each other. A watch with earlier
    measurements of the same process is written at most every `SAVE_SECONDS`.
    """
    watch = Stopwatch() if watch is None else watch
    with watch.running():
        try:
            yield
        finally:
            if time.monotonic() - watch.saved > SAVE_SECONDS and (folder := times_folder()) is not None:
                watch.saved = time.monotonic()
                for program, spent in watch.spent.items():
                    _write(folder, program, spent)


def _write(folder: Path, key: Any, spent: Spent) -> None:
    if isinstance(key, str):
        return
    program = key if isinstance(key, Program) else program_of(*key)
    path = folder / f"{program.kind}-{program.content}-{program.steps}-{program.rows}{SUFFIX}"
    setup = {"tracing": spent.tracing, "compiling": spent.compiling, "versions": versions()}
    if not spent.setups and (earlier := _read(path)):
        setup = earlier.model_dump(include=set(setup))
    times = {"each": spent.each, "calls": spent.calls or spent.first_calls}
    record = dataclasses.asdict(program) | times | setup
    write_cached(path, json.dumps(record).encode())


def _read(path: Path) -> Record | None:
    """Read a record; None if there is none, or a damaged one."""
    content = read_cached(path)
    try:
        return None if content is None else Record.model_validate_json(content)
    except ValueError:
        return None


class Rates:
    """Times of programs, from records and a rough model."""

    def __init__(self, records: Iterable[Record]):
        self._records = list(records)
        self._own = {record.program: record for record in self._records}

    @classmethod
    def read(cls, folder: Path | None) -> "Rates":
        """Read a folder's records, skipping damaged ones."""
        return cls(filter(None, map(_read, sorted(folder.glob(f"*{SUFFIX}")) if folder else ())))

    def call(self, program: Program) -> tuple[float, str]:
        """Seconds of a call, and the basis of the figure (see `BASES`)."""
        if program in self._own:
            return self._own[program].each, MEASURED
        if record := self._nearest(program):
            return record.each * program.rough / record.program.rough, SCALED
        return program.rough * self._speed(program, lambda record: (record.each, record.program.rough)), ROUGH

    def setup(self, program: Program) -> tuple[float, float, bool, str]:
        """Seconds of tracing and of compilation, whether it is compiled here already, and the basis of the figures."""
        if record := self._own.get(program):
            return record.tracing, record.compiling, record.versions == versions(), MEASURED
        tracing, compiling = program.rough_setup
        if record := self._nearest(program):
            rough = record.program.rough_setup
            return record.tracing * tracing / rough[0], record.compiling * compiling / rough[1], False, SCALED
        both = lambda record: (record.tracing + record.compiling, sum(record.program.rough_setup))  # noqa: E731
        speed = self._speed(program, both)
        return tracing * speed, compiling * speed, False, ROUGH

    def _nearest(self, program: Program) -> Record | None:
        """Record of the same content with the nearest work, of the same kind if there is one."""
        same = [each for each in self._records if each.content == program.content and each.each > 0]
        kind = [each for each in same if each.kind == program.kind] or same
        return min(kind, key=lambda each: abs(math.log(each.program.work / program.work)), default=None)

    def _speed(self, program: Program, times: Any) -> float:
        """Median ratio of measured to rough times, over records of this kind, else of all kinds of rollouts."""
        kind = [each for each in self._records if each.kind == program.kind]
        if program.kind in FACTORS or "+" in program.kind:
            kind = kind or [each for each in self._records if each.dof]
        ratios = [measured / rough for measured, rough in map(times, kind) if measured > 0]
        return statistics.median(ratios) if ratios else 1.0
