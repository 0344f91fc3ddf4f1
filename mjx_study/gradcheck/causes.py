"""Infer the likely cause of a finding, in one sentence, from the model and the state."""

import dataclasses
from collections.abc import Callable
from functools import cached_property
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.gradcheck.coordinates import Coordinate, Coordinates, geom_label, joint_name, quaternions
from mjx_study.gradcheck.degenerate import DegenerateContact, degenerate_contacts
from mjx_study.simulation.engine import HostState
from mjx_study.simulation.scene import num_constraint_rows

NEAR: Final = 2e-6
"""Distance below which a switch counts as the cause; about the smallest difference step [m, rad, relative]."""
UNKNOWN: Final = "unknown"
_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
SINGULAR: Final = "the inertia matrix is singular (a body lacks mass, or joints are redundant)"


@dataclasses.dataclass(frozen=True, eq=False)
class Place:
    """Where a finding occurs.

    Attributes:
        layout: the scene and the names of its coordinates.
        stages: MJX's intermediate quantities at the state.
        qacc: MJX's constrained acceleration.
        solref: solref of all geoms with the contact model applied, (geoms, 2).
        solimp: solimp of all geoms, (geoms, 5).
    """

    layout: Coordinates
    state: HostState
    stages: dict[str, Any]
    qacc: Float[np.ndarray, " nv"]
    solref: Float[np.ndarray, "geoms 2"]
    solimp: Float[np.ndarray, "geoms 5"]

    @property
    def host(self) -> mujoco.MjModel:
        return self.layout.scene.host

    @cached_property
    def degenerate(self) -> list[DegenerateContact]:
        """Contacts placed along a vanishing direction."""
        return degenerate_contacts(self.host, self.state, self.stages["geom"][self.touching()])

    def touching(self) -> np.ndarray:
        return np.flatnonzero(self.stages["dist"] < self.stages["margin"])


Rule = Callable[[Place, Coordinate, Coordinate], str | None]


def cause_of_fault(place: Place, output: Coordinate, source: Coordinate, *, stock: bool = False) -> str:
    """Return the likely reason why a derivative is wrong, zero or NaN."""
    rules = [*_FAULTS, _unrolled_solver] if stock else _FAULTS
    return next((text for rule in rules if (text := rule(place, output, source))), UNKNOWN)


def cause_of_kink(place: Place, output: Coordinate, source: Coordinate) -> str:
    """Return the switch that makes the step nonsmooth."""
    rules = (_control_bound, _parameter_bound, _onset, _limit, _row_switch, _friction_loss, _muscle, _degenerate)
    if output.block == "act":  # unaffected by contacts
        rules = (_control_bound, _muscle)
    found = next((text for rule in rules if (text := rule(place, output, source))), None)
    return found or "a clip, a maximum or a choice between features switches here"


def singular(place: Place) -> bool:
    inertia = place.stages["qM"]
    return not np.all(np.isfinite(inertia)) or bool(np.linalg.cond(inertia) > 1e12)


def _no_step(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    if singular(place):
        return SINGULAR
    return None if np.all(np.isfinite(place.qacc)) else "the step itself is not finite"


def _resting_quaternion(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    host = place.host
    if source.block != "qvel" or source.joint < 0 or "rotation" not in source.name:
        return None
    first = int(host.jnt_dofadr[source.joint]) + 3 * (host.jnt_type[source.joint] == mujoco.mjtJoint.mjJNT_FREE)
    if output.block == "qpos" and output.joint == source.joint and not place.state.qvel[first : first + 3].any():
        return (
            "MJX integrates a quaternion through the norm of its angular velocity and takes that norm's derivative as "
            "zero at rest"
        )
    return None


def _resting_spring(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    host, joint = place.host, source.joint
    adresses = dict(quaternions(host))
    if source.block != "qpos" or joint not in adresses or not host.jnt_stiffness[joint] > 0:
        return None
    span = slice(adresses[joint], adresses[joint] + 4)
    if abs(abs(float(place.state.qpos[span] @ host.qpos_spring[span])) - 1) < 1e-14:
        return (
            f"the spring of {joint_name(host, joint)} at its reference orientation: MJX's difference of quaternions "
            "has derivative zero at a zero angle"
        )
    return None


def _undamped_solref(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    direct = (place.solref[:, 0] <= 0) & (place.solref[:, 1] == 0)
    if source.name.startswith("solref") and direct.any():
        return "solref (-k, 0): MJX divides by the square of the damping ratio, here 0, in the branch it does not take"
    return None


def _power(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    depth = (place.stages["margin"] - place.stages["dist"])[place.touching()] if len(place.stages["dist"]) else []
    beyond = np.size(depth) and np.max(depth) > place.solimp[:, 2].min()
    whole = np.all(place.solimp[:, 4] == np.round(place.solimp[:, 4]))
    if source.name == "solimp[power]" and beyond:
        return "penetration beyond solimp's width: MJX takes the logarithm of 1 - |r| / width, which is negative there"
    return None if whole else "a non-integer power in solimp: MJX raises a negative number to it"


def _wrapped_tendon(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    kinds = [int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER)]
    wraps = np.isin(place.host.wrap_type, kinds).any()
    return "a tendon that wraps around a geom" if wraps else None


def _zero_length(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    lengths, kinds = place.stages["ten_length"], place.host.wrap_type[place.host.tendon_adr]
    fixed = int(mujoco.mjtWrap.mjWRAP_JOINT)
    if np.any((lengths < mujoco.mjMINVAL) & (kinds != fixed)):
        return "a spatial tendon of zero length: the direction of its pull has no derivative"
    return None


def _tendon_clamp(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    clamped = place.host.tendon_actfrclimited.any() and source.block in ("ctrl", "act", "qpos", "qvel")
    return (
        "a tendon's limited actuator force is zero, and MJX divides by it in the branch it does not take"
        if (clamped and np.any(place.stages["qfrc_actuator"] == 0))
        else None
    )


def _cone(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    elliptic = place.host.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    still = elliptic and len(place.touching()) and not place.state.qvel.any()
    return "the elliptic cone at zero tangential velocity" if still else None


def _unrolled_solver(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    if num_constraint_rows(place.layout.scene.template) and output.block != "act":
        return "mjx.step differentiates the iterations of its solver and line search, not the solution they approach"
    return None


_FAULTS: tuple[Rule, ...] = (
    _no_step,
    _resting_quaternion,
    _resting_spring,
    _undamped_solref,
    _power,
    _zero_length,
    _wrapped_tendon,
    _tendon_clamp,
    _cone,
)


def _degenerate(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    return next((each.cause for each in place.degenerate if each.concerns(output, source)), None)


def _onset(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    gap = place.stages["dist"] - place.stages["margin"]
    near = np.flatnonzero(np.abs(gap) < NEAR)
    if not len(near):
        return None
    pair = " and ".join(geom_label(place.host, int(geom)) for geom in place.stages["geom"][near[0]])
    return f"contact of {pair} is at its onset ({abs(gap[near[0]]):.1e} m away)"


def _limit(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    host = place.host
    for joint in np.flatnonzero(host.jnt_limited):
        if host.jnt_type[joint] in (_SLIDE, _HINGE):
            low, high = host.jnt_range[joint]
            position = place.state.qpos[host.jnt_qposadr[joint]]
            margin = host.jnt_margin[joint]
            if min(abs(position - low - margin), abs(high - position - margin)) < NEAR:
                return f"{joint_name(host, int(joint))} is at its limit"
    lengths = place.stages["ten_length"]
    for tendon in np.flatnonzero(host.tendon_limited):
        if np.abs(lengths[tendon] - host.tendon_range[tendon]).min() < NEAR:
            return "a tendon is at its limit"
    return None


def _row_switch(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    stages = place.stages
    slack = stages["efc_J"] @ place.qacc - stages["efc_aref"]
    active = np.abs(stages["efc_J"]).max(axis=1, initial=0.0) > 0
    size = np.abs(stages["efc_aref"]) + np.abs(stages["efc_J"]) @ np.abs(place.qacc)
    if np.any(active & (np.abs(slack) <= 1e-5 * np.maximum(size, 1e-9))):
        return "a constraint is between pushing and letting go (its force is zero but about to act)"
    return None


def _friction_loss(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    stages = place.stages
    slack = stages["efc_J"] @ place.qacc - stages["efc_aref"]
    loss = stages["efc_frictionloss"]
    gap = np.abs(np.abs(stages["efc_D"] * slack) - loss)
    return "friction loss is between sticking and sliding" if np.any((loss > 0) & (gap < 1e-4 * loss)) else None


def _control_bound(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    if source.block != "ctrl":
        return None
    column = place.layout.columns("ctrl").index(place.layout.inputs.index(source))
    bounds = place.host.actuator_ctrlrange[column]
    if place.host.actuator_ctrllimited[column] and np.abs(bounds - place.state.control[column]).min() < NEAR:
        return "a control is at the end of its range, where MuJoCo clips it"
    return None


def _parameter_bound(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    low, high = mujoco.mjMINIMP, mujoco.mjMAXIMP
    entry = {"solimp[d_0]": 0, "solimp[d_width]": 1, "solimp[midpoint]": 3}.get(source.name)
    if entry is not None:
        values = place.solimp[:, entry]
        if np.any(np.minimum(np.abs(values - low), np.abs(values - high)) < NEAR):
            return f"{source.name} is at the bound where MuJoCo clips it"
        if entry < 2 and np.any(np.abs(place.solimp[:, 0] - place.solimp[:, 1]) < NEAR):
            return "d_0 equals d_width, and MuJoCo clips the impedance between the two"
    if source.name == "solimp[power]" and np.any(place.solimp[:, 4] == 1):
        return "solimp's power is 1, the smallest that MuJoCo accepts"
    if source.name == "solref[1]" and np.any((place.solref[:, 0] <= 0) & (np.abs(place.solref[:, 1]) < NEAR)):
        return "solref's damping is 0, and MuJoCo interprets a positive number there differently"
    if source.name == "solref[0]" and not place.host.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE:
        if np.any(np.abs(place.solref[:, 0] - 2 * place.host.opt.timestep) < NEAR):
            return "solref's time constant is two timesteps, where MuJoCo clips it"
    if source.block == "contact" and len(np.unique(np.round(place.solimp, 12), axis=0)) > 1:
        return "MuJoCo selects or mixes the parameters of two geoms, which tie here"
    return None


def _muscle(place: Place, output: Coordinate, source: Coordinate) -> str | None:
    muscles = place.host.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE
    return "a muscle's activation or velocity is where its curves change" if np.any(muscles) else None
