"""Guards of limits and contacts: distances below zero while their constraint rows exist, and rows where one is zero.

A guard is the distance of a limit or contact minus its margin, but for boxes and meshes at planes, whose corners have
more than one (`corners`).
"""

from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import ELLIPTIC, Qvel, Rows, Scalar, row_forces_at
from mjx_study.simulation.corners import CONVEX, PLANE, Corners, corner_pairs, corners
from mjx_study.simulation.patches import AT_FIRST_TOUCH, DAMPER, SPRING, Place, patched
from mjx_study.simulation.scene import num_constraint_rows

_CYLINDER: Final = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_EDGED: Final = (*CONVEX, _CYLINDER, int(mujoco.mjtGeom.mjGEOM_HFIELD))


class Guards(NamedTuple):
    """Every limit, then every corner of a convex geom at a plane, then every contact.

    Attributes:
        distance: what is below zero while the rows exist [m or rad]; zero or above where they do not, and for contacts
            of which corners are the guards.
        speed: its rate [m/s or rad/s].
        slopes: its derivative over the coordinates, of the guard of an index.
        weights: combination of constraint rows that moves as the distance does.
        members: 0/1 mask of the rows that switch on with the guard.
        deep: whether the rows begin or end in penetration, at the limit of the skin.
    """

    distance: Float[Array, " guards"]
    speed: Float[Array, " guards"]
    slopes: Callable[[Int[Array, ""]], Qvel]
    weights: Float[Array, "guards rows"]
    members: Float[Array, "guards rows"]
    deep: Bool[Array, " guards"]


def num_guards(data: mjx.Data) -> int:
    """Number of limits and contacts; none where constraints are disabled."""
    rows: Any = data._impl
    return int(rows.nl) + len(rows.contact.dim) if num_constraint_rows(data) else 0


def guard_rows(model: mjx.Model, data: mjx.Data) -> tuple[np.ndarray, np.ndarray]:
    """Map each limit, then each contact to its constraint rows; static, both `(guards, rows)`.

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
    """Guards at a velocity: of a corner's conditions the one that came last or, if contact ends, that goes first."""
    weights, members = guard_rows(model, data)
    rows: Any = data._impl
    first = members.argmax(axis=1) if len(members) else np.zeros(0, int)
    weights, members = (jnp.asarray(each, rows.efc_J.dtype) for each in (weights, members))
    distance, speed = (rows.efc_pos - rows.efc_margin)[first], weights @ (rows.efc_J @ qvel)
    none = jnp.zeros(len(members), bool)
    pairs = [corners(model, data, qvel, ends, pair) for pair in corner_pairs(model)]
    if not pairs:
        return Guards(distance, speed, lambda guard: weights[guard] @ rows.efc_J, weights, members, none)
    found: Corners = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *pairs)
    limits, both = rows.nl, jnp.asarray(np.asarray(model.geom_type))[rows.contact.geom]
    replaced = (both[:, 0] == PLANE) & ((both[:, 1] == CONVEX[0]) | (both[:, 1] == CONVEX[1]))
    inserted = lambda every, those: jnp.concatenate([every[:limits], those, every[limits:]])  # noqa: E731
    distance = distance.at[limits:].set(jnp.where(replaced, jnp.maximum(distance[limits:], 1.0), distance[limits:]))
    slopes = inserted(weights @ rows.efc_J, found.slopes)
    return Guards(
        inserted(distance, found.distance),
        inserted(speed, found.speed),
        lambda guard: slopes[guard],
        inserted(weights, (found.slots - found.opposite) @ weights[limits:]),
        inserted(members, found.slots @ members[limits:]),
        inserted(none, found.deep),
    )


class Points(NamedTuple):
    """Contact points.

    Attributes:
        place: where each contact's point is [m].
        reach: how far it can move in a step with the bodies [m], with a factor of two to spare; MJX's search for the
            contact of a cylinder may end anywhere within the penetration.
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


def course(model: mjx.Model, data: mjx.Data, qvel: Qvel, after: Qvel, qacc: Qvel) -> Course:
    """Course of the guards in a step from velocity `qvel` to velocity `after`, with acceleration `qacc`."""
    force = jnp.abs(row_forces_at(model, data, qacc))
    found, later = find_guards(model, data, qvel, ends=False), find_guards(model, data, after, ends=True)
    pushes, points = found.members @ force > 0, contact_points(model, data)
    return Course(found.distance, found.speed, later.distance, later.speed, pushes, points)


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
    round_edged = jnp.any(jnp.asarray(np.asarray(model.geom_type) == _CYLINDER)[contact.geom], axis=-1)
    depth = jnp.where(round_edged, jnp.maximum(-contact.dist, 0.0), 0.0)
    return Points(contact.pos, 2 * model.opt.timestep * (speed + rolling) + depth, contact.geom)


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
