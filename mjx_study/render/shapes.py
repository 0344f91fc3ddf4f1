"""Outlines of geoms in the plane of a picture."""

import dataclasses
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from mjx_study.render.motion import CORNERS, View

_ANGLE: Final = np.linspace(0, 2 * np.pi, 97)[:-1]
CIRCLE: Final = np.stack([np.cos(_ANGLE), np.sin(_ANGLE)], axis=1)
"""Points of a unit circle; circles are drawn as this polygon."""
_MESH_POINTS: Final = 400
Geom = mujoco.mjtGeom


@dataclasses.dataclass(frozen=True)
class Shape:
    """A geom in its own frame: the convex hull of equal balls around points [m].

    Attributes:
        points: corners, ends of an axis, or vertices.
        radius: radius of the balls; 0 for a polyhedron.
        semi_axes: semi-axes of an ellipsoid, which is not such a hull; None for other geoms.
        cell: largest distance between adjacent points of a height field [m], which is drawn as a profile rather than
            its hull; None for other geoms.
    """

    points: Float[np.ndarray, "points 3"]
    radius: float = 0.0
    semi_axes: Float[np.ndarray, " 3"] | None = None
    cell: float | None = None

    def outline(
        self, position: Float[np.ndarray, " 3"], rotation: Float[np.ndarray, "3 3"], view: View
    ) -> Float[np.ndarray, "corners 2"]:
        """Corners of the projection [m], counter-clockwise; curves become inscribed polygons."""
        centre, projection = position[view.plane], rotation[view.plane]
        if self.semi_axes is not None:
            # The point of an ellipsoid A S^2 that is farthest along u is A A^T u / |A^T u|.
            pulled = CIRCLE @ (projection * self.semi_axes)
            return centre + pulled @ (projection * self.semi_axes).T / np.linalg.norm(pulled, axis=1, keepdims=True)
        flat = centre + self.points @ projection.T
        if self.cell is not None and projection[1, 2] > 0.9:
            return _profile(flat)
        if self.radius:
            flat = (flat[:, None] + self.radius * CIRCLE).reshape(-1, 2)
        return convex_hull(flat)

    def slice(
        self, position: Float[np.ndarray, " 3"], rotation: Float[np.ndarray, "3 3"], view: View, depth: float
    ) -> "Shape":
        """Cut a height field at the motion's depth towards the viewer [m], keeping only points near it."""
        if self.cell is None:
            return self
        distance = np.abs((position + self.points @ rotation.T) @ view.towards - depth)
        return dataclasses.replace(self, points=self.points[distance <= distance.min() + 0.5 * self.cell])


def shape_of(model: mujoco.MjModel, geom: int) -> Shape | None:
    """Return the shape of a geom; None for a plane, which has no outline."""
    kind, size, mesh = Geom(model.geom_type[geom]), model.geom_size[geom], int(model.geom_dataid[geom])
    ends = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    if kind == Geom.mjGEOM_SPHERE:
        return Shape(np.zeros((1, 3)), radius=float(size[0]))
    if kind == Geom.mjGEOM_CAPSULE:
        return Shape(ends * size[1], radius=float(size[0]))
    if kind == Geom.mjGEOM_ELLIPSOID:
        return Shape(np.zeros((1, 3)), semi_axes=np.array(size))
    if kind == Geom.mjGEOM_CYLINDER:
        ring = np.pad(size[0] * CIRCLE, ((0, 0), (0, 1)))
        return Shape(np.concatenate([ring + end * size[1] for end in ends]))
    if kind == Geom.mjGEOM_BOX:
        return Shape(CORNERS * size)
    if kind in (Geom.mjGEOM_MESH, Geom.mjGEOM_SDF) and mesh >= 0:
        start = int(model.mesh_vertadr[mesh])
        return Shape(_extreme(model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])].astype(float)))
    if kind == Geom.mjGEOM_HFIELD:
        spacing = 2 * model.hfield_size[mesh, :2] / (model.hfield_ncol[mesh] - 1, model.hfield_nrow[mesh] - 1)
        return Shape(_terrain(model, mesh), cell=float(spacing.max()))
    return None


def convex_hull(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "corners 2"]:
    """Corners of the planar convex hull, counter-clockwise; the end points if all points are on a line."""
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:
        ordered = points[np.lexsort((points[:, 1], points[:, 0]))]
        return np.unique(ordered[[0, -1]], axis=0)


def _extreme(points: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "kept 3"]:
    """Points farthest in some direction; for many points, only a sample of directions is searched."""
    if len(points) <= _MESH_POINTS:
        return points
    height = np.linspace(-1, 1, _MESH_POINTS)
    turn = np.pi * (1 + 5**0.5) * np.arange(_MESH_POINTS)
    across = np.sqrt(1 - height**2)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)
    return points[np.unique(np.argmax(points @ directions.T, axis=0))]


def _terrain(model: mujoco.MjModel, field: int) -> Float[np.ndarray, "points 3"]:
    """Vertices of a height field, each with its base point."""
    rows, columns, start = (int(part[field]) for part in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    x, y, height, base = model.hfield_size[field]
    data = model.hfield_data[start : start + rows * columns]
    ys, xs = np.meshgrid(np.linspace(-y, y, rows), np.linspace(-x, x, columns), indexing="ij")
    top = np.stack([xs.ravel(), ys.ravel(), height * data], axis=1)
    return np.concatenate([top, top * (1, 1, 0) - (0, 0, base)])


def _profile(points: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "corners 2"]:
    """Highest point at each position along the horizontal, closed below."""
    places = np.unique(np.round(points[:, 0], 6))
    places = places[:: max(1, len(places) // 400)]
    index = np.argmin(np.abs(points[:, :1] - places), axis=1)
    highest = np.full(len(places), -np.inf)
    np.maximum.at(highest, index, points[:, 1])
    bottom = points[:, 1].min()
    return np.array([[places[0], bottom], [places[-1], bottom], *np.stack([places, highest], axis=1)[::-1]])
