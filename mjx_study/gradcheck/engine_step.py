"""The C engine's step as a map of the same changes as ours: an independent judge of values and derivatives."""

import dataclasses
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.gradcheck.coordinates import PAIR_FRICTION, Coordinates, quaternions
from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.engine import HostState, converged_host, host_data

WARMSTARTS: Final = (0.0, 0.5, 1.001)
"""Alternative warm starts, relative to the solution, whose results differ only by rounding."""
PARAMETERS: Final = ("geom_solref", "geom_solimp", "geom_friction", "pair_solref", "pair_solimp", "pair_friction")


class EngineStep:
    """For one scene, contact model and any integrator, with constraints solved to rounding."""

    def __init__(self, layout: Coordinates, contact: ContactModel | None):
        self.layout = layout
        self.host = converged_host(layout.scene, contact)
        self.host.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._parameters = {name: getattr(self.host, name).copy() for name in PARAMETERS}

    def after(self, base: HostState) -> HostState:
        """Return the state after a step; its warm start is the acceleration at the beginning of the step."""
        data = forward(self.host, base)
        qacc = data.qacc.copy()
        mujoco.mj_step(self.host, data)
        return HostState(data.qpos.copy(), data.qvel.copy(), data.act.copy(), base.control, qacc)

    def outputs(
        self, base: HostState, reference: Float[np.ndarray, " nq"], changes: Float[np.ndarray, "batch inputs"]
    ) -> Float[np.ndarray, "batch outputs"]:
        """Return (position relative to `reference`, velocity, activation) after a step from each changed state."""
        layout, data, rows = self.layout, host_data(self.host, base), []
        for change in changes:
            self._set_state(data, base, change[: layout.num_state])
            self.set_parameters(change[layout.num_state :] * layout.scales)
            mujoco.mj_step(self.host, data)
            rows.append(np.concatenate([tangent_of(self.host, reference, data.qpos), data.qvel, data.act]))
        self.set_parameters(np.zeros(len(layout.scales)))
        return np.array(rows)

    def noise(self, base: HostState, reference: Float[np.ndarray, " nq"]) -> Float[np.ndarray, " outputs"]:
        """Change of the outputs with the solver's warm start, which should not affect them."""
        still = np.zeros((1, len(self.layout.inputs)))
        exact = self.outputs(base, reference, still)
        starts = [dataclasses.replace(base, warmstart=factor * base.warmstart) for factor in WARMSTARTS]
        return np.max([np.abs(self.outputs(start, reference, still) - exact)[0] for start in starts], axis=0)

    def _set_state(self, data: mujoco.MjData, base: HostState, change: Float[np.ndarray, " changes"]) -> None:
        host, lengths = self.host, quaternions(self.host)
        ends = np.cumsum([host.nv, len(lengths), host.nv, host.na]).tolist()
        tangent, stretch, qvel, act, control = np.split(change, ends)
        data.time = 0.0
        data.qpos[:] = base.qpos
        mujoco.mj_integratePos(host, data.qpos, tangent, 1.0)
        for (_, first, _), factor in zip(lengths, stretch, strict=True):
            data.qpos[first : first + 4] *= 1 + factor
        data.qvel[:], data.act[:], data.ctrl[:] = base.qvel + qvel, base.act + act, base.control + control
        data.qacc_warmstart[:] = base.warmstart

    def set_parameters(self, change: Float[np.ndarray, " parameters"]) -> None:
        """Change the contact model of the steps to come, from that of the scene."""
        if not len(change):
            return
        solref, solimp, friction = np.split(change, [2, 7])
        shifts = (solref, solimp, friction, solref, solimp, friction[PAIR_FRICTION])
        for (name, value), shift in zip(self._parameters.items(), shifts, strict=True):
            getattr(self.host, name)[:] = value + shift


def forward(host: mujoco.MjModel, state: HostState) -> mujoco.MjData:
    data = host_data(host, state)
    mujoco.mj_forward(host, data)
    return data


def tangent_of(
    host: mujoco.MjModel, before: Float[np.ndarray, " nq"], after: Float[np.ndarray, " nq"]
) -> Float[np.ndarray, " nv"]:
    tangent = np.empty(host.nv)
    mujoco.mj_differentiatePos(host, tangent, 1.0, before, after)
    return tangent
