"""A claim about a robot landing on two legs: hundreds of weights, several joints and contacts."""

from typing import Final

import jax

import estimators
from estimators import FirstOrder, ZerothOrder
from mjx_study.claims.laboratory import Laboratory, Statistic, difference_of, log_variance
from mjx_study.claims.ledger import Claim, below
from mjx_study.claims.theory import FACTOR

ROBOT: Final = "landing"


def variances(lab: Laboratory, system: str, family: str) -> Statistic:
    """log10 of FoBG's variance over ZoBG's at the task's initial theta, on shared samples."""
    task = lab.task(system)
    objective = lab.objective(system, family, task.defaults.middle_stiffness)
    chosen, samples = (FirstOrder(), ZerothOrder()), 2 * lab.effort.samples
    drawn = estimators.draw(estimators.oracles_of(chosen), objective, task.theta, jax.random.key(0), samples)
    first, zeroth = (log_variance(estimator(drawn)) for estimator in chosen)
    return difference_of(first, zeroth)


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
)
