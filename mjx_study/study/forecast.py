"""Forecast the cost of a study from its plan, finished cells and recorded program times, without computing."""

import dataclasses
import heapq
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import jax

from mjx_study.runtime import available_cores
from mjx_study.study.gradients import MOST_KEPT
from mjx_study.study.plan import StudyCell, StudyPlan, blocks_of, estimators_of
from mjx_study.study.run import begun_store
from mjx_study.study.times import BASES, READING, Program, Rates, times_folder
from mjx_study.study.variables import VARIABLES
from mjx_study.study.work import calls, iteration, rest, rollouts, setups
from mjx_study.table import count, duration, size


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
        told = ", ".join(f"{basis} ({share:.0%})" if len(shares) > 1 else basis for basis, share in shares.items())
        return f"time: about {duration(self.seconds)}, of which compilation {duration(self.compilation)}; {told}"


def forecast(
    plan: StudyPlan, folder: Path | None = None, *, accept_versions: bool = False, cluster: str | None = None
) -> Forecast:
    """Forecast the cost of a plan, less the finished cells of a folder if one is given.

    The cluster is as for `cluster.connected`; an address is not contacted and counts as one worker. ValueError if the
    folder holds another study, or one computed with other versions.
    """
    store = None if folder is None else begun_store(plan, folder, accept_versions=accept_versions)
    longer = store is not None and (store.document["config"].get("iterations") or 0) < plan.iterations
    if store is not None:
        plan = plan.with_chunk(store.chunk_size)
    missing = range(len(plan.cells)) if store is None or longer else store.missing
    cells = [plan.cells[index] for index in missing]
    counts = [rollouts(plan, cell) for cell in cells]
    time = _Time(Rates.read(times_folder()))
    devices = len(jax.local_devices()) if cluster is None else _workers(cluster)
    compilation = time.setup(plan, cells)
    if cluster is None:
        spent = sum((time.cell(plan, cell, devices) for cell in cells), 0.0)
    else:
        tasks = ((time.cell(plan, cell, 1), 1 + blocks_of(plan, cell) * plan.config.batches) for cell in cells)
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
        if plan.config.kind == "descents" and not cell.model.analytic:
            recipe = plan.groups[cell.group].recipe
            assert recipe is not None
            programs = [iteration(plan, cell, each.needs) for each in estimators_of(plan, cell)]
            own = [self._calls(program, recipe.iterations) for program in programs]
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


def _kept(plan: StudyPlan, cell: StudyCell) -> int:
    """Size of a cell's arrays [bytes]."""
    config, group = plan.config, plan.groups[cell.group]
    sizes = {
        "seed": config.batches,
        "estimator": len(config.estimators),
        "iteration": group.recipe.iterations if group.recipe else 0,
        "point": config.points or 0,
        "param": group.task.policy.num_params,
    }
    counts = [math.prod(sizes[dim] for dim in each.dims) for each in VARIABLES[str(config.kind)].values()]
    return int(8 * sum(count for count in counts if config.kind != "gradients" or count <= MOST_KEPT))
