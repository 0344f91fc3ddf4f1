"""The computation of a cell, by kind of study: from a plan to a function of its cells."""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from mjx_study.stopwatch import timed
from mjx_study.study.descents import compute_descents
from mjx_study.study.gradients import compute_gradients
from mjx_study.study.landscapes import compute_landscapes
from mjx_study.study.plan import StudyCell, StudyPlan
from mjx_study.study.store import Part
from mjx_study.study.work import rest

COMPUTE: Final[dict[str | None, Callable[[StudyPlan], Callable[..., dict[str, np.ndarray]]]]] = {
    "gradients": compute_gradients,
    "descents": compute_descents,
    "landscapes": compute_landscapes,
}


def compute_cells(plan: StudyPlan) -> Callable[[StudyCell, Part], dict[str, np.ndarray]]:
    """A function that computes a cell, of descents from its checkpoint on; it keeps what is compiled."""
    compute = COMPUTE[plan.config.kind](plan)

    def computed(cell: StudyCell, part: Part) -> dict[str, np.ndarray]:
        further: Any = (part,) if plan.config.kind == "descents" else ()
        with timed(rest(plan, cell)):
            return compute(cell, *further)

    return computed
