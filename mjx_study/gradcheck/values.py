"""Compare the steps of this project, `mjx.step` and the C engine; if they differ, tell which, where and why."""

import dataclasses
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.gradcheck.coordinates import Coordinates, quaternions
from mjx_study.gradcheck.engine_difference import TOLERANCE, difference_of_engines, largest
from mjx_study.gradcheck.engine_step import EngineStep
from mjx_study.simulation.engine import HostState

ROUNDING: Final = 1e-14
STILL: Final = 1e-8
"""Angular velocity [rad/s] below which, in every component, MJX treats the step of an orientation as zero."""


@dataclasses.dataclass(frozen=True)
class Values:
    """Differences between the states after one step, all solved to rounding, relative to the step's change.

    Attributes:
        stock: difference of this project's state from that of `mjx.step`.
        engine: difference of this project's state from the C engine's.
        verdict: value (this project and `mjx.step` differ), engine (they agree, and the C engine differs for no
            documented reason), engine_mismatch (for a documented reason), or empty.
        coordinate: output that differs most, an index into the layout's outputs.
        numbers: change of this coordinate in this project and in the differing implementation.
    """

    stock: float
    engine: float
    verdict: str = ""
    cause: str = ""
    coordinate: int = 0
    numbers: tuple[float, float] = (0.0, 0.0)

    @property
    def agrees_with_engine(self) -> bool:
        """Whether the C engine computes the same step."""
        return self.engine <= TOLERANCE


def compare_values(
    layout: Coordinates,
    engine_step: EngineStep,
    state: HostState,
    ours: HostState,
    stock: HostState,
    stages: dict[str, Any],
    noise: Float[np.ndarray, " outputs"] | float = 0.0,
) -> Values:
    """Compare one step across implementations.

    Args:
        state: state before the step.
        ours: this project's next state; like the others, with the step's acceleration as warm start.
        stock: state after `mjx.step`.
        stages: MJX's intermediate quantities at `state`.
        noise: rounding noise of each output; at rest, all of its change.
    """
    theirs = engine_step.after(state)
    from_stock, from_engine = (float(apart(layout, state, ours, other, noise).max()) for other in (stock, theirs))
    verdict = cause = ""
    if not np.all(np.isfinite(ours.warmstart)):
        return Values(from_stock, from_engine)
    if not from_stock <= TOLERANCE:
        verdict = "value"
        if from_engine <= TOLERANCE:
            cause = "mjx.step differs from the step of this project and the C engine"
        else:
            third = "mjx.step" if float(apart(layout, state, stock, theirs, noise).max()) <= TOLERANCE else "neither"
            cause = f"this project's step is not that of mjx.step; the C engine agrees with {third}"
    elif not from_engine <= TOLERANCE:
        cause, documented = difference_of_engines(engine_step.host, state, stages, ours.warmstart, theirs.warmstart)
        verdict = "engine_mismatch" if documented else "engine"
    other = stock if verdict == "value" else theirs
    worst = int(np.argmax(np.nan_to_num(apart(layout, state, ours, other, noise), nan=np.inf)))
    numbers = (float(change(layout, state, ours)[worst]), float(change(layout, state, other)[worst]))
    return Values(from_stock, from_engine, verdict, cause, worst, numbers)


def change(layout: Coordinates, before: HostState, after: HostState) -> Float[np.ndarray, " outputs"]:
    """Change over a step: position in the tangent space, velocity, activation."""
    tangent = np.empty(layout.scene.host.nv)
    mujoco.mj_differentiatePos(layout.scene.host, tangent, 1.0, before.qpos, after.qpos)
    return np.concatenate([tangent, after.qvel - before.qvel, after.act - before.act])


def apart(
    layout: Coordinates,
    before: HostState,
    ours: HostState,
    theirs: HostState,
    noise: Float[np.ndarray, " outputs"] | float,
) -> Float[np.ndarray, " outputs"]:
    """Difference of two next states beyond rounding, relative to the largest velocity, acceleration, activation."""
    timestep = layout.scene.timestep
    tangent = np.empty(layout.scene.host.nv)
    mujoco.mj_differentiatePos(layout.scene.host, tangent, 1.0, theirs.qpos, ours.qpos)
    speed, force = (
        max(largest(a), largest(b)) for a, b in ((ours.qvel, theirs.qvel), (ours.warmstart, theirs.warmstart))
    )
    speed = max(speed, timestep * force)
    unseen = ROUNDING * max(1.0, largest(before.qpos)) + timestep * _stillness(layout.scene.host, ours.qvel)
    parts = (
        (tangent, unseen, timestep * speed),
        (ours.qvel - theirs.qvel, ROUNDING * speed, timestep * force),
        (ours.act - theirs.act, ROUNDING, max(largest(ours.act), largest(theirs.act))),
    )
    gaps = np.concatenate([np.abs(gap) - unseen for gap, unseen, _ in parts])
    scales = np.concatenate([np.full(len(gap), max(scale, 1e-10 * timestep)) for gap, _, scale in parts])
    return np.maximum(gaps - noise, 0.0) / scales


def _stillness(host: mujoco.MjModel, qvel: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " nv"]:
    """Angular velocities of free and ball joints that MJX treats as zero; 0 elsewhere."""
    still = np.zeros_like(qvel)
    for _, _, first in quaternions(host):
        speeds = np.abs(qvel[first : first + 3])
        still[first : first + 3] = np.where(speeds.max() <= STILL, speeds, 0.0)
    return still
