"""Where a step is checked: states of a rollout, its start among them, and most of them in contact."""

import dataclasses

import mujoco
import numpy as np

from mjx_study.contact import ContactModel
from mjx_study.engine import HostState, converged_host, host_data, host_state
from mjx_study.scene import Scene

SPEED = 0.1
"""Standard deviation of a sampled start's velocities [m/s or rad/s]: small, but nothing is at rest or at a tie."""
CONTROL = 0.3
"""Of sampled controls, relative to half their range; absolute where they have none."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sample:
    """A state to check.

    Attributes:
        label: in words.
        index: steps since the start of the rollout.
        state: the state and its control.
    """

    label: str
    index: int
    state: HostState


def sample_states(scene: Scene, contact: ContactModel | None, count: int, horizon: int, seed: int) -> list[Sample]:
    """States of a rollout in the C engine.

    The first is the model's own: its first keyframe, or its reference pose at rest; a program's users start there, and
    so do most faults of a derivative. The others come from a rollout with small random velocities and controls, evenly
    spaced over its steps, those with active constraints first.

    Args:
        scene: the scene.
        contact: its contact model, or None.
        count: number of states.
        horizon: steps of the rollout.
        seed: of velocities and controls.
    """
    host = converged_host(scene, contact)
    data = mujoco.MjData(host)
    if host.nkey:
        mujoco.mj_resetDataKeyframe(host, data, 0)
    rest = Sample("start" if data.qvel.any() else "start, at rest", 0, host_state(data))
    random = np.random.default_rng(seed)
    data.qvel[:] += SPEED * random.normal(size=host.nv)
    data.ctrl[:] += _random_controls(host, random)
    if host.na:
        data.act[:] += 0.1 * np.abs(random.normal(size=host.na))
    visited: list[tuple[HostState, int]] = []
    for _ in range(horizon):
        before = host_state(data)
        mujoco.mj_step(host, data)
        if not np.all(np.isfinite(data.qpos)) or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            break
        visited.append((before, int(data.nefc)))
    chosen = choose([active for _, active in visited], count - 1)
    return [rest, *(Sample(f"step {index}", index, visited[index][0]) for index in chosen)]


def choose(active: list[int], count: int) -> list[int]:
    """Indices of `count` steps, evenly spaced over those with active constraints, or over all where there are none."""
    candidates = [index for index, rows in enumerate(active) if rows and index] or list(range(1, len(active)))
    if not candidates or count < 1:
        return []
    picked = np.unique(np.linspace(0, len(candidates) - 1, count + 2)[1:-1].round().astype(int))
    return [candidates[index] for index in picked]


def reached(scene: Scene, contact: ContactModel | None, state: HostState) -> int:
    """Active constraint rows of a state."""
    data = host_data(converged_host(scene, contact), state)
    mujoco.mj_forward(data.model, data)
    return int(data.nefc)


def _random_controls(host: mujoco.MjModel, random: np.random.Generator) -> np.ndarray:
    low, high = host.actuator_ctrlrange.T
    limited = host.actuator_ctrllimited.astype(bool)
    half = np.where(limited, (high - low) / 2, 1.0)
    centre = np.where(limited, (high + low) / 2, 0.0)
    return centre + CONTROL * half * random.uniform(-1, 1, size=host.nu)
