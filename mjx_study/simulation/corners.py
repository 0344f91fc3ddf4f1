"""Corners of boxes and meshes at planes, of which MJX reports few: at most `SKIN` higher than the deepest, up to four.

A corner exerts a force while its height and the excess of its height over every other corner's, less the skin, are
below zero. Each is a condition that moves along a line within a step, whether MJX reports the corners or not, so that
one corner may replace another between two steps.
"""

from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Qvel
from mjx_study.simulation.patches import mjx_module

SKIN: Final = 1e-3
"""MJX's limit [m] on how much higher than the deepest corner of a convex geom another may be to touch a plane."""
PLANE: Final = int(mujoco.mjtGeom.mjGEOM_PLANE)
_BOX: Final = int(mujoco.mjtGeom.mjGEOM_BOX)
CONVEX: Final = (_BOX, int(mujoco.mjtGeom.mjGEOM_MESH))


class Corners(NamedTuple):
    """Corners of one geom at a plane.

    Attributes:
        distance: of the condition that came last or, if contact ends, goes first [m]; below zero while MJX reports it.
        speed: its rate [m/s].
        slopes: its derivative over the coordinates.
        deep: whether the condition is on its height above another corner.
        slots: 0/1, which of MJX's contacts is the corner's.
        opposite: likewise the other corner's.
    """

    distance: Float[Array, " corners"]
    speed: Float[Array, " corners"]
    slopes: Float[Array, "corners nv"]
    deep: Bool[Array, " corners"]
    slots: Float[Array, "corners contacts"]
    opposite: Float[Array, "corners contacts"]


def corner_pairs(model: mjx.Model) -> list[tuple[int, int]]:
    """Pairs of a plane and a box or mesh that may touch."""
    types = np.asarray(model.geom_type)
    if not (np.any(types == PLANE) and np.any(np.isin(types, CONVEX))):
        return []
    pairs = mjx_module("collision_driver").geom_pairs(model)
    return [(int(one), int(two)) for one, two, _ in pairs if types[one] == PLANE and types[two] in CONVEX]


def corners(
    model: mjx.Model, data: mjx.Data, qvel: Qvel, ends: bool | Bool[Array, ""], pair: tuple[int, int]
) -> Corners:
    """Corners of a pair, from its poses and, at the position stage, MJX's contacts."""
    rows: Any = data._impl
    plane, geom = pair
    normal, contact = data.geom_xmat[plane][:, 2], rows.contact
    place = data.geom_xpos[geom] + _vertices(model, geom) @ data.geom_xmat[geom].T
    height = (place - data.geom_xpos[plane]) @ normal
    jacobian, body = mjx_module("support").jac, int(model.geom_bodyid[geom])
    rise = jax.vmap(lambda point: jacobian(model, data, point, body)[0] @ normal)(place)  # planes cannot move

    own = jnp.all(contact.geom == jnp.array(pair), axis=1) & (contact.dist != 1)  # 1 where a slot is empty
    bottom = contact.pos + contact.dist[:, None] / 2 * normal
    nearest = jnp.argmin(jnp.sum((bottom[:, None] - place) ** 2, axis=2), axis=1)
    slots = own & (nearest == jnp.arange(len(place))[:, None])

    # Compared with the corner that is lowest here, and with that which is at the other end of a step.
    away = jnp.where(ends, 1.0, -1.0) * model.opt.timestep
    margin = jnp.max(jnp.where(own, contact.includemargin, 0.0))
    lowest = jnp.argmin(jnp.stack([height, height + away * (rise @ qvel)]), axis=1)
    above = lambda low: jnp.where(margin > 0, height - margin, height - height[low] - SKIN)  # noqa: E731
    distances = jnp.stack([height - margin, *map(above, lowest)])
    slopes = jnp.stack([rise, *(jnp.where(margin > 0, rise, rise - rise[low]) for low in lowest)])
    speeds = slopes @ qvel
    moves = away * speeds > 0
    time = jnp.where(moves, -distances / jnp.where(moves, away * speeds, 1.0), jnp.inf)
    chosen = jnp.where(jnp.all(~moves, axis=0), jnp.argmax(distances, axis=0), jnp.argmin(time, axis=0))
    pick = lambda each: jnp.take_along_axis(each, chosen[None], axis=0)[0]  # noqa: E731
    most, exists = jnp.max(distances, axis=0), jnp.any(slots, axis=1)
    slots = slots.astype(height.dtype)
    opposite = jnp.stack([jnp.zeros_like(slots), *(jnp.broadcast_to(slots[low], slots.shape) for low in lowest)])
    nothing = jnp.finfo(height.dtype).tiny
    return Corners(
        jnp.where(exists & (most < 0), pick(distances), jnp.maximum(most, nothing)),
        pick(speeds),
        jnp.take_along_axis(slopes, chosen[None, :, None], axis=0)[0],
        (chosen > 0) & (margin <= 0),
        slots,
        jnp.take_along_axis(opposite, chosen[None, :, None], axis=0)[0],
    )


def _vertices(model: mjx.Model, geom: int) -> Float[Array, "corners 3"]:
    if model.geom_type[geom] == _BOX:
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        return jnp.asarray(signs, model.geom_size.dtype) * model.geom_size[geom]
    implementation: Any = model._impl
    return implementation.mesh_convex[model.geom_dataid[geom]].vert
