"""Compute a study's cells, whole or in blocks, by kind of study."""

from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Final

import numpy as np

from mjx_study.stopwatch import timed
from mjx_study.study.blocks import Arrays, Blocks
from mjx_study.study.descents import compute_descents
from mjx_study.study.gradients import Gradients, compute_gradients, done
from mjx_study.study.landscapes import compute_landscapes
from mjx_study.study.plan import StudyCell, StudyPlan
from mjx_study.study.store import Part
from mjx_study.study.work import rest

COMPUTE: Final[dict[str | None, Callable[[StudyPlan], Callable[..., Arrays]]]] = {
    "gradients": compute_gradients,
    "descents": compute_descents,
    "landscapes": compute_landscapes,
}


class Computation:
    """Computes the cells of a plan and keeps compiled programs."""

    def __init__(self, plan: StudyPlan):
        self._plan, self._compute = plan, COMPUTE[plan.config.kind](plan)

    def __call__(self, cell: StudyCell, part: Part) -> Arrays:
        """Compute a cell, resuming from its checkpoint (landscapes have none)."""
        return self.end(cell, self.begin(cell, part))

    def begin(self, cell: StudyCell, part: Part) -> Future[Arrays]:
        """Sample a cell; on accelerators its statistics may still be running on return."""
        with timed(rest(self._plan, cell)):
            if isinstance(self._compute, Gradients):
                return self._compute.begin(cell, part)
            return done(self._compute(cell, *(() if self._plan.config.kind == "landscapes" else (part,))))

    def end(self, cell: StudyCell, begun: Future[Arrays]) -> Arrays:
        """Wait for a cell's numbers."""
        with timed(rest(self._plan, cell), calls=0):
            return begun.result()

    def begun(self, cell: StudyCell, kept: Mapping[str, np.ndarray]) -> Blocks:
        """Blocks of a cell that is split into tasks, with the finished ones of a checkpoint."""
        return self._in_blocks.begun(cell, kept)

    def block(self, cell: StudyCell, task: int) -> Arrays:
        """Compute one of these tasks."""
        return self._in_blocks.block(cell, task)

    def merged(self, cell: StudyCell, blocks: Blocks) -> Arrays:
        """The cell's numbers, once all tasks are done."""
        return self._in_blocks.merged(cell, blocks)

    @property
    def _in_blocks(self) -> Gradients:
        assert isinstance(self._compute, Gradients), "only cells of gradients are split into blocks"
        return self._compute
