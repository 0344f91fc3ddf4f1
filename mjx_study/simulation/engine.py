"""MuJoCo's C engine as an independent implementation: models and states on the host."""

import contextlib
import copy
import dataclasses
from collections.abc import Generator
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.simulation.contact import ContactModel, apply_to_host
from mjx_study.simulation.scene import Scene

CONVERGED: Final = {"tolerance": 0.0, "iterations": 200, "ls_iterations": 100}


@dataclasses.dataclass(frozen=True, eq=False)
class HostState:
    """State and control on the host, in the units of `dynamics.State`."""

    qpos: Float[np.ndarray, " nq"]
    qvel: Float[np.ndarray, " nv"]
    act: Float[np.ndarray, " na"]
    control: Float[np.ndarray, " nu"]
    warmstart: Float[np.ndarray, " nv"]


def engine_model(scene: Scene, contact: ContactModel | None) -> mujoco.MjModel:
    """Copy the scene's host model with a contact model and the scene's own budgets."""
    host = copy.copy(scene.host)
    apply_to_host(host, contact)
    return host


def converged_host(scene: Scene, contact: ContactModel | None) -> mujoco.MjModel:
    """Copy the scene's host model with a contact model and with budgets for full convergence."""
    host = engine_model(scene, contact)
    for name, value in CONVERGED.items():
        setattr(host.opt, name, value)
    return host


def host_data(host: mujoco.MjModel, state: HostState) -> mujoco.MjData:
    data = mujoco.MjData(host)
    data.qpos[:], data.qvel[:], data.act[:] = state.qpos, state.qvel, state.act
    data.ctrl[:], data.qacc_warmstart[:] = state.control, state.warmstart
    return data


def host_state(data: mujoco.MjData) -> HostState:
    fields: tuple[Any, ...] = (data.qpos, data.qvel, data.act, data.ctrl, data.qacc_warmstart)
    return HostState(*(np.array(field) for field in fields))


def approach_speed(data: mujoco.MjData, contact: Any) -> float:
    """Speed at which a contact in the engine's data closes along its normal [m/s]; 0 without constraint rows."""
    if contact.efc_address < 0:
        return 0.0
    pyramid = contact.dim > 1 and data.model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    rows = 2 * (contact.dim - 1) if pyramid else 1
    return -float(np.mean(data.efc_vel[contact.efc_address : contact.efc_address + rows]))


@contextlib.contextmanager
def quiet_engine() -> Generator[None]:
    """Keep the engine's warnings in `MjData.warning`, off standard error and out of MUJOCO_LOG.TXT."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
