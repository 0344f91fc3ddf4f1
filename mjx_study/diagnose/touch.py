"""Contacts that begin in the zero-noise rollout, and how well a step resolves each."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_study.objective import compiled_rollout
from mjx_study.simulation.contact import stable, stiffness_from_solref
from mjx_study.simulation.engine import engine_model
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Task


@dataclasses.dataclass(frozen=True)
class Touch:
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


def touches_of(task: Task, cell: ContactPoint) -> Iterator[Touch]:
    """Find the contacts that begin in the zero-noise rollout, with the C engine."""
    dtype = task.theta.dtype
    run = compiled_rollout(task)
    states, *_ = run(task.theta, cell.contact, jax.random.key(0), jnp.zeros((), dtype))
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


def touch_of(host: mujoco.MjModel, data: mujoco.MjData, contact: Any, time: float, timestep: float) -> Touch:
    """Describe a contact in the engine's data that has just begun."""
    solref = np.array(contact.solref)
    if solref[0] > 0 and not host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        solref[0] = max(solref[0], 2 * timestep)
    k, b = stiffness_from_solref(solref.tolist(), effective_mass=1.0)
    first, edges = contact.efc_address, 2 * (contact.dim - 1)
    pyramid = contact.dim > 1 and host.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    speed = (
        -float(np.mean(data.efc_vel[first : first + edges] if pyramid else data.efc_vel[first])) if first >= 0 else 0.0
    )
    names = (mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"geom {geom}" for geom in contact.geom)
    return Touch(
        pair=" and ".join(names),
        time=time,
        speed=speed,
        damping=timestep * b,
        stiffness=timestep**2 * k,
        travel=timestep * speed / float(contact.solimp[2]),
        impedance=float(contact.solimp[0]),
        jump=timestep * b * float(contact.solimp[0] / contact.solimp[1]),
        stable=stable(solref.tolist(), timestep),
    )
