"""Compute a study's cells, by kind of study."""

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, Final

from mjx_study.execution.forecast import rest
from mjx_study.experiment.blocks import Arrays
from mjx_study.experiment.checkpoint import Checkpoint
from mjx_study.experiment.descents import compute_descents
from mjx_study.experiment.gradients import Gradients, compute_gradients, done
from mjx_study.experiment.landscapes import compute_landscapes
from mjx_study.experiment.plan import StudyCell, StudyPlan
from mjx_study.stopwatch import timed

COMPUTE: Final[dict[str, Callable[[StudyPlan], Any]]] = {
    "gradients": compute_gradients,
    "descents": compute_descents,
    "landscapes": compute_landscapes,
}


class Computation:
    """Computes the cells of a plan by `compute`, which keeps compiled programs; for cells in blocks, see
    `Gradients`."""

    def __init__(self, plan: StudyPlan):
        self._plan, self.compute = plan, COMPUTE[plan.settings.kind](plan)

    def __call__(self, cell: StudyCell, part: Checkpoint) -> Arrays:
        """Compute a cell, resuming from its checkpoint (landscapes have none)."""
        return self.end(cell, self.begin(cell, part))

    def begin(self, cell: StudyCell, part: Checkpoint) -> Future[Arrays]:
        """Sample a cell; on accelerators its statistics may still be running on return."""
        with timed(rest(self._plan, cell)):
            if isinstance(self.compute, Gradients):
                return self.compute.begin(cell, part)
            return done(self.compute(cell, part))

    def end(self, cell: StudyCell, begun: Future[Arrays]) -> Arrays:
        """Wait for a cell's numbers."""
        with timed(rest(self._plan, cell), calls=0):
            return begun.result()
