"""Finite differences over a ladder of step sizes: the derivative if there is one, else the kind of nonsmoothness.

Central differences of a smooth map converge as the step shrinks, until rounding dominates; the plateau in between is
the derivative, and its flatness the uncertainty. The second difference |f(x + h) - 2 f(x) + f(x - h)| classifies the
rest: it falls like h^2 where the map is smooth, like h at a kink, whose one-sided slopes disagree at every step, and
not at all at a jump; nor does |f(x + h) - f(x - h)|, the only sign of a jump that is odd about x.
"""

import dataclasses
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float

from mjx_study.gradcheck.coordinates import Coordinates

RATIO: Final = 4.0
SIZES: Final = tuple(2.5e-4 / RATIO**power for power in range(8))
"""Step sizes [m, rad, ...], down to 1.5e-8; the finest smooth structure of MuJoCo's contact is 1 mm."""
ROUNDING: Final = 1e-13  # relative rounding noise of a step's output, solved to rounding
EPSILON: Final = 1e-15  # a few rounding errors of a float64
UNSEEN: Final = 1e-13
"""Change of the inputs that no number of a user's depends on, though a few hundred rounding errors of a float64."""
UNSEEN_MOVES: Final = 64
SHAKE: Final = 1e-11
"""Distance by which geoms move where `mjx.step` may jump and symmetry hides it from changes of the inputs [m]."""
SMOOTH, KINK = 1.5, 0.5  # powers of h between which the second difference indicates a kink, whose power is 1


@dataclasses.dataclass(frozen=True)
class Differences:
    """Jacobian by finite differences, with its uncertainty, entry by entry.

    Attributes:
        value: derivative by central differences if there is one, else the mean of the one-sided slopes; NaN where too
            few outputs are finite.
        gap: disagreement of the one-sided slopes at the smallest step not dominated by rounding; at an odd jump, the
            slope of the central difference.
        kink: entries whose one-sided slopes disagree at any step size.
        jump: entries where the map itself jumps.
        nearby: entries with a kink or jump within the larger steps, but not at the state.
        rough: entries where the map is not smooth over the steps taken: any of the three.
    """

    value: Float[np.ndarray, "outputs columns"]
    uncertainty: Float[np.ndarray, "outputs columns"]
    gap: Float[np.ndarray, "outputs columns"]
    kink: Bool[np.ndarray, "outputs columns"]
    jump: Bool[np.ndarray, "outputs columns"]
    nearby: Bool[np.ndarray, "outputs columns"]

    @property
    def rough(self) -> Bool[np.ndarray, "outputs columns"]:
        return self.kink | self.jump | self.nearby

    def jumping(self, outputs: Bool[np.ndarray, " outputs"]) -> "Differences":
        """The same where some outputs jump at the state."""
        rows = np.broadcast_to(outputs[:, None], self.jump.shape)
        return dataclasses.replace(self, jump=self.jump | rows, kink=self.kink & ~rows, nearby=self.nearby & ~rows)


def moves(columns: Float[np.ndarray, "columns inputs"]) -> Float[np.ndarray, "moves inputs"]:
    """All changes at which `take_differences` needs outputs: zero, then every step size forwards and backwards."""
    steps = (np.array(SIZES)[:, None, None] * columns).reshape(-1, columns.shape[1])
    return np.concatenate([np.zeros((1, columns.shape[1])), steps, -steps])


def take_differences(
    outputs: Float[np.ndarray, "moves outputs"], noise_floor: Float[np.ndarray, " outputs"] | float = 0.0
) -> Differences:
    """Differences of the outputs at `moves`, one row per change; the noise floor is in addition to `ROUNDING`.

    Long steps may leave the domain of a function: sizes at which outputs are not finite are not used.
    """
    outputs = np.where(np.isfinite(outputs), outputs, np.nan)
    sizes = np.array(SIZES)[:, None, None]
    here, rest = outputs[0], outputs[1:].reshape(2, len(SIZES), -1, outputs.shape[1])
    above, below = rest
    central = (above - below) / (2 * sizes)
    # one Richardson step cancels the h^2 error
    better = (RATIO**2 * central[1:] - central[:-1]) / (RATIO**2 - 1)
    change = np.abs(np.diff(better, axis=0))
    spread = np.maximum(change[1:], change[:-1])  # agreement of three adjacent sizes
    noise = ROUNDING * np.maximum(np.abs(here), 1e-2) + noise_floor
    spread = np.where(np.isnan(spread), np.inf, spread + noise / sizes[2 : 2 + len(spread)])
    best = np.argmin(spread, axis=0)[None]
    value = np.take_along_axis(better[1:-1], best, axis=0)[0]
    uncertainty = np.take_along_axis(spread, best, axis=0)[0]

    power, gap, here_too = _falloff(np.abs(above - 2 * here + below), noise)
    kink, jump = (power < SMOOTH) & (power >= KINK) & here_too, (power < KINK) & here_too
    # one-sided slopes agree across a jump odd about this point, but the first difference does not fall off
    slope_power, steepness, odd_here = _falloff(np.abs(above - below), noise)
    odd = (slope_power < KINK) & odd_here & ~jump
    kink, jump, gap = kink & ~odd, jump | odd, np.where(odd, steepness, gap)

    # ... and only steps too short to reach it see the derivative
    nearby = (power < SMOOTH) & ~here_too
    value = np.where(nearby, central[-2], value)
    uncertainty = np.where(nearby, np.abs(central[-1] - central[-2]) + noise / SIZES[-1], uncertainty)
    value = np.where(np.isfinite(uncertainty), value, np.nan)
    return Differences(value.T, uncertainty.T, gap.T, kink.T, jump.T, nearby.T)


def _falloff(amount: Float[np.ndarray, "sizes columns outputs"], noise: Float[np.ndarray, "..."]):
    """Power of h with which an amount falls off, the amount over h, and whether its cause is here, not nearby."""
    sizes = np.array(SIZES)[:, None, None]
    loud = amount > 100 * noise
    # the power over the last two ratios unaffected by rounding
    usable = loud[2:] & loud[1:-1] & loud[:-2]
    last = np.where(usable.any(axis=0), len(usable) - 1 - np.argmax(usable[::-1], axis=0), 0)[None]
    with np.errstate(divide="ignore", invalid="ignore"):
        power = np.log(amount[:-2] / amount[2:]) / np.log(RATIO) / 2
    power = np.where(usable.any(axis=0), np.take_along_axis(power, last, axis=0)[0], np.inf)
    over_size = np.take_along_axis(amount[2:] / sizes[2:], last, axis=0)[0]
    over_size = np.where(usable.any(axis=0), over_size, 0.0)
    # an amount that falls off below some size has its kink or jump at that distance, not here
    following = np.take_along_axis(np.concatenate([amount[3:], amount[-1:]]), last, axis=0)[0]
    expected = np.take_along_axis(amount[2:], last, axis=0)[0] * RATIO ** -np.maximum(power, 0.0)
    finest = last[0] >= len(usable) - 2
    here_too = finest | (following > expected / RATIO) | (expected <= 200 * noise)
    return power, over_size, here_too


def unseen_moves(inputs: int) -> Float[np.ndarray, "moves inputs"]:
    """Changes of all inputs at once by up to `UNSEEN`, down to rounding."""
    directions = np.random.default_rng(0).uniform(-1, 1, (UNSEEN_MOVES, inputs))
    return np.geomspace(1e-15, UNSEEN, UNSEEN_MOVES)[:, None] * directions


def unsteady_outputs(
    here: Float[np.ndarray, " outputs"],
    around: Float[np.ndarray, "moves outputs"],
    jacobian: Float[np.ndarray, "outputs inputs"],
    noise_floor: Float[np.ndarray, " outputs"] | float = 0.0,
) -> Float[np.ndarray, " outputs"]:
    """How far outputs jump within changes of `UNSEEN`, where rounding decides; 0 for those that do not."""
    apart = np.abs(around - here).max(axis=0)
    sloped = UNSEEN * np.nan_to_num(np.abs(jacobian), posinf=0.0).sum(axis=1)
    expected = ROUNDING * np.maximum(np.abs(here), 1e-2) + noise_floor + sloped
    return np.where(apart > 1000 * expected, apart, 0.0)


def solution_noise(
    layout: Coordinates, stages: dict[str, Any], qacc: Float[np.ndarray, " nv"]
) -> Float[np.ndarray, " outputs"]:
    """Rounding error of the outputs of a step whose equation M a - q - J^T f(J a) = 0 is solved exactly.

    Each term is rounded by EPSILON of its size, which the inverse of the equation propagates to the acceleration. MJX's
    integrators then compute the velocity from the forces, M^-1 (q + J^T f), where large forces that cancel leave their
    rounding.
    """
    jacobian, timestep = stages["efc_J"], layout.scene.timestep
    weighted = stages["efc_D"][:, None] * np.abs(jacobian)
    size = np.abs(stages["qM"]) @ np.abs(qacc) + np.abs(stages["qM"] @ stages["qacc_smooth"])
    size += weighted.T @ (np.abs(jacobian) @ np.abs(qacc) + np.abs(stages["efc_aref"]))
    matrices = stages["qM"] + jacobian.T @ (stages["efc_D"][:, None] * jacobian), stages["qM"]
    if not all(np.all(np.isfinite(matrix)) and np.linalg.cond(matrix) < 1 / EPSILON for matrix in matrices):
        return np.zeros(len(layout.outputs))
    velocity = timestep * EPSILON * sum(np.abs(np.linalg.inv(matrix)) for matrix in matrices) @ size
    activation = np.zeros(len(layout.outputs) - 2 * len(velocity))
    return np.concatenate([timestep * velocity, velocity, activation])
