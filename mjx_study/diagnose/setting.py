"""The setting for which a diagnosis holds: the noise, what it is added to, and the rollout with its contacts."""

import dataclasses
import math
from collections.abc import Iterator
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.choices import is_file
from mjx_study.objective import compiled_rollout
from mjx_study.simulation.contact import has_mujoco_law, stable, stiffness_from_solref
from mjx_study.simulation.contact_pair import geom_label
from mjx_study.simulation.engine import approach_speed, engine_model
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Task

EVENTS: Final = 50  # number of rollouts with noise in which contacts are counted under a law other than MuJoCo's
FASTEST: Final = 10.0  # closing speed up to which contacts are found under a law that acts before touch [m/s]
FOREIGN: Final = {"damping": None, "stiffness": None, "travel": None, "impedance": None, "jump": 0.0, "stable": True}
"""What a contact under a law other than MuJoCo's has in place of MuJoCo's numbers."""
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
    """A contact that begins in a rollout, and how well a step resolves it; None where the law is not MuJoCo's.

    Attributes:
        speed: approach speed [m/s]; not positive for a contact that begins without approach.
        distance: distance [m] at which it begins; negative where the bodies overlap.
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
    distance: float
    damping: float | None
    stiffness: float | None
    travel: float | None
    impedance: float | None
    jump: float
    stable: bool


def lead_of(task: Task, cell: ContactPoint) -> float:
    """Time before touch from which the contact model's law acts [s]."""
    contact = cell.contact
    if contact is None or contact.law is None:
        return 0.0
    timestep = task.scene.timestep
    solref = _used(task.scene.host, np.array(contact.solref), timestep)
    return contact.law.lead(tuple(solref.tolist()), float(contact.solimp[1]), timestep)


def events_of(task: Task, cell: ContactPoint, samples: int, seed: int) -> dict[str, float]:
    """Contacts that begin in a batch with noise, and the standard deviation of the step at which the first does, from
    up to `EVENTS` rollouts of their own; those of `ONSETS` that do not need MuJoCo's law."""
    keys = jax.random.split(jax.random.key(seed), min(EVENTS, samples))
    found = [[each.time for each in touches_of(task, cell, key, 1.0)] for key in keys]
    first = [min(times) / task.scene.timestep for times in found if times]
    share = samples / len(found)
    return {"onsets": share * sum(map(len, found)), "onset_spread": float(np.std(first)) if first else math.nan}


def touches_of(task: Task, cell: ContactPoint, key: Any = None, noise_scale: float = 0.0) -> Iterator[ContactSummary]:
    """Find the contacts that begin in a rollout, by default without noise, with the C engine; under a law that acts
    before touch, where it begins to act."""
    scale, key = jnp.full((), noise_scale, task.theta.dtype), jax.random.key(0) if key is None else key
    states, *_ = compiled_rollout(task)(task.theta, cell.contact, key, scale)
    host, timestep, lead = engine_model(task.scene, cell.contact), task.scene.timestep, lead_of(task, cell)
    farthest, before = FASTEST * lead, None
    host.geom_margin += farthest / 2  # MuJoCo adds those of two geoms
    host.pair_margin += farthest
    data = mujoco.MjData(host)
    for index, (qpos, qvel) in enumerate(zip(np.asarray(states.qpos), np.asarray(states.qvel), strict=True)):
        if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
            return
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_fwdPosition(host, data)
        mujoco.mj_fwdVelocity(host, data)
        contacts = data.contact
        acting = np.flatnonzero(contacts.dist + lead * _fastest(host, data) < contacts.includemargin - farthest)
        now = {tuple(contacts.geom[each].tolist()): contacts[int(each)] for each in acting}
        for pair in now.keys() - (now.keys() if before is None else before):
            found = touch_of(host, data, now[pair], index * timestep, timestep)
            yield found if has_mujoco_law(cell.contact) else dataclasses.replace(found, **FOREIGN)
        before = now.keys()


def _fastest(host: mujoco.MjModel, data: mujoco.MjData) -> Float[np.ndarray, " contacts"]:
    """Velocity of each contact along the edge of its cone that closes fastest [m/s]; 0 without rows."""
    first = data.contact.efc_address
    found, given = np.zeros(len(first)), first >= 0
    if given.any():
        elliptic = host.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
        velocity = np.array(data.efc_vel)  # contacts have its last rows
        found[given] = velocity[first[given]] if elliptic else np.minimum.reduceat(velocity, first[given])
    return found


def _used(host: mujoco.MjModel, solref: Float[np.ndarray, "2"], timestep: float) -> Float[np.ndarray, "2"]:
    """A solref with the time constant that MuJoCo uses in place of one too short."""
    if solref[0] > 0 and not host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        solref[0] = max(solref[0], 2 * timestep)
    return solref


def touch_of(host: mujoco.MjModel, data: mujoco.MjData, contact: Any, time: float, timestep: float) -> ContactSummary:
    """Describe a contact in the engine's data that has just begun."""
    solref = _used(host, np.array(contact.solref), timestep)
    k, b = stiffness_from_solref(solref.tolist(), effective_mass=1.0)
    speed = approach_speed(data, contact)
    return ContactSummary(
        pair=" and ".join(geom_label(host, int(geom)) for geom in contact.geom),
        time=time,
        speed=speed,
        distance=float(contact.dist),
        damping=timestep * b,
        stiffness=timestep**2 * k,
        travel=timestep * speed / max(float(contact.solimp[2]), mujoco.mjMINVAL),
        impedance=float(contact.solimp[0]),
        jump=timestep * b * float(contact.solimp[0] / max(contact.solimp[1], mujoco.mjMINIMP)),
        stable=stable(solref.tolist(), timestep),
    )
