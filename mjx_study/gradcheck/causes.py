"""Infer the likely cause of a finding, in one sentence, from the model and the state."""

import dataclasses
from collections.abc import Iterator
from functools import cached_property
from typing import Any, Final

import mujoco
import numpy as np
from jaxtyping import Float, Int

from mjx_study.gradcheck.coordinates import LENGTH, Coordinate, Coordinates, joint_name, joints_above, quaternions
from mjx_study.gradcheck.differences import SHAKE
from mjx_study.simulation.contact_pair import geom_label
from mjx_study.simulation.engine import HostState, host_data
from mjx_study.simulation.scene import num_constraint_rows

NEAR_DISTANCE: Final = 2e-6
"""Distance below which a switch counts as the cause; about the smallest difference step [m, rad, relative]."""
PARALLEL: Final = 1e-5
"""Angle [rad] or distance [m] below which directions or points coincide; contact points turn within less."""
SINGULAR: Final = "the inertia matrix is singular (a body lacks mass, or joints are redundant)"
ROUNDING_DECIDES: Final = (
    f"rounding decides where bodies touch: the step jumps within changes of {SHAKE:g} in its state or geoms"
)
_SLIDE, _HINGE = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
_PLANE, _SPHERE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CAPSULE, _CYLINDER = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)


@dataclasses.dataclass(frozen=True)
class DegenerateContact:
    """A contact whose points are placed along a vanishing direction, in C and in MJX.

    The step jumps there, in the positions of the joints that move one of its bodies (`movers`), and accelerates those
    of the same kinematic trees (`moved`); nearby it changes faster than differences can resolve.
    """

    cause: str
    movers: frozenset[int]
    moved: frozenset[int]

    def concerns(self, output: Coordinate, source: Coordinate) -> bool:
        return source.block in ("qpos", LENGTH) and source.joint in self.movers and output.joint in self.moved


@dataclasses.dataclass(frozen=True, eq=False)
class FindingContext:
    """Where a finding occurs: MJX's intermediate quantities at the state, its constrained acceleration, the parameters
    of all geoms with the contact model applied, and how far outputs jump by rounding."""

    layout: Coordinates
    state: HostState
    stages: dict[str, Any]
    qacc: Float[np.ndarray, " nv"]
    solref: Float[np.ndarray, "geoms 2"]
    solimp: Float[np.ndarray, "geoms 5"]
    unsteady: Float[np.ndarray, " outputs"]

    @property
    def host(self) -> mujoco.MjModel:
        return self.layout.scene.host

    @property
    def singular(self) -> bool:
        inertia = self.stages["qM"]
        return not np.all(np.isfinite(inertia)) or bool(np.linalg.cond(inertia) > 1e12)

    @cached_property
    def touching(self) -> Int[np.ndarray, " contacts"]:
        return np.flatnonzero(self.stages["dist"] < self.stages["margin"])

    @cached_property
    def slack(self) -> Float[np.ndarray, " rows"]:
        """Acceleration of each constraint row beyond its reference."""
        return self.stages["efc_J"] @ self.qacc - self.stages["efc_aref"]

    @cached_property
    def degenerate(self) -> list[DegenerateContact]:
        data = host_data(self.host, self.state)
        mujoco.mj_kinematics(self.host, data)
        pairs = dict.fromkeys(map(tuple, self.stages["geom"][self.touching].tolist()))
        causes = {pair: _why_degenerate(self.host, data, pair) for pair in pairs}
        return [_degenerate(self.host, pair, cause) for pair, cause in causes.items() if cause]


def _why_degenerate(host: mujoco.MjModel, data: mujoco.MjData, geoms: tuple[int, ...]) -> str | None:
    axes, centres = data.geom_xmat.reshape(-1, 3, 3)[:, :, 2], data.geom_xpos
    kinds = {int(host.geom_type[geom]): geom for geom in geoms}
    parallel = float(np.linalg.norm(np.cross(axes[geoms[0]], axes[geoms[1]]))) < PARALLEL
    labels = " and ".join(geom_label(host, geom) for geom in geoms)
    if kinds.keys() == {_SPHERE} and np.linalg.norm(centres[geoms[0]] - centres[geoms[1]]) < PARALLEL:
        return f"the centres of {labels} coincide, so their contact has no normal direction"
    if parallel and kinds.keys() == {_PLANE, _CYLINDER}:
        upright = geom_label(host, kinds[_CYLINDER])
        return f"{upright} stands upright, and its contact points turn with the direction in which it tilts"
    if parallel and kinds.keys() == {_CAPSULE}:
        return f"{labels} are parallel, and where they touch jumps with the direction of their angle"
    return None


def _degenerate(host: mujoco.MjModel, geoms: tuple[int, ...], cause: str) -> DegenerateContact:
    bodies = [int(host.geom_bodyid[geom]) for geom in geoms]
    roots = {int(host.body_rootid[body]) for body in bodies} - {0}
    movers = frozenset().union(*(joints_above(host, body) for body in bodies))
    moved = np.flatnonzero(np.isin(host.body_rootid[host.jnt_bodyid], list(roots)))
    return DegenerateContact(cause, movers, frozenset(moved.tolist()))


def faults(context: FindingContext, output: Coordinate, source: Coordinate, stock: bool) -> Iterator[str]:
    """Reasons why a derivative may be wrong, zero or NaN, the likeliest first."""
    host, state, stages = context.host, context.state, context.stages
    if context.singular:
        yield SINGULAR
    if not np.all(np.isfinite(context.qacc)):
        yield "the step itself is not finite"
    for joint, first, dof in quaternions(host):
        if joint != source.joint:
            continue
        turned = source.block == "qvel" and ", rotation " in source.name
        if turned and output.block == "qpos" and output.joint == joint and not state.qvel[dof : dof + 3].any():
            yield (
                "MJX integrates a quaternion through the norm of its angular velocity and takes that norm's derivative "
                "as zero at rest"
            )
        cosine = float(state.qpos[first : first + 4] @ host.qpos_spring[first : first + 4])
        if source.block == "qpos" and host.jnt_stiffness[joint] > 0 and abs(abs(cosine) - 1) < 1e-14:
            yield (
                f"the spring of {joint_name(host, joint)} at its reference orientation: MJX's difference of "
                "quaternions has derivative zero at a zero angle"
            )
    if source.name.startswith("solref") and np.any((context.solref[:, 0] <= 0) & (context.solref[:, 1] == 0)):
        yield "solref (-k, 0): MJX divides by the square of the damping ratio, here 0, in the branch it does not take"
    depth, power = (stages["margin"] - stages["dist"])[context.touching], context.solimp[:, 4]
    if source.name == "solimp[power]" and np.any(depth > context.solimp[:, 2].min()):
        yield "penetration beyond solimp's width: MJX takes the logarithm of 1 - |r| / width, which is negative there"
    if not np.all(power == np.round(power)):
        yield "a non-integer power in solimp: MJX raises a negative number to it"
    spatial = host.wrap_type[host.tendon_adr] != int(mujoco.mjtWrap.mjWRAP_JOINT)
    if np.any((stages["ten_length"] < mujoco.mjMINVAL) & spatial):
        yield "a spatial tendon of zero length: the direction of its pull has no derivative"
    if np.isin(host.wrap_type, [int(mujoco.mjtWrap.mjWRAP_SPHERE), int(mujoco.mjtWrap.mjWRAP_CYLINDER)]).any():
        yield "a tendon that wraps around a geom"
    clamped = host.tendon_actfrclimited.any() and source.block in ("ctrl", "act", "qpos", "qvel")
    if clamped and np.any(stages["qfrc_actuator"] == 0):
        yield "a tendon's limited actuator force is zero, and MJX divides by it in the branch it does not take"
    if host.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC and len(context.touching) and not state.qvel.any():
        yield "the elliptic cone at zero tangential velocity"
    if stock and num_constraint_rows(context.layout.scene.template) and output.block != "act":
        yield "mjx.step differentiates the iterations of its solver and line search, not the solution they approach"
    yield "cause unknown"


def kinks(context: FindingContext, output: Coordinate, source: Coordinate) -> Iterator[str]:
    """Switches that may make the step nonsmooth, the likeliest first."""
    host = context.host
    if source.block == "ctrl":
        column = context.layout.columns("ctrl").index(context.layout.inputs.index(source))
        reached = np.abs(host.actuator_ctrlrange[column] - context.state.control[column]).min() < NEAR_DISTANCE
        if host.actuator_ctrllimited[column] and reached:
            yield "a control is at the end of its range, where MuJoCo clips it"
    if output.block != "act":  # unaffected by contacts
        yield from _parameter_kinks(context, source)
        yield from _constraint_kinks(context)
    if np.any(host.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE):
        yield "a muscle's activation or velocity is where its curves change"
    yield from (contact.cause for contact in context.degenerate if contact.concerns(output, source))
    if context.unsteady[context.layout.outputs.index(output)]:
        yield ROUNDING_DECIDES
    yield "a clip, a maximum or a choice between features switches here"


def _parameter_kinks(context: FindingContext, source: Coordinate) -> Iterator[str]:
    solref, solimp, option = context.solref, context.solimp, context.host.opt
    entry = {"solimp[d_0]": 0, "solimp[d_width]": 1, "solimp[midpoint]": 3}.get(source.name)
    if entry is not None:
        bounds = np.array([[mujoco.mjMINIMP, mujoco.mjMAXIMP]])
        if np.any(np.abs(solimp[:, [entry]] - bounds) < NEAR_DISTANCE):
            yield f"{source.name} is at the bound where MuJoCo clips it"
        if entry < 2 and np.any(np.abs(solimp[:, 0] - solimp[:, 1]) < NEAR_DISTANCE):
            yield "d_0 equals d_width, and MJX clips the impedance between the two"
    if source.name == "solimp[power]" and np.any(solimp[:, 4] == 1):
        yield "solimp's power is 1, the smallest that MuJoCo accepts"
    if source.name == "solref[1]" and np.any((solref[:, 0] <= 0) & (np.abs(solref[:, 1]) < NEAR_DISTANCE)):
        yield "solref's damping is 0, and MuJoCo interprets a positive number there differently"
    clips = source.name == "solref[0]" and not option.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE
    if clips and np.any(np.abs(solref[:, 0] - 2 * option.timestep) < NEAR_DISTANCE):
        yield "solref's time constant is two timesteps, where MuJoCo clips it"
    if source.block == "contact" and len(np.unique(np.round(solimp, 12), axis=0)) > 1:
        yield "MuJoCo selects or mixes the parameters of two geoms, which tie here"


def _constraint_kinks(context: FindingContext) -> Iterator[str]:
    host, stages = context.host, context.stages
    gap = stages["dist"] - stages["margin"]
    for contact in np.flatnonzero(np.abs(gap) < NEAR_DISTANCE):
        pair = " and ".join(geom_label(host, int(geom)) for geom in stages["geom"][contact])
        yield f"contact of {pair} is at its onset ({abs(gap[contact]):.1e} m away)"
    for joint in np.flatnonzero(host.jnt_limited & np.isin(host.jnt_type, (_SLIDE, _HINGE))):
        (low, high), margin = host.jnt_range[joint], host.jnt_margin[joint]
        position = context.state.qpos[host.jnt_qposadr[joint]]
        if min(abs(position - low - margin), abs(high - position - margin)) < NEAR_DISTANCE:
            yield f"{joint_name(host, int(joint))} is at its limit"
    from_limits = np.abs(stages["ten_length"][:, None] - host.tendon_range).min(axis=1, initial=np.inf)
    if np.any(host.tendon_limited.astype(bool) & (from_limits < NEAR_DISTANCE)):
        yield "a tendon is at its limit"
    rows, reference, loss = np.abs(stages["efc_J"]), np.abs(stages["efc_aref"]), stages["efc_frictionloss"]
    size = reference + rows @ np.abs(context.qacc)
    if np.any((rows.max(axis=1, initial=0.0) > 0) & (np.abs(context.slack) <= 1e-5 * np.maximum(size, 1e-9))):
        yield "a constraint is between pushing and letting go (its force is zero but about to act)"
    if np.any((loss > 0) & (np.abs(np.abs(stages["efc_D"] * context.slack) - loss) < 1e-4 * loss)):
        yield "friction loss is between sticking and sliding"
