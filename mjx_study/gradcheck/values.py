"""Compare the steps of this project, `mjx.step` and the C engine; if they differ, report which, where and why."""

import dataclasses
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.gradcheck.coordinates import Coordinates, quaternions
from mjx_study.gradcheck.engine_difference import TOLERANCE, difference_of_engines, largest
from mjx_study.gradcheck.engine_step import EngineStep, tangent_of
from mjx_study.simulation.engine import HostState

ROUNDING: Final = 1e-14
MIN_TURNING: Final = 1e-8
"""Angular velocity [rad/s] below which, in every component, MJX treats the step of an orientation as zero."""


@dataclasses.dataclass(frozen=True)
class Values:
    """Differences between the states after one step, all solved to rounding, relative to the step's change.

    Attributes:
        stock, engine: difference of this project's state from that of `mjx.step`, and from the C engine's.
        verdict: value (this project and `mjx.step` differ), engine (they agree, and the C engine differs for no
            documented reason), engine_mismatch (for a documented reason), or None.
        coordinate: output that differs most, an index into the layout's outputs.
        numbers: change of this coordinate in this project and in the differing implementation.
    """

    stock: float
    engine: float
    verdict: str | None = None
    cause: str = ""
    coordinate: int = 0
    numbers: tuple[float, float] = (0.0, 0.0)

    @property
    def agrees_with_engine(self) -> bool:
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
        ours, stock: next states of this project and `mjx.step`, with the step's acceleration as warm start.
        noise: rounding noise of each output; at rest, all of its change.
    """
    theirs = engine_step.after(state)
    gaps = [_apart(layout, state, ours, other, noise) for other in (stock, theirs)]
    from_stock, from_engine = (float(gap.max()) for gap in gaps)
    verdict, cause = None, ""
    if not np.all(np.isfinite(ours.warmstart)):
        return Values(from_stock, from_engine)
    if not from_stock <= TOLERANCE:
        verdict = "value"
        if from_engine <= TOLERANCE:
            cause = "mjx.step differs from the step of this project and the C engine"
        else:
            third = "mjx.step" if float(_apart(layout, state, stock, theirs, noise).max()) <= TOLERANCE else "neither"
            cause = f"this project's step is not that of mjx.step; the C engine agrees with {third}"
    elif not from_engine <= TOLERANCE:
        cause, documented = difference_of_engines(engine_step.host, state, stages, ours.warmstart, theirs.warmstart)
        verdict = "engine_mismatch" if documented else "engine"
    gap, other = (gaps[0], stock) if verdict == "value" else (gaps[1], theirs)
    worst = int(np.argmax(np.nan_to_num(gap, nan=np.inf)))
    ours_there, other_there = (float(_change(layout.scene.host, state, after)[worst]) for after in (ours, other))
    return Values(from_stock, from_engine, verdict, cause, worst, (ours_there, other_there))


def _change(host: mujoco.MjModel, before: HostState, after: HostState) -> Float[np.ndarray, " outputs"]:
    """Change of position in the tangent space, velocity and activation."""
    tangent = tangent_of(host, before.qpos, after.qpos)
    return np.concatenate([tangent, after.qvel - before.qvel, after.act - before.act])


def _apart(
    layout: Coordinates,
    before: HostState,
    ours: HostState,
    theirs: HostState,
    noise: Float[np.ndarray, " outputs"] | float,
) -> Float[np.ndarray, " outputs"]:
    """Difference of two next states beyond rounding, relative to the largest velocity, acceleration, activation."""
    host, timestep = layout.scene.host, layout.scene.timestep
    speed, force, activation = (
        max(largest(getattr(ours, name)), largest(getattr(theirs, name))) for name in ("qvel", "warmstart", "act")
    )
    speed = max(speed, timestep * force)
    still = np.zeros(host.nv)  # angular velocities that MJX treats as zero
    for _, _, first in quaternions(host):
        turning = np.abs(ours.qvel[first : first + 3])
        still[first : first + 3] = np.where(turning.max() <= MIN_TURNING, turning, 0.0)
    unseen = (ROUNDING * max(1.0, largest(before.qpos)) + timestep * still, ROUNDING * speed, ROUNDING)
    scales = (timestep * speed, timestep * force, activation)
    parts = np.split(_change(host, theirs, ours), [host.nv, 2 * host.nv])
    gaps = [np.abs(part) - rounding for part, rounding in zip(parts, unseen, strict=True)]
    sizes = [np.full(len(part), max(scale, 1e-10 * timestep)) for part, scale in zip(parts, scales, strict=True)]
    return np.maximum(np.concatenate(gaps) - noise, 0.0) / np.concatenate(sizes)
