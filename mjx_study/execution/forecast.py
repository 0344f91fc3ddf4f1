"""Forecast what a study costs from its plan and its finished cells, without computing."""

import dataclasses
from pathlib import Path

from mjx_study.experiment.study import StudyPlan
from mjx_study.storage.folder import begun_store
from mjx_study.table import count, size


@dataclasses.dataclass(frozen=True)
class Forecast:
    """The forecast cost of a study; counts cover the missing cells, and rollouts and sizes are approximate."""

    cells: int
    computed: int  # cells already in the folder
    programs: int  # rollout programs to compile
    rollouts: int  # to simulate, including those to differentiate
    references: int  # and at most, where references need more pairs
    gradients: int  # rollouts to differentiate
    kept: int  # size of all cells' arrays [bytes]
    memory: int  # size of the largest cell's batches held at once [bytes]

    @property
    def lines(self) -> list[str]:
        return [
            f"cells: {self.cells}, {self.computed} computed, {self.cells - self.computed} to compute",
            f"programs to compile: {self.programs}",
            f"rollouts: about {count(self.rollouts)}, {count(self.gradients)} of them differentiated"
            + (f", and up to {count(self.references)} where references need them" if self.references else ""),
            f"arrays kept: {size(self.kept)}; batches of a cell: about {size(self.memory)} of memory",
            "nothing was computed or written",
        ]


def forecast_study(plan: StudyPlan, folder: Path | None = None, *, accept_versions: bool = False) -> Forecast:
    """Forecast the cost of a plan, less the finished cells of a folder if one is given.

    ValueError if the folder holds another study, or one computed with other versions.
    """
    store = None if folder is None else begun_store(plan, folder, accept_versions=accept_versions)
    longer = store is not None and store.document["config"].get("iterations") != plan.iterations
    missing = range(len(plan.cells)) if store is None or longer else store.missing
    left = dataclasses.replace(plan, cells=tuple(plan.cells[index] for index in missing))
    rollouts = [plan.kind.rollouts(plan, cell) for cell in left.cells]
    return Forecast(
        cells=len(plan.cells),
        computed=len(plan.cells) - len(left.cells),
        programs=left.compilations,
        rollouts=sum(int(total) for total, _ in rollouts),
        references=sum(plan.kind.more_rollouts(plan, cell) for cell in left.cells),
        gradients=sum(int(differentiated) for _, differentiated in rollouts),
        kept=sum(plan.kind.size(plan, cell) for cell in plan.cells),
        memory=plan.memory,
    )
