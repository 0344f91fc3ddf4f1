"""The cost of a study, from its plan and the cells computed already; computes and writes nothing."""

import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from mjx_study.study.configuration import StudyConfig
from mjx_study.study.gradients import CANDIDATES, MOST_KEPT
from mjx_study.study.landscapes import QUADRATURE
from mjx_study.study.plan import StudyCell, StudyPlan, estimators_of, oracles_of
from mjx_study.study.quadrature import applies
from mjx_study.study.run import begun_store
from mjx_study.study.sampling import rollouts_of
from mjx_study.study.store import Store
from mjx_study.study.variables import VARIABLES


@dataclasses.dataclass(frozen=True)
class Forecast:
    """The cost of a study; counts are of the missing cells.

    Attributes:
        computed: number of cells that the folder has.
        programs: programs of rollouts to compile.
        rollouts: rollouts to simulate, those that are differentiated included, about.
        gradients: rollouts to differentiate, about.
        kept: arrays of all cells [bytes].
        memory: batches of the largest cell at once, about [bytes].
        seconds: computing time at the rate of the computed cells, without compilation and reference gradients [s];
            None if there are none, if they have no times, or if descents are to go on.
    """

    cells: int
    computed: int
    programs: int
    rollouts: int
    gradients: int
    kept: int
    memory: int
    seconds: float | None

    @property
    def lines(self) -> list[str]:
        seconds = (
            "not known" if self.seconds is None else f"{self.seconds:.3g} s or more, at the rate of the computed cells"
        )
        return [
            f"cells: {self.cells}, {self.computed} computed, {self.cells - self.computed} to compute",
            f"programs to compile: {self.programs}",
            f"rollouts: about {self.rollouts:.4g}, {self.gradients:.4g} of them differentiated",
            f"arrays kept: {self.kept / 1e6:.3g} MB; batches of a cell: about {self.memory / 1e9:.2g} GB of memory",
            f"computing time: {seconds}",
            "nothing was computed or written",
        ]


def forecast(plan: StudyPlan, folder: Path | None = None, *, accept_versions: bool = False) -> Forecast:
    """The cost of a plan, in a folder where one is given.

    Raises:
        ValueError: the folder holds another study, or one of other versions.
    """
    store = None if folder is None else begun_store(plan, folder, accept_versions=accept_versions)
    longer = store is not None and (store.document["config"].get("iterations") or 0) < plan.iterations
    missing = range(len(plan.cells)) if store is None or longer else store.missing
    cells = [plan.cells[index] for index in missing]
    counts = [_rollouts(plan, cell) for cell in cells]
    programs = {program for cell in cells if (program := plan.program_of(cell)) is not None}
    each = len(plan.config.estimators) if plan.config.kind == "descents" else 2
    return Forecast(
        cells=len(plan.cells),
        computed=len(plan.cells) - len(cells),
        programs=each * len(programs),
        rollouts=sum(count for count, _ in counts),
        gradients=sum(count for _, count in counts),
        kept=sum(_kept(plan, cell) for cell in plan.cells),
        memory=plan.memory,
        seconds=None if store is None or longer else _seconds(plan, store, cells),
    )


def _rollouts(plan: StudyPlan, cell: StudyCell) -> tuple[int, int]:
    """Rollouts of a cell, and how many of them are differentiated."""
    config, group = plan.config, plan.groups[cell.group]

    def batches(oracles: Iterable[str]) -> np.ndarray:
        return np.sum([rollouts_of(oracle, cell.samples, group.task.random_start) for oracle in oracles], axis=0)

    if config.kind == "descents":
        assert group.recipe is not None
        each = np.sum([batches(estimator.needs) for estimator in estimators_of(plan, cell)], axis=0)
        evaluations = (config.batches * len(config.estimators) + 1) * (config.evaluation_samples or 0)
        total = config.batches * group.recipe.iterations * each + [evaluations, 0]
    elif config.kind == "landscapes":
        exact = QUADRATURE if not cell.model.analytic and applies(group.task) else 0
        total = (config.points or 0) * config.batches * batches(oracles_of(config)) + [exact, exact]
    else:
        candidates = 0 if cell.model.analytic else CANDIDATES
        total = config.batches * batches(oracles_of(config))
        total = total + [2 * (config.reference_samples or 0) + candidates, candidates]
    return int(total[0]), int(total[1])


def _kept(plan: StudyPlan, cell: StudyCell) -> int:
    """Bytes of the arrays of a cell."""
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


def _seconds(plan: StudyPlan, store: Store, missing: list[StudyCell]) -> float | None:
    """Computing time of the missing cells, at the rate of the others."""
    rates = []
    for index, cell in enumerate(plan.cells):
        if store.has(index) and (spent := _spent(plan.config, cell, store.read(index))) is not None:
            rates.append(spent / _size(plan, cell))
    return float(np.mean(rates)) * sum(_size(plan, cell) for cell in missing) if rates else None


def _spent(config: StudyConfig, cell: StudyCell, arrays: dict[str, Any]) -> float | None:
    """Measured seconds of a cell: descents one after another; the longest of batches that estimators share."""
    if config.kind == "descents":
        return float(np.nansum(np.nanmax(arrays["seconds"], axis=0)))
    if config.kind == "gradients":
        return float(np.max(arrays["seconds_per_sample"])) * cell.samples * config.batches
    return None


def _size(plan: StudyPlan, cell: StudyCell) -> int:
    """The work of a cell, to which its time is proportional: samples times steps times iterations."""
    group = plan.groups[cell.group]
    return cell.samples * group.task.horizon * (group.recipe.iterations if group.recipe else 1)
