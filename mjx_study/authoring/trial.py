"""Test rollouts of a model in MuJoCo's C engine: where its bodies go, and what they touch."""

import copy
import dataclasses
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.limits import LARGEST_COORDINATE
from mjx_study.simulation.engine import approach_speed, quiet_engine

SECONDS: Final = 2.0  # longest test rollout [s]
MOST_TRIED: Final = 2000  # maximum number of steps of a test rollout


@dataclasses.dataclass(frozen=True, eq=False)
class Drive:
    """What a policy acts by: controls, or increments of the initial velocity if there are no actuators.

    Attributes:
        neutral: controls without a policy.
        scale, meaning: standard deviation of the noise, in the unit of what it is added to, and in words.
    """

    host: mujoco.MjModel
    neutral: Float[np.ndarray, " nu"]
    scale: float
    meaning: str

    @property
    def size(self) -> int:
        return self.host.nu or self.host.nv

    @property
    def at_start(self) -> bool:
        return self.host.nu == 0


@dataclasses.dataclass
class Touch:
    """A pair of geoms in contact during a rollout: step of the first touch, approach speed then [m/s], greatest
    penetration [m]; and of several rollouts, the share in which they touch."""

    first: int
    speed: float
    depth: float = 0.0
    share: float = 1.0


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """One test rollout: centres of mass of all bodies [m] and positions, the initial ones included; contacts, by pairs
    of geoms; and joints that reached a limit."""

    centres: Float[np.ndarray, "states nbody 3"]
    qpos: Float[np.ndarray, "states nq"]
    touches: dict[tuple[int, int], Touch]
    limits: frozenset[int]

    @property
    def steps(self) -> int:
        """Number of steps until a state was not finite."""
        return len(self.qpos) - 1


def start_of(host: mujoco.MjModel) -> mujoco.MjData:
    """The first keyframe at time 0, or else the reference pose at rest."""
    data = mujoco.MjData(host)
    if host.nkey:
        data.qpos[:], data.qvel[:], data.act[:] = host.key_qpos[0], host.key_qvel[0], host.key_act[0]
    mujoco.mj_forward(host, data)
    return data


def moments_of(data: mujoco.MjData) -> Float[np.ndarray, "nu nv"]:
    """Moment arms of the actuators about the degrees of freedom."""
    moments = np.zeros((data.model.nu, data.model.nv))
    mujoco.mju_sparse2dense(moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    return moments


def run_trial(drive: Drive, change: Float[np.ndarray, "rows size"], steps: int) -> Trial:
    """Roll out with a change of the neutral controls in every step, or of the initial velocity (one row)."""
    host = copy.copy(drive.host)
    host.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    data = start_of(host)
    if drive.at_start:
        data.qvel += change[0]
    mujoco.mj_forward(host, data)
    centres, qpos, touches, limits = [data.xipos.copy()], [data.qpos.copy()], {}, set()
    with quiet_engine():
        for step in range(steps):
            data.ctrl[:] = drive.neutral if drive.at_start else drive.neutral + change[step % len(change)]
            mujoco.mj_step(host, data)
            _note(data, step, touches, limits)
            mujoco.mj_kinematics(host, data)
            if not (np.abs([*data.qpos, *data.qvel]) < LARGEST_COORDINATE).all():
                break
            centres.append(data.xipos.copy())
            qpos.append(data.qpos.copy())
    return Trial(np.array(centres), np.array(qpos), touches, frozenset(limits))


def _note(data: mujoco.MjData, step: int, touches: dict[tuple[int, int], Touch], limits: set[int]) -> None:
    contacts = data.contact
    for index in np.flatnonzero(contacts.efc_address >= 0).tolist():
        first, second = sorted(contacts.geom[index].tolist())
        if (first, second) not in touches:
            touches[first, second] = Touch(step, approach_speed(data, contacts[index]))
        touches[first, second].depth = max(touches[first, second].depth, -float(contacts.dist[index]))
    limited = data.efc_type[: data.nefc] == int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)
    limits.update(data.efc_id[: data.nefc][limited].tolist())
