"""The cells that a run computes: work units, checkpoints and progress, wherever a unit is computed."""

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future
from typing import Any

from mjx_study.experiment.study import SAVE_SECONDS, Arrays, Checkpoint, Computation, StudyPlan
from mjx_study.progress import Progress


class Cells:
    """Cells of a plan, from their checkpoints to their numbers.

    Args:
        checkpoint: the checkpoint of a cell, from its index and what reports progress within it.
    """

    def __init__(
        self,
        plan: StudyPlan,
        computation: Computation,
        progress: Progress,
        checkpoint: Callable[[int, Progress], Checkpoint] = lambda _, report: Checkpoint(report=report),
    ):
        self.plan, self.computation = plan, computation
        self._progress, self._checkpoint = progress, checkpoint
        self.done = 0
        self._works: dict[int, tuple[Checkpoint, Any]] = {}
        self._saved: dict[int, float] = {}  # times of the last checkpoints
        self._compiled: set[Any] = {None}

    def begin(self, index: int) -> list[int]:
        """Begin a cell, and return its unfinished work units."""
        alone, label = len(self.plan.cells) == 1, self.label(index)
        within = self._progress if alone else lambda done, total, what: self.report(label)
        checkpoint = self._checkpoint(index, within)
        work = self.computation.begin(self.plan.cells[index], checkpoint)
        self._works[index], self._saved[index] = (checkpoint, work), time.monotonic()
        return [0] if work is None else work.missing

    def compute(self, index: int, unit: int) -> Future[Arrays]:
        return self.computation.compute(self.plan.cells[index], unit, self._works[index][0])

    def kept(self, index: int) -> Arrays:
        """Checkpoint of a cell of one unit, which that unit continues."""
        checkpoint, work = self._works[index]
        return dict(checkpoint.kept) if work is None else {}

    def finish(self, index: int, unit: int, arrays: Arrays) -> Arrays | None:
        """Add what a unit found; return the cell's numbers if no other unit is missing."""
        checkpoint, work = self._works[index]
        if work is not None:
            work.add(unit, arrays)
            left = len(work.missing)
            if left and time.monotonic() - self._saved[index] >= SAVE_SECONDS:
                checkpoint.save(work.arrays())
                self._saved[index] = time.monotonic()
            checkpoint.report(work.units - left, work.units, f"{self.label(index)}, in blocks")
            return None if left else self.end(index)
        self.drop(index)
        self.done += 1
        return arrays

    def end(self, index: int) -> Arrays:
        """The numbers of a cell in blocks, none of which is missing."""
        self.done += 1
        return self._works.pop(index)[1].numbers()

    def drop(self, index: int) -> bool:
        """Give up a cell; False if that has happened before."""
        return self._works.pop(index, None) is not None

    def running(self, index: int) -> bool:
        """Whether a cell is begun, and neither finished nor given up."""
        return index in self._works

    def label(self, index: int) -> str:
        return self.plan.label(self.plan.cells[index])

    def announce(self, index: int) -> None:
        """Report that this process computes a cell next."""
        program = self.plan.program_of(self.plan.cells[index])
        label = self.label(index) + ("" if program in self._compiled else " (compiling first)")
        self._progress(self.done + len(self._works), len(self.plan.cells), label)
        self._compiled.add(program)

    def report(self, what: str) -> None:
        self._progress(self.done, len(self.plan.cells), what)


Executor = Callable[[Cells, Iterable[int]], Generator[tuple[int, Arrays | str]]]
"""Computes cells, and yields each with its numbers, or with the reason why it failed."""


def compute_here(cells: Cells, indices: Iterable[int]) -> Generator[tuple[int, Arrays]]:
    """Compute cells in this process; on accelerators, a unit begins before the statistics of the one before end."""
    running: deque[tuple[int, int, Future[Arrays]]] = deque()

    def finished(wait: int) -> Generator[tuple[int, Arrays]]:
        """Cells whose last unit has ended, waiting until so many units are left."""
        while len(running) > wait or (running and running[0][2].done()):
            index, unit, found = running.popleft()
            if (numbers := cells.finish(index, unit, found.result())) is not None:
                yield index, numbers

    for index in indices:
        cells.announce(index)
        missing = cells.begin(index)
        if not missing:
            yield index, cells.end(index)
        for unit in missing:
            running.append((index, unit, cells.compute(index, unit)))
            yield from finished(1)
    yield from finished(0)
