"""The setting for which a diagnosis holds: the noise, what it is added to, and the rollout with its contacts."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_study.choices import is_file
from mjx_study.objective import compiled_rollout
from mjx_study.simulation.contact import stable, stiffness_from_solref
from mjx_study.simulation.contact_pair import geom_label
from mjx_study.simulation.engine import engine_model
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Task

_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)


@dataclasses.dataclass(frozen=True)
class RolloutSetting:
    """The setting for which a diagnosis holds, with the timestep in seconds; `sigma_unit` is empty if it is not
    known."""

    noise: str
    sigma: float
    sigma_unit: str
    added_to: str
    timestep: float
    horizon: int
    params: int

    @property
    def level(self) -> str:
        return f"sigma = {self.sigma:g} {self.sigma_unit}".rstrip()

    def line(self) -> str:
        unit, plural = "" if self.sigma_unit else " (in its unit)", "" if self.params == 1 else "s"
        noise = f"{self.noise} noise of {self.level}, added to {self.added_to}{unit}"
        return f"{noise}; {self.params} parameter{plural}; {self.horizon} steps of {self.timestep:g} s"


def setting_of(subject: str, task: Task) -> RolloutSetting:
    host = task.scene.host
    if not task.policy.at_start:
        added_to, units = "every control", {_unit_of_control(host, index) for index in range(host.nu)}
    else:
        added_to = "the initial velocities" if is_file(subject) else "theta"
        units = {getattr(task.policy, "unit", "")}
    unit = "" if "" in units else " or ".join(sorted(units))
    return RolloutSetting(
        task.noise, task.sigma, unit, added_to, task.scene.timestep, task.horizon, task.policy.num_params
    )


def _unit_of_control(host: mujoco.MjModel, index: int) -> str:
    """Unit of a motor's or servo's control; empty for other actuators, or if a gain or gear scales it."""
    kind = host.jnt_type[host.actuator_trnid[index, 0]] if host.actuator_trntype[index] == 0 else None
    gain, bias = host.actuator_gainprm[index, 0], host.actuator_biasprm[index, :3].tolist()
    if kind not in (_SLIDE, _HINGE) or host.actuator_gear[index, 0] != 1 or host.actuator_dyntype[index]:
        return ""
    units = {(1.0, 0.0, 0.0): ("N", "N m"), (gain, -gain, bias[2]): ("m", "rad"), (gain, 0.0, -gain): ("m/s", "rad/s")}
    plain = host.actuator_gaintype[index] == 0 and host.actuator_biastype[index] in (0, 1) and bias[0] == 0
    return units.get((gain, *bias[1:]), ("", ""))[int(kind == _HINGE)] if plain else ""


@dataclasses.dataclass(frozen=True)
class ContactSummary:
    """A contact that begins in the zero-noise rollout, and how well a step resolves it.

    Attributes:
        speed: approach speed [m/s]; not positive for a contact that begins without approach.
        damping: h b, at full impedance.
        stiffness: h^2 k, at full impedance.
        travel: h v over the width of the impedance's rise.
        impedance: d_0, at first touch; 0.9 is MuJoCo's default.
        jump: h b d_0 / d_width, the share of the approach speed that the damper takes in the first step.
        stable: whether the step in contact is stable.
    """

    pair: str
    time: float
    speed: float
    damping: float
    stiffness: float
    travel: float
    impedance: float
    jump: float
    stable: bool


def touches_of(task: Task, cell: ContactPoint) -> Iterator[ContactSummary]:
    """Find the contacts that begin in the zero-noise rollout, with the C engine."""
    no_noise = jnp.zeros((), task.theta.dtype)
    states, *_ = compiled_rollout(task)(task.theta, cell.contact, jax.random.key(0), no_noise)
    host = engine_model(task.scene, cell.contact)
    data, timestep, before = mujoco.MjData(host), task.scene.timestep, None
    for index, (qpos, qvel) in enumerate(zip(np.asarray(states.qpos), np.asarray(states.qvel), strict=True)):
        if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
            return
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(host, data)
        now = {tuple(contact.geom): contact for contact in data.contact if contact.dist < contact.includemargin}
        for pair in now.keys() - (now.keys() if before is None else before):
            yield touch_of(host, data, now[pair], index * timestep, timestep)
        before = now.keys()


def touch_of(host: mujoco.MjModel, data: mujoco.MjData, contact: Any, time: float, timestep: float) -> ContactSummary:
    """Describe a contact in the engine's data that has just begun."""
    solref = np.array(contact.solref)
    if solref[0] > 0 and not host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        solref[0] = max(solref[0], 2 * timestep)
    k, b = stiffness_from_solref(solref.tolist(), effective_mass=1.0)
    first, edges = contact.efc_address, 2 * (contact.dim - 1)
    pyramid = contact.dim > 1 and host.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    rows = data.efc_vel[first : first + (edges if pyramid else 1)]
    speed = -float(np.mean(rows)) if first >= 0 else 0.0
    return ContactSummary(
        pair=" and ".join(geom_label(host, int(geom)) for geom in contact.geom),
        time=time,
        speed=speed,
        damping=timestep * b,
        stiffness=timestep**2 * k,
        travel=timestep * speed / float(contact.solimp[2]),
        impedance=float(contact.solimp[0]),
        jump=timestep * b * float(contact.solimp[0] / contact.solimp[1]),
        stable=stable(solref.tolist(), timestep),
    )
