"""Claims about a robot that lands on two legs: hundreds of weights, several joints and contacts."""

import dataclasses
from functools import cache
from typing import Final

import jax
import jax.numpy as jnp

import estimators
from estimators import FirstOrder, GradientEstimate, ZerothOrder, make_estimator
from estimators.mean_check import TOLERANCE, Circulation, circulations
from mjx_study.claims.laboratory import Laboratory, Statistic, difference_of, log_variance
from mjx_study.claims.ledger import Claim, above, below, within
from mjx_study.claims.theory import FACTOR

ROBOT: Final = "landing"
REACH: Final = 0.02
"""Half the length of a path in the space of weights."""
NODES: Final = 3
"""Of the quadrature along it."""


def drawn(lab: Laboratory, system: str, family: str) -> list[GradientEstimate]:
    """First and zeroth order where the task starts, from shared samples."""
    objective, theta = lab.objective(system, family, lab.task(system).defaults.middle_stiffness), lab.task(system).theta
    chosen = (FirstOrder(), ZerothOrder())
    batches = estimators.draw(
        estimators.oracles_of(chosen), objective, theta, jax.random.key(0), 2 * lab.effort.samples
    )
    return [estimator(batches) for estimator in chosen]


def variances(lab: Laboratory, system: str, family: str) -> Statistic:
    """log10 of FoBG's variance over ZoBG's."""
    first, zeroth = map(log_variance, drawn(lab, system, family))
    return difference_of(first, zeroth)


@cache
def checked(lab: Laboratory, system: str, family: str) -> list[Circulation]:
    """Means without and with the onset term, integrated along the first, against the difference of the mean cost."""
    theta = lab.task(system).theta
    mean = drawn(lab, system, family)[0].mean
    along = REACH * mean / jnp.linalg.norm(mean)
    objective = lab.objective(system, family, lab.task(system).defaults.middle_stiffness)
    chosen, samples = [FirstOrder(), make_estimator("fobg_onset")], 4 * lab.effort.samples
    return circulations(chosen, objective, theta - along, theta + along, jax.random.key(1), samples, nodes=NODES)


def _share(lab: Laboratory, found: Circulation) -> Statistic:
    """The gap as a share of the difference."""
    gap, error, slack, difference = map(float, (found.gap, found.standard_error, found.quadrature, found.difference))
    samples = 4 * lab.effort.samples
    freedom = max(float(found.effective) - 1, 2.0)
    return Statistic(gap / difference, error / abs(difference), freedom, slack / abs(difference), samples, "samples")


def off(lab: Laboratory, system: str, family: str) -> Statistic:
    """By how much plain first order misses the change of the mean cost."""
    found = _share(lab, checked(lab, system, family)[0])
    return dataclasses.replace(found, estimate=abs(found.estimate))


def cured(lab: Laboratory, system: str, family: str) -> Statistic:
    """By how much first order with the onset term misses it."""
    return _share(lab, checked(lab, system, family)[1])


GAP: Final = "integral of E[FoBG] along a path less the mean cost's difference, over that"
CLAIMS: Final = (
    Claim(
        "robot-favours-fobg",
        "this project",
        "Of a neural network that lands a robot on two legs, the first-order estimate has the lower variance.",
        below("log10 Var[FoBG] / Var[ZoBG]", -FACTOR, FACTOR),
        {ROBOT: ("penalty", "mujoco_default", "smooth_onset")},
        variances,
        "mjx-study compare landing --contact penalty,mujoco_default,smooth_onset",
    ),
    Claim(
        "robot-onset-bias",
        "this project",
        "Where feet land, first-order gradients are off by more than a twentieth.",
        above(f"size of the {GAP}", TOLERANCE),
        {ROBOT: ("mujoco_default",)},
        off,
        "mjx-study gradcheck landing --mean --contact mujoco_default --direction means --estimators fobg",
    ),
    Claim(
        "robot-onset-cure",
        "this project",
        "There, too, the onset term makes first order unbiased.",
        within(f"{GAP}, with the onset term", -TOLERANCE, TOLERANCE),
        {ROBOT: ("mujoco_default",)},
        cured,
        "mjx-study gradcheck landing --mean --contact mujoco_default --direction means --estimators fobg_onset",
    ),
)
