"""Forecast the cost of a study from its plan, finished cells and recorded program times, without computing.

The work of a cell is that of calls of programs, see `times.Program`, and the rest.
"""

import dataclasses
import heapq
import itertools
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjx_study.execution.times import BASES, READING, Program, Rates, other_program, program_of, times_folder
from mjx_study.experiment.gradients import CANDIDATES, MOST_KEPT, takes_candidates
from mjx_study.experiment.landscapes import CHUNK, QUADRATURE, applies
from mjx_study.experiment.memory import batches_at_once
from mjx_study.experiment.plan import (
    StudyCell,
    StudyPlan,
    blocks_of,
    bytes_in_block,
    estimators_of,
    memory_of_seed,
    oracles_of,
    seeds_together,
)
from mjx_study.experiment.sampling import calls_of, rollouts_of
from mjx_study.objective import contact_for, rounds
from mjx_study.results.variables import VARIABLES
from mjx_study.runtime import available_cores, local_devices
from mjx_study.storage.folder import begun_store
from mjx_study.table import count, duration, percent, size


@dataclasses.dataclass(frozen=True)
class Forecast:
    """The forecast cost of a study; counts cover the missing cells, and rollouts and sizes are approximate."""

    cells: int
    computed: int  # cells already in the folder
    programs: int  # rollout programs to compile
    rollouts: int  # to simulate, including those to differentiate
    gradients: int  # rollouts to differentiate
    kept: int  # size of all cells' arrays [bytes]
    memory: int  # size of the largest cell's batches held at once [bytes]
    devices: int  # of this process, or workers of a cluster, that share the work
    seconds: float  # from the start of the first cell to the end of the last [s]
    compilation: float  # the part of it spent on tracing and compilation, or on reading compiled programs [s]
    basis: dict[str, float]  # time by basis of the estimate (`times.BASES`), summed over all devices [s]

    @property
    def lines(self) -> list[str]:
        return [
            f"cells: {self.cells}, {self.computed} computed, {self.cells - self.computed} to compute",
            f"programs to compile: {self.programs}",
            f"rollouts: about {count(self.rollouts)}, {count(self.gradients)} of them differentiated",
            f"arrays kept: {size(self.kept)}; batches of a cell: about {size(self.memory)} of memory",
            self._time,
            "nothing was computed or written",
        ]

    @property
    def _time(self) -> str:
        total = sum(self.basis.values())
        if total == 0:
            return "time: none"
        shares = {basis: seconds / total for basis, seconds in self.basis.items() if seconds > 0.005 * total}
        told = ", ".join(f"{basis} ({percent(share)})" if len(shares) > 1 else basis for basis, share in shares.items())
        return f"time: about {duration(self.seconds)}, of which compilation {duration(self.compilation)}; {told}"


def forecast_study(
    plan: StudyPlan, folder: Path | None = None, *, accept_versions: bool = False, cluster: str | None = None
) -> Forecast:
    """Forecast the cost of a plan, less the finished cells of a folder if one is given.

    The cluster is as for `cluster.connected`; an address is not contacted and counts as one worker. ValueError if the
    folder holds another study, or one computed with other versions.
    """
    store = None if folder is None else begun_store(plan, folder, accept_versions=accept_versions)
    longer = store is not None and store.document["config"].get("iterations") != plan.iterations
    if store is not None:
        plan = plan.with_chunk(store.chunk_size)
    missing = range(len(plan.cells)) if store is None or longer else store.missing
    cells = [plan.cells[index] for index in missing]
    counts = [rollouts(plan, cell) for cell in cells]
    time = _Time(Rates.read(times_folder()))
    devices = len(local_devices()) if cluster is None else _workers(cluster)
    compilation = time.setup(plan, cells)
    if cluster is None:
        spent = sum((time.cell(plan, cell, devices) for cell in cells), 0.0)
    else:
        tasks = ((time.cell(plan, cell, 1), _tasks(plan, cell)) for cell in cells)
        spent = _side_by_side((seconds / count for seconds, count in tasks for _ in range(count)), devices)
    return Forecast(
        cells=len(plan.cells),
        computed=len(plan.cells) - len(cells),
        programs=dataclasses.replace(plan, cells=tuple(cells)).compilations,
        rollouts=sum(count for count, _ in counts),
        gradients=sum(count for _, count in counts),
        kept=sum(_kept(plan, cell) for cell in plan.cells),
        memory=plan.memory,
        devices=devices,
        seconds=compilation + spent,
        compilation=compilation,
        basis=time.basis,
    )


class _Time:
    """Times of cells, and the basis of each."""

    def __init__(self, rates: Rates):
        self._rates = rates
        self.basis = dict.fromkeys(BASES, 0.0)

    def setup(self, plan: StudyPlan, cells: Sequence[StudyCell]) -> float:
        """Seconds of tracing and compiling all programs in sequence."""
        programs = {key: program for cell in cells for key, program in setups(plan, cell).items()}
        total, read = 0.0, set()
        for program in programs.values():
            tracing, compiling, compiled, basis = self._rates.setup(program)
            seconds = tracing + compiling * (READING if compiled or program in read else 1)
            read.add(program)
            self.basis[basis] += seconds
            total += seconds
        return total

    def cell(self, plan: StudyPlan, cell: StudyCell, devices: int) -> float:
        """Seconds of a cell, excluding compilation."""
        counts = calls(plan, cell, devices)
        own: list[float] = []
        if plan.settings.kind == "descents" and not cell.model.analytic:
            iterations = plan.groups[cell.group].descent.iterations
            programs = [iteration(plan, cell, each.needs) for each in estimators_of(plan, cell)]
            own = [self._calls(program, iterations) for program in programs]
            counts = {program: count for program, count in counts.items() if program not in programs}
        batches = sum((self._calls(program, count) for program, count in counts.items()), 0.0)
        return batches + _side_by_side(own, devices) + self._calls(rest(plan, cell), 1)

    def _calls(self, program: Program, count: int) -> float:
        seconds, basis = self._rates.call(program)
        self.basis[basis] += count * seconds
        return count * seconds


def _side_by_side(seconds: Iterable[float], workers: int) -> float:
    """Return when the last of several tasks ends if each begins in turn as soon as a worker is free."""
    ends = [0.0] * workers
    for each in seconds:
        heapq.heappush(ends, heapq.heappop(ends) + each)
    return max(ends)


def _workers(cluster: str) -> int:
    """Number of a cluster's workers that run in parallel; local ones share the cores."""
    kind, _, count = cluster.partition(":")
    if kind == "local":
        return min(int(count or available_cores()), available_cores())
    return int(count or 1) if kind == "slurm" else 1


def _tasks(plan: StudyPlan, cell: StudyCell) -> int:
    """Number of tasks into which a cell is divided among workers: the reference and all blocks, or the whole cell."""
    blocks = blocks_of(plan, cell)
    return 1 if blocks == 1 else 1 + blocks * plan.config.batches


def _kept(plan: StudyPlan, cell: StudyCell) -> int:
    """Size of a cell's arrays [bytes]."""
    config, group = plan.config, plan.groups[cell.group]
    sizes: dict[str, Any] = {
        "seed": config.batches,
        "estimator": len(config.estimators),
        "iteration": group.recipe and group.recipe.iterations,
        "point": plan.settings.points,
        "param": group.task.policy.num_params,
    }
    counts = [math.prod(sizes[dim] for dim in each.dims) for each in VARIABLES[plan.settings.kind].values()]
    return int(8 * sum(count for count in counts if plan.settings.kind != "gradients" or count <= MOST_KEPT))


def rollouts(plan: StudyPlan, cell: StudyCell) -> tuple[int, int]:
    """Approximate number of rollouts of a cell, and of those differentiated."""
    config, group = plan.config, plan.groups[cell.group]

    def batches(oracles: Any) -> np.ndarray:
        return np.sum([rollouts_of(oracle, cell.samples, group.task.random_start) for oracle in oracles], axis=0)

    if plan.settings.kind == "descents":
        each = np.sum([batches(estimator.needs) for estimator in estimators_of(plan, cell)], axis=0)
        total = config.batches * group.descent.iterations * each + [_evaluations(plan), 0]
    elif plan.settings.kind == "landscapes":
        exact = QUADRATURE if not cell.model.analytic and applies(group.task) else 0
        total = plan.settings.points * config.batches * batches(oracles_of(config)) + [exact, exact]
    else:
        candidates = 0 if cell.model.analytic else CANDIDATES
        total = config.batches * batches(oracles_of(config))
        total = total + [2 * plan.settings.reference_samples + candidates, candidates]
    return int(total[0]), int(total[1])


def calls(plan: StudyPlan, cell: StudyCell, devices: int) -> Counter[Program]:
    """Sequential calls of each program on several devices at once, without those that compile it.

    Descents of several estimators run in parallel, with calls in the order of the estimators; early stops take less.
    """
    found: Counter[Program] = Counter()
    if cell.model.analytic:
        return found
    task, config, settings = plan.groups[cell.group].task, plan.config, plan.settings

    def batch(program: str, rows: int, times: int = 1) -> None:
        found[_program(plan, cell, program, plan.chunk_size)] += times * rounds(rows, plan.chunk_size, devices)

    if settings.kind == "descents":
        for estimator in estimators_of(plan, cell):
            found[iteration(plan, cell, estimator.needs)] += plan.groups[cell.group].descent.iterations
        evaluations = calls_of("evaluation", settings.evaluation_samples, task.random_start)
        batch("value", evaluations[0][1], _costs(plan))
        return found
    groups = _in_turn(config.batches, seeds_together(plan, cell))
    draws = [some for seeds in groups for some in _in_turn(seeds, batches_at_once(cell.samples))]
    for some, oracle in itertools.product(draws, oracles_of(config)):
        for program, rows in calls_of(oracle, some * cell.samples, task.random_start):
            batch(program, rows, settings.points)
    if settings.kind == "gradients":
        odd = takes_candidates(task)
        batch("value", (2 if odd else 3) * settings.reference_samples)
        if odd:
            batch("gradient", CANDIDATES)
    elif applies(task):
        found[_program(plan, cell, "quadrature", CHUNK)] += rounds(QUADRATURE, CHUNK, devices)
    return found


def iteration(plan: StudyPlan, cell: StudyCell, needs: tuple[str, ...]) -> Program:
    """Program of an iteration of all seeds of an estimator that needs these oracles."""
    task = plan.groups[cell.group].task
    parts = [part for oracle in needs for part in calls_of(oracle, cell.samples, task.random_start)]
    # chunks of a seed, padded to full size, in sequence for all seeds at once
    rows = sum(math.ceil(rows / plan.chunk_size) * plan.chunk_size for _, rows in parts) * plan.config.batches
    return _program(plan, cell, "+".join(name for name, _ in parts), rows)


def rest(plan: StudyPlan, cell: StudyCell) -> Program:
    """The work of a cell besides its rollout programs, as one call: statistics, or all of an analytic system."""
    config, task = plan.config, plan.groups[cell.group].task
    content = plan.settings.kind, *config.estimator_names
    if cell.model.analytic:
        return other_program("analytic", rollouts(plan, cell)[0], task.name, *content, steps=task.horizon)
    if plan.settings.kind == "descents":
        numbers = _evaluations(plan) * task.policy.num_params
    elif blocks_of(plan, cell) > 1:
        numbers, content = cell.samples * bytes_in_block(plan, cell) // 8 * config.batches, (*content, "in blocks")
    else:
        numbers = memory_of_seed(plan, cell) // 8 * config.batches * plan.settings.points
    return other_program("statistics", numbers, *content)


def setups(plan: StudyPlan, cell: StudyCell) -> dict[Any, Program]:
    """Programs to compile before a cell is computed, by what they are compiled for."""
    own, other = plan.program_of(cell), rest(plan, cell)
    found: dict[Any, Program] = {other: other}
    for program in calls(plan, cell, 1):
        found[own, program] = program
    if plan.settings.kind == "descents" and own is not None:
        for estimator in estimators_of(plan, cell):
            found[own, estimator] = found.pop((own, program := iteration(plan, cell, estimator.needs)), program)
    return found


def _program(plan: StudyPlan, cell: StudyCell, kind: str, rows: int) -> Program:
    contact = contact_for(kind, cell.model.contact)
    return program_of(kind, plan.groups[cell.group].task, jax.tree.structure(contact), rows)


def _costs(plan: StudyPlan) -> int:
    """Number of evaluations of descents' costs: at the end for every seed, and once at the start."""
    return plan.config.batches * len(plan.config.estimators) + 1


def _evaluations(plan: StudyPlan) -> int:
    return _costs(plan) * plan.settings.evaluation_samples


def _in_turn(count: int, together: int) -> list[int]:
    """Sizes of the groups of at most `together` that make up `count`."""
    return [min(together, count - start) for start in range(0, count, together)]
