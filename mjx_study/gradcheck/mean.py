"""Is the mean of an estimator the gradient of the mean cost? Its integral along a path, against the cost's difference.

The derivative of every step can be right and the mean of first-order gradients wrong all the same: no check of single
steps sees that.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp

from estimators import Estimator
from estimators.mean_check import TOLERANCE, Circulation, circulations
from mjx_study.objective import Simulator, chunk_for
from mjx_study.study.configuration import Progress, check_span
from mjx_study.study.line import direction_of
from mjx_study.study.resolution import check_estimators
from mjx_study.table import format_table
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Task

HALF_LENGTH: Final = 2.0
"""Of the path to either side of theta, in standard deviations of noise on theta."""
FEEDBACK: Final = 0.02
"""The same where the noise is on the controls, in the unit of theta."""
HEADER: Final = ("contact", "K [N/m]", "estimator", "difference", "gap", "±", "quadrature", "share", "finds", "verdict")


@dataclasses.dataclass(frozen=True)
class MeanCheck:
    """One estimator under one contact model; `mjx_study.gradcheck.check_mean` makes them.

    Attributes:
        contact, stiffness: of the contact model [N/m], 0 for one that is not defined by a stiffness.
        circulation: the integral of its mean against the difference of the cost.
        verdict: "right" within `estimators.mean_check.TOLERANCE`, "biased", or "undecided".
    """

    contact: str
    stiffness: float
    estimator: str
    circulation: Circulation
    verdict: str

    def as_dict(self) -> dict[str, Any]:
        """As plain data; the gap and its 99.9 % interval as shares of the difference too."""
        numbers = {name: float(value) for name, value in vars(self.circulation).items()}
        numbers |= {"half_width": float(self.circulation.half_width)}
        scale = abs(numbers["difference"]) or math.nan
        numbers |= {"relative_gap": numbers["gap"] / scale, "detectable": 2 * numbers["half_width"] / scale}
        finite = {name: value if math.isfinite(value) else None for name, value in numbers.items()}
        named = {"contact": self.contact, "stiffness": self.stiffness, "estimator": self.estimator}
        return named | finite | {"verdict": self.verdict}


def reach_of(task: Task) -> float:
    """Half the length of a path through a task's theta, unless it is given [unit of theta]."""
    return HALF_LENGTH * task.sigma if task.policy.additive else FEEDBACK


def check_mean(
    task: Task,
    cells: Sequence[ContactPoint],
    estimators: Sequence[Estimator],
    *,
    samples: int,
    seed: int,
    span: Sequence[float] | None = None,
    direction: str = "random",
    tolerance: float = TOLERANCE,
    progress: Progress = lambda done, total, what: None,
) -> list[MeanCheck]:
    """Check every estimator under every contact model.

    Args:
        task: at the theta that the path goes through, with its onset treatment.
        samples: at each of the path's nodes.
        seed: of the samples and of a random direction.
        span: ends of the path, from theta along the direction [unit of theta]; None for two standard deviations of the
            noise to either side, or 0.02 where the noise is on the controls.
        direction: "random", or the index of a parameter.
        tolerance: share of the cost's difference within which a mean is right.

    Raises:
        ValueError: an estimator's formula does not hold for the task, or there is no such direction.
    """
    check_estimators(estimators, task)
    check_span(span)
    low, high = (-reach_of(task), reach_of(task)) if span is None else span
    along = jnp.asarray(direction_of(direction, task.policy.num_params, seed), task.theta.dtype)
    simulator = Simulator(task, chunk_size=chunk_for(samples, jax.local_devices()))
    found, total, ends = [], len(cells), (task.theta + low * along, task.theta + high * along)
    for index, cell in enumerate(cells):
        progress(index, total, cell.label)
        objective, key = simulator.objective(cell.contact), jax.random.key(seed)
        numbers = circulations(estimators, objective, *ends, key, samples)
        found += [
            MeanCheck(cell.family, cell.stiffness or 0.0, estimator.name, each, each.verdict(tolerance))
            for estimator, each in zip(estimators, numbers, strict=True)
        ]
    progress(total, total, "done")
    return found


def lines_of(checks: Sequence[MeanCheck]) -> list[str]:
    rows = []
    for check in checks:
        told = check.as_dict()
        numbers = [told[name] for name in ("difference", "gap", "half_width", "quadrature")]
        shown = ["-" if value is None else f"{value:.3g}" for value in numbers]
        shares = ["-" if told[name] is None else f"{told[name]:.1%}" for name in ("relative_gap", "detectable")]
        stiffness = f"{check.stiffness:g}" if check.stiffness else "-"
        rows.append([check.contact, stiffness, check.estimator, *shown, *shares, check.verdict])
    return format_table(rows, list(HEADER))
