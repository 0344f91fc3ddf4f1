"""Contacts whose points are placed along a vanishing direction, in C and in MJX.

The step jumps there, and nearby it changes faster than differences can resolve.
"""

import dataclasses
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Bool, Int

from mjx_study.gradcheck.coordinates import LENGTH, Coordinate, Coordinates, geom_label
from mjx_study.simulation.engine import HostState, host_data

PARALLEL: Final = 1e-5
"""Angle [rad] or distance [m] below which directions or points coincide; contact points turn within less."""
_PLANE, _SPHERE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CAPSULE, _CYLINDER = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER)


@dataclasses.dataclass(frozen=True)
class DegenerateContact:
    """A degenerate contact, and the Jacobian entries it can excuse.

    Attributes:
        movers: joints that move one of its bodies; the step jumps only in their positions.
        moved: joints of the same kinematic trees, accelerated by its force.
    """

    cause: str
    movers: frozenset[int]
    moved: frozenset[int]

    def concerns(self, output: Coordinate, source: Coordinate) -> bool:
        """Whether the contact's direction affects this entry."""
        return source.block in ("qpos", LENGTH) and source.joint in self.movers and output.joint in self.moved

    def entries(self, layout: Coordinates) -> Bool[np.ndarray, "outputs inputs"]:
        """Mask of all entries that the contact's direction affects."""
        return np.array([[self.concerns(output, source) for source in layout.inputs] for output in layout.outputs])


def degenerate_contacts(
    host: mujoco.MjModel, state: HostState, touching: Int[np.ndarray, "contacts 2"]
) -> list[DegenerateContact]:
    if not len(touching):
        return []
    data = host_data(host, state)
    mujoco.mj_kinematics(host, data)
    found = {tuple(map(int, pair)): _cause(host, data, tuple(map(int, pair))) for pair in touching}
    return [_contact(host, pair, cause) for pair, cause in found.items() if cause]


def _cause(host: mujoco.MjModel, data: mujoco.MjData, geoms: tuple[int, ...]) -> str | None:
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


def _contact(host: mujoco.MjModel, geoms: tuple[int, ...], cause: str) -> DegenerateContact:
    bodies = [int(host.geom_bodyid[geom]) for geom in geoms]
    ancestors = {body for each in bodies for body in _ancestors(host, each)}
    roots = {int(host.body_rootid[body]) for body in bodies} - {0}
    joint_bodies = host.jnt_bodyid.tolist()
    movers = frozenset(joint for joint, body in enumerate(joint_bodies) if body in ancestors)
    moved = frozenset(joint for joint, body in enumerate(joint_bodies) if int(host.body_rootid[body]) in roots)
    return DegenerateContact(cause, movers, moved)


def _ancestors(host: mujoco.MjModel, body: int) -> list[int]:
    """A body and its ancestors, except the world."""
    chain = []
    while body:
        chain.append(body)
        body = int(host.body_parentid[body])
    return chain
