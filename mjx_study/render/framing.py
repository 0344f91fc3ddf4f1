"""View of a motion, and the part of the scene to show."""

import dataclasses
import functools
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.choices import unknown
from mjx_study.render.motion import Motion
from mjx_study.render.outline import VIEWS, View

_SAMPLED_TIMES: Final = 100
_SURROUNDINGS: Final = 0.35  # distance around the motion within which fixed geoms are shown, over the larger side
_MARGIN: Final = 0.06  # relative to the larger side
_LONGEST: Final = 4.5  # maximum ratio of the sides
_EDGE_ON: Final = 0.05  # a plane appears as a line if its normal is this close to the picture's plane


@dataclasses.dataclass(frozen=True)
class Bounds:
    """A rectangle in the plane of the picture [m]."""

    low: Float[np.ndarray, " axes"]
    high: Float[np.ndarray, " axes"]

    @property
    def size(self) -> Float[np.ndarray, " axes"]:
        return self.high - self.low

    def united(self, other: "Bounds") -> "Bounds":
        """Smallest rectangle around both."""
        return Bounds(np.minimum(self.low, other.low), np.maximum(self.high, other.high))

    def cut(self, other: "Bounds") -> "Bounds":
        """Intersection with another rectangle, which must overlap."""
        return Bounds(np.maximum(self.low, other.low), np.minimum(self.high, other.high))

    def grown(self, distance: float) -> "Bounds":
        """Rectangle with a margin on every side [m]."""
        return Bounds(self.low - distance, self.high + distance)

    def overlaps(self, other: "Bounds") -> bool:
        return bool(np.all(self.low <= other.high) and np.all(other.low <= self.high))


def resolve_view(motion: Motion, name: str) -> View:
    """Look up a view by name, or choose it for `auto`. Raises ValueError, listing the choices, for an unknown name."""
    if name == "auto":
        return choose_view(motion)
    if name not in VIEWS:
        raise ValueError(unknown("view", name, ("auto", *VIEWS)))
    return VIEWS[name]


def choose_view(motion: Motion) -> View:
    """Choose the view whose plane shows most of the motion.

    Each axis is scored by the extent of the moving geoms plus the travel of their farthest-moving corner. The vertical
    counts twice, since a view from above hides contact with the ground. The view is along the axis with the lowest
    score; ties favour keeping the vertical, then viewing along y.
    """
    shown = motion.visible & motion.moving[motion.model.geom_bodyid] & ~_planes(motion.model)
    corners = _corners(motion, shown) if shown.any() else motion.poses.centre[:, motion.moving]
    if corners.size == 0:
        return VIEWS["xz"]
    score = np.ptp(corners, axis=(0, 1)) + np.ptp(corners, axis=0).max(axis=0)
    gravity = np.abs(motion.model.opt.gravity)
    vertical = int(np.argmax(gravity)) if gravity.any() else 2
    score[vertical] *= 2
    score[vertical] += 1e-3 * score.max()
    score[1] -= 1e-6 * score.max()
    return {1: VIEWS["xz"], 2: VIEWS["xy"], 0: VIEWS["yz"]}[int(np.argmin(score))]


def bounds(motion: Motion, view: View) -> Bounds:
    """Bounds of a picture of the whole motion: everything that moves, and the fixed geoms around it."""
    model, geoms, wanted = motion.model, motion.visible & ~_planes(motion.model), _wanted(motion)
    fixed = [_swept(motion, np.arange(model.ngeom) == geom, view.plane) for geom in np.flatnonzero(geoms & ~wanted)]
    if (geoms & wanted).any():
        swept = _swept(motion, geoms & wanted, view.plane)
    else:
        swept = functools.reduce(Bounds.united, fixed) if fixed else Bounds(np.full(2, -0.5), np.full(2, 0.5))
    side = max(swept.size.max(), 1e-3)
    nearby = swept.grown(_SURROUNDINGS * side)
    shown = swept
    for other in fixed:
        if nearby.overlaps(other):
            shown = shown.united(other.cut(nearby))
    for point, normal in edges(motion, view):
        corners = np.array([[x, y] for x in (swept.low[0], swept.high[0]) for y in (swept.low[1], swept.high[1])])
        distances = (corners - point) @ normal
        nearest = corners[np.argmin(distances)] - distances.min() * normal
        if distances.min() > 0 and nearby.overlaps(Bounds(nearest, nearest)):
            shown = shown.united(Bounds(nearest, nearest))
    shown = shown.grown(_MARGIN * max(shown.size.max(), 1e-3))
    missing = np.maximum(shown.size.max() / _LONGEST - shown.size, 0) / 2
    return Bounds(shown.low - missing, shown.high + missing)


def depths(motion: Motion, view: View) -> tuple[float, float]:
    """Smallest and largest depth towards the viewer that a picture must show [m]."""
    along, geoms = int(np.argmax(np.abs(view.towards))), motion.visible & ~_planes(motion.model) & _wanted(motion)
    if not geoms.any():
        return 0.0, 0.0
    box = _swept(motion, geoms, [along])
    far, near = sorted((float(box.low[0] * view.towards[along]), float(box.high[0] * view.towards[along])))
    return far, near


def edges(motion: Motion, view: View) -> list[tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]]:
    """A point and the unit normal of every visible plane seen edge-on; MuJoCo's planes are infinite."""
    found = []
    for geom in np.flatnonzero(motion.visible & _planes(motion.model)):
        position, normal = motion.poses.position[0, geom], motion.poses.rotation[0, geom, :, 2]
        if abs(normal @ view.towards) < _EDGE_ON:
            flat = normal[view.plane]
            found.append((position[view.plane], flat / np.linalg.norm(flat)))
    return found


def _planes(model: mujoco.MjModel) -> np.ndarray:
    return model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE


def _corners(motion: Motion, geoms: np.ndarray) -> np.ndarray:
    """Corners (times, points, 3) of the geoms' bounding boxes at some of the times."""
    times = motion.at(_SAMPLED_TIMES)
    centre, half = motion.model.geom_aabb[geoms, :3], motion.model.geom_aabb[geoms, 3:]
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, 8).T
    local = centre[:, None] + signs * half[:, None]
    position, rotation = motion.poses.position[times][:, geoms], motion.poses.rotation[times][:, geoms]
    return (position[:, :, None] + np.einsum("tgij,gcj->tgci", rotation, local)).reshape(len(times), -1, 3)


def _wanted(motion: Motion) -> np.ndarray:
    """Geoms that a picture must show: movable ones and those in focus."""
    return motion.moving[motion.model.geom_bodyid] | np.isin(np.arange(motion.model.ngeom), motion.focus)


def _swept(motion: Motion, geoms: np.ndarray, axes: list[int]) -> Bounds:
    """Bounds of one or more geoms over the whole motion."""
    model, poses = motion.model, motion.poses
    rotation = poses.rotation[:, geoms][:, :, axes]
    shift = np.einsum("tgij,gj->tgi", rotation, model.geom_aabb[geoms, :3])
    centre = poses.position[:, geoms][:, :, axes] + shift
    half = np.einsum("tgij,gj->tgi", np.abs(rotation), model.geom_aabb[geoms, 3:])
    # MuJoCo's bounding sphere has the geom's centre, so it only bounds a box with the same centre.
    centred = ~np.any(model.geom_aabb[geoms, :3], axis=1)
    half = np.minimum(half, np.where(centred, model.geom_rbound[geoms], np.inf)[:, None])
    return Bounds((centre - half).min(axis=(0, 1)), (centre + half).max(axis=(0, 1)))
