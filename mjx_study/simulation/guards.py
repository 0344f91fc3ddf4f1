"""Guards of limits and contacts: distances below zero while their constraint rows exist, and rows where one is zero.

A guard is the distance of a limit or contact minus its margin. Where a convex geom meets a plane, MJX reports only
corners that are at most `SKIN` higher than the deepest one: such a corner has a second condition, and its guard is the
larger of the two. At zero of the second, a corner appears or vanishes in penetration.
"""

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import ELLIPTIC, Qvel, Rows, Scalar, row_force
from mjx_study.simulation.patches import AT_FIRST_TOUCH, DAMPER, SPRING, Place, patched
from mjx_study.simulation.scene import num_constraint_rows

SKIN: Final = 1e-3
"""MJX's limit [m] on how much higher than the deepest corner of a convex geom another may be to touch a plane."""
_PLANE: Final = int(mujoco.mjtGeom.mjGEOM_PLANE)
_CONVEX: Final = (int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_MESH))
_EDGED: Final = (*_CONVEX, int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_HFIELD))


class Guards(NamedTuple):
    """Every limit, then every contact.

    Attributes:
        distance: what is below zero while the rows exist [m or rad]; zero or above where they do not.
        weights: combination of constraint rows whose Jacobian is the distance's derivative.
        deep: whether the rows begin or end in penetration, at the limit of the skin.
    """

    distance: Float[Array, " guards"]
    weights: Float[Array, "guards rows"]
    deep: Bool[Array, " guards"]


def num_guards(data: mjx.Data) -> int:
    """Number of limits and contacts."""
    rows: Any = data._impl
    return int(rows.nl) + len(rows.contact.dim)


def guard_rows(model: mjx.Model, data: mjx.Data) -> tuple[np.ndarray, np.ndarray]:
    """Map each guard (limits first, then contacts) to its constraint rows; static, both `(guards, rows)`.

    The weights combine rows into the guard's normal row (the mean of two opposite pyramid edges); the 0/1 mask tells
    the rows that switch on with the guard.
    """
    rows: Any = data._impl
    spans = [(rows.ne + rows.nf + index, 1, 1) for index in range(rows.nl)]
    for condim, address in zip(rows.contact.dim, rows.contact.efc_address, strict=True):
        pyramid = condim > 1 and model.opt.cone != ELLIPTIC
        spans.append((int(address), 2 if pyramid else 1, 2 * (int(condim) - 1) if pyramid else int(condim)))
    weights, members = (np.zeros((len(spans), num_constraint_rows(data))) for _ in range(2))
    for index, (first, normals, count) in enumerate(spans):
        weights[index, first : first + normals] = 1 / normals
        members[index, first : first + count] = 1.0
    return weights, members


def find_guards(model: mjx.Model, data: mjx.Data, qvel: Qvel, ends: bool | Bool[Array, ""]) -> Guards:
    """Guards at a velocity: of a corner's two conditions the one that came last or, if contact ends, that goes first.

    The conditions move along straight lines; if neither passes zero, the one that is closer to it is the guard.
    """
    weights, members = guard_rows(model, data)
    rows: Any = data._impl
    first = members.argmax(axis=1) if len(members) else np.zeros(0, int)
    distance, normals = (rows.efc_pos - rows.efc_margin)[first], jnp.asarray(weights, rows.efc_J.dtype)
    types = np.asarray(model.geom_type)
    if not len(rows.contact.dim) or not (np.any(types == _PLANE) and np.any(np.isin(types, _CONVEX))):
        return Guards(distance, normals, jnp.zeros(len(members), bool))
    limits, geom = rows.nl, rows.contact.geom
    gaps, of_gaps, both = distance[limits:], normals[limits:], jnp.asarray(types)[geom]
    has_skin = (both[:, 0] == _PLANE) & ((both[:, 1] == _CONVEX[0]) | (both[:, 1] == _CONVEX[1]))
    same = jnp.all(geom[:, None] == geom[None], axis=2)
    among = jnp.where(same, gaps, jnp.inf)
    heights, of_heights = gaps - jnp.min(among, axis=1) - SKIN, of_gaps - of_gaps[jnp.argmin(among, axis=1)]

    def time(distance: Array, weights: Array) -> Array:
        speed = jnp.where(ends, -1.0, 1.0) * (weights @ (rows.efc_J @ qvel))
        return jnp.where(speed < 0, jnp.abs(distance / jnp.where(speed < 0, speed, 1.0)), jnp.inf)

    since_gap, since_height = time(gaps, of_gaps), time(heights, of_heights)
    never = jnp.isinf(since_gap) & jnp.isinf(since_height)
    deep = has_skin & (gaps < 0) & jnp.where(never, heights > gaps, since_height < since_gap)
    distance = distance.at[limits:].set(jnp.where(deep, heights, gaps))
    normals = normals.at[limits:].set(jnp.where(deep[:, None], of_heights, of_gaps))
    return Guards(distance, normals, jnp.zeros(len(members), bool).at[limits:].set(deep))


class Points(NamedTuple):
    """Contact points.

    Attributes:
        place: where each contact's point is [m].
        reach: how far it can move in a step with the bodies [m], with a factor of two to spare.
        geom: the two geoms of each contact.
    """

    place: Float[Array, "*steps contacts 3"]
    reach: Float[Array, "*steps contacts"]
    geom: Int[Array, "*steps contacts 2"]


class Course(NamedTuple):
    """What guards do in a step, or in the steps of a rollout.

    Attributes:
        distance: distance of each guard before the step [m or rad].
        speed: its rate there with the velocity before the step [m/s or rad/s].
        room: distance of each guard whose rows may end in the step.
        leaving: its rate there with the velocity after the step, with which the step moves.
        pushes: whether its rows exert a force in the step.
        points: contact points before the step; None unless a geom has corners or edges.
    """

    distance: Float[Array, "*steps guards"]
    speed: Float[Array, "*steps guards"]
    room: Float[Array, "*steps guards"]
    leaving: Float[Array, "*steps guards"]
    pushes: Bool[Array, "*steps guards"]
    points: Points | None


def motion(
    model: mjx.Model, data: mjx.Data, qvel: Qvel, ends: bool | Bool[Array, ""]
) -> tuple[Float[Array, " guards"], Float[Array, " guards"]]:
    """Distance of every guard [m or rad], and its rate at a velocity [m/s or rad/s]."""
    rows: Any = data._impl
    found = find_guards(model, data, qvel, ends)
    return found.distance, found.weights @ (rows.efc_J @ qvel)


def course(model: mjx.Model, data: mjx.Data, qvel: Qvel, after: Qvel, qacc: Qvel) -> Course:
    """Course of the guards in a step from velocity `qvel` to velocity `after`, with acceleration `qacc`."""
    _, members = guard_rows(model, data)
    rows: Any = data._impl
    force = jnp.abs(row_force(model, data, rows.efc_J @ qacc - rows.efc_aref))
    pushes = jnp.asarray(members, force.dtype) @ force > 0
    moves = motion(model, data, qvel, ends=False), motion(model, data, after, ends=True)
    return Course(*moves[0], *moves[1], pushes, contact_points(model, data))


def contact_points(model: mjx.Model, data: mjx.Data) -> Points | None:
    """Contact points at the velocity of the state, after its forward kinematics; None unless a geom has corners."""
    rows: Any = data._impl
    contact = rows.contact
    if not len(contact.dim) or not np.any(np.isin(np.asarray(model.geom_type), _EDGED)):
        return None
    bodies = jnp.asarray(model.geom_bodyid)[contact.geom]
    turning, moving = jnp.split(data.cvel[bodies], 2, axis=-1)
    arm = contact.pos[:, None] - data.subtree_com[jnp.asarray(model.body_rootid)[bodies]]
    speed = jnp.linalg.norm(moving + jnp.cross(turning, arm), axis=-1).max(axis=-1)
    size = jnp.asarray(model.geom_rbound)[contact.geom]
    rolling = jnp.linalg.norm(turning, axis=-1).max(axis=-1) * jnp.where(size > 0, size, jnp.inf).min(axis=-1)
    return Points(contact.pos, 2 * model.opt.timestep * (speed + rolling), contact.geom)


def without(data: mjx.Data, members: Rows) -> mjx.Data:
    """The state without the rows of `members`, which exert no force at any acceleration."""
    rows: Any = data._impl
    keep = jnp.where(members > 0, 0.0, 1.0).astype(rows.efc_J.dtype)
    changed: Any = data.tree_replace(
        {"_impl.efc_J": rows.efc_J * keep[:, None], "_impl.efc_aref": rows.efc_aref * keep}
    )
    return changed


def at_first_touch(model: mjx.Model, data: mjx.Data, members: Rows) -> mjx.Data:
    """The state with the rows of `members` without penetration: no spring force, impedance d_0."""
    with patched(AT_FIRST_TOUCH):
        touching: Any = mjx.make_constraint(model, data)._impl
    rows: Any = data._impl
    choose = lambda one, other: jnp.where(members > 0, one, other)  # noqa: E731
    changed: Any = data.tree_replace(
        {
            "_impl.efc_D": choose(touching.efc_D, rows.efc_D),
            "_impl.efc_aref": choose(touching.efc_aref, rows.efc_aref),
        }
    )
    return changed


def relaxation_rates(model: mjx.Model, data: mjx.Data, normal: Rows) -> tuple[Scalar, Scalar]:
    """b and sqrt(k d_0 / d_width) [1/s] of a guard: the rates at which its damper and its spring slow it down.

    Args:
        data: at the position stage, with a velocity at which the guard moves.
        normal: the guard's weights.
    """

    def rate(stage: Mapping[Place, Callable[..., Any]]) -> Scalar:
        with patched(stage):
            rows: Any = mjx.make_constraint(model, data)._impl
        return -(normal @ rows.efc_aref) / (normal @ (rows.efc_J @ data.qvel))

    return rate(DAMPER), rate(SPRING)
