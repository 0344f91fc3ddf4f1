"""A motion to draw: a model and its configuration at each time; its view, and the part of the scene to show."""

import dataclasses
import functools
from functools import cached_property
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_study.choices import PLANES, unknown

VISIBLE_GROUPS = 3
"""Geom groups that MuJoCo's viewers show by default (0, 1 and 2); collision geometry is usually in 3 and above."""
DEFAULT_RGBA: Final = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
"""MuJoCo's default geom colour, the only one that a material's colour overrides."""
CORNERS: Final = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, 8).T  # corners of a box with half sides 1
_SAMPLED_TIMES: Final = 100
_SURROUNDINGS: Final = 0.35  # distance around the motion within which fixed geoms are shown, over the larger side
_MARGIN: Final = 0.06  # relative to the larger side
_LONGEST: Final = 4.5  # maximum ratio of the sides
_EDGE_ON: Final = 0.05  # a plane appears as a line if its normal is this close to the picture's plane


@dataclasses.dataclass(frozen=True)
class View:
    """An orthographic projection along a coordinate axis, named by the other two: `"xz"`; x, y, z are axes 0, 1, 2."""

    name: str
    right: int
    up: int

    @property
    def plane(self) -> list[int]:
        return [self.right, self.up]

    @property
    def towards(self) -> Float[np.ndarray, " 3"]:
        """Unit vector from the scene to the viewer."""
        return np.cross(*np.eye(3)[self.plane])


VIEWS: Final = {name: View(name, *map("xyz".index, name)) for name in PLANES}


@dataclasses.dataclass(frozen=True)
class Poses:
    """Positions and orientations at each time, in the world frame [m].

    Attributes:
        position: centres of the geoms.
        rotation: axes of the geoms, as columns.
        centre: centres of mass of the bodies.
        subtree: centres of mass of the bodies' subtrees.
    """

    position: Float[np.ndarray, "times ngeom 3"]
    rotation: Float[np.ndarray, "times ngeom 3 3"]
    centre: Float[np.ndarray, "times nbody 3"]
    subtree: Float[np.ndarray, "times nbody 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Motion:
    """Generalised positions of a model [m or rad; unit quaternions] at increasing times [s].

    Geoms in `focus` are shown in every picture, however far they are from the motion.
    """

    model: mujoco.MjModel
    time: Float[np.ndarray, " times"]
    qpos: Float[np.ndarray, "times nq"]
    focus: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.qpos.shape != (len(self.time), self.model.nq) or len(self.time) == 0:
            raise ValueError(
                f"qpos has shape {self.qpos.shape}; {len(self.time)} times of this model need "
                f"({max(len(self.time), 1)}, {self.model.nq})"
            )
        if not np.all(np.diff(self.time) > 0):
            raise ValueError("the times of a motion must increase")
        finite = np.all(np.isfinite(self.qpos), axis=1)
        if not np.all(finite):
            raise ValueError(f"qpos is not finite at {self.time[np.argmin(finite)]:g} s")

    @property
    def duration(self) -> float:
        return float(self.time[-1] - self.time[0])

    @cached_property
    def visible(self) -> Bool[np.ndarray, " ngeom"]:
        """Mask of the geoms that MuJoCo's viewers show by default."""
        model, alpha = self.model, np.array(self.model.geom_rgba[:, 3])
        default = np.all(model.geom_rgba == DEFAULT_RGBA, axis=1) & (model.geom_matid >= 0)
        alpha[default] = model.mat_rgba[model.geom_matid[default], 3]
        return (model.geom_group < VISIBLE_GROUPS) & (alpha > 0)

    @cached_property
    def moving(self) -> Bool[np.ndarray, " nbody"]:
        """Mask of the bodies that can move: those not welded to the world."""
        return self.model.body_weldid != 0

    @cached_property
    def moving_geoms(self) -> Bool[np.ndarray, " ngeom"]:
        return self.moving[self.model.geom_bodyid]

    @cached_property
    def planes(self) -> Bool[np.ndarray, " ngeom"]:
        return self.model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE

    @cached_property
    def poses(self) -> Poses:
        model, data = self.model, mujoco.MjData(self.model)
        count = len(self.time)
        position, rotation = np.empty((count, model.ngeom, 3)), np.empty((count, model.ngeom, 9))
        centre, subtree = np.empty((count, model.nbody, 3)), np.empty((count, model.nbody, 3))
        for index, qpos in enumerate(self.qpos):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            position[index], rotation[index] = data.geom_xpos, data.geom_xmat
            centre[index], subtree[index] = data.xipos, data.subtree_com
        return Poses(position, rotation.reshape(count, model.ngeom, 3, 3), centre, subtree)

    def at(self, count: int) -> Int[np.ndarray, " count"]:
        """Indices of `count` evenly spaced times from first to last, or of all if there are fewer."""
        wanted = np.linspace(self.time[0], self.time[-1], count)
        nearest = np.ceil(np.interp(wanted, self.time, np.arange(len(self.time))) - 0.5)
        return np.unique(nearest.astype(int))


@dataclasses.dataclass(frozen=True)
class Bounds:
    """A rectangle in the plane of the picture [m]."""

    low: Float[np.ndarray, " axes"]
    high: Float[np.ndarray, " axes"]

    @property
    def size(self) -> Float[np.ndarray, " axes"]:
        return self.high - self.low

    def united(self, other: "Bounds") -> "Bounds":
        return Bounds(np.minimum(self.low, other.low), np.maximum(self.high, other.high))

    def cut(self, other: "Bounds") -> "Bounds | None":
        """Intersection; None if they do not overlap."""
        low, high = np.maximum(self.low, other.low), np.minimum(self.high, other.high)
        return Bounds(low, high) if np.all(low <= high) else None

    def grown(self, margin: Float[np.ndarray, " axes"] | float) -> "Bounds":
        return Bounds(self.low - margin, self.high + margin)


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
    shown = motion.visible & motion.moving_geoms & ~motion.planes
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
    wanted = _wanted(motion)
    fixed = [
        _swept(motion, np.array([geom]), view.plane)
        for geom in np.flatnonzero(motion.visible & ~motion.planes & ~wanted)
    ]
    if wanted.any():
        shown = swept = _swept(motion, wanted, view.plane)
    else:
        shown = swept = functools.reduce(Bounds.united, fixed or [Bounds(np.full(2, -0.5), np.full(2, 0.5))])
    nearby = swept.grown(_SURROUNDINGS * max(swept.size.max(), 1e-3))
    for other in fixed:
        if part := other.cut(nearby):
            shown = shown.united(part)
    for point, normal in edges(motion, view):
        corners = np.array([[x, y] for x in (swept.low[0], swept.high[0]) for y in (swept.low[1], swept.high[1])])
        distances = (corners - point) @ normal
        nearest = corners[np.argmin(distances)] - distances.min() * normal
        if distances.min() > 0 and (part := nearby.cut(Bounds(nearest, nearest))):
            shown = shown.united(part)
    shown = shown.grown(_MARGIN * max(shown.size.max(), 1e-3))
    return shown.grown(np.maximum(shown.size.max() / _LONGEST - shown.size, 0) / 2)


def depths(motion: Motion, view: View) -> tuple[float, float]:
    """Smallest and largest depth towards the viewer that a picture must show [m]."""
    along, wanted = int(np.argmax(np.abs(view.towards))), _wanted(motion)
    if not wanted.any():
        return 0.0, 0.0
    box = _swept(motion, wanted, [along])
    far, near = sorted((float(box.low[0] * view.towards[along]), float(box.high[0] * view.towards[along])))
    return far, near


def edges(motion: Motion, view: View) -> list[tuple[Float[np.ndarray, " 2"], Float[np.ndarray, " 2"]]]:
    """A point and the unit normal of every visible plane seen edge-on; MuJoCo's planes are infinite."""
    found = []
    for geom in np.flatnonzero(motion.visible & motion.planes):
        position, normal = motion.poses.position[0, geom], motion.poses.rotation[0, geom, :, 2]
        if abs(normal @ view.towards) < _EDGE_ON:
            flat = normal[view.plane]
            found.append((position[view.plane], flat / np.linalg.norm(flat)))
    return found


def _corners(motion: Motion, geoms: np.ndarray) -> np.ndarray:
    """Corners (times, points, 3) of the geoms' bounding boxes at some of the times."""
    times = motion.at(_SAMPLED_TIMES)
    centre, half = motion.model.geom_aabb[geoms, :3], motion.model.geom_aabb[geoms, 3:]
    local = centre[:, None] + CORNERS * half[:, None]
    position, rotation = motion.poses.position[times][:, geoms], motion.poses.rotation[times][:, geoms]
    return (position[:, :, None] + np.einsum("tgij,gcj->tgci", rotation, local)).reshape(len(times), -1, 3)


def _wanted(motion: Motion) -> np.ndarray:
    """Geoms other than planes that a picture must show: movable ones and those in focus."""
    wanted = motion.moving_geoms | np.isin(np.arange(motion.model.ngeom), motion.focus)
    return motion.visible & ~motion.planes & wanted


def _swept(motion: Motion, geoms: np.ndarray, axes: list[int]) -> Bounds:
    """Bounds of one or more geoms, by mask or index, over the whole motion."""
    model, poses = motion.model, motion.poses
    rotation = poses.rotation[:, geoms][:, :, axes]
    shift = np.einsum("tgij,gj->tgi", rotation, model.geom_aabb[geoms, :3])
    centre = poses.position[:, geoms][:, :, axes] + shift
    half = np.einsum("tgij,gj->tgi", np.abs(rotation), model.geom_aabb[geoms, 3:])
    # MuJoCo's bounding sphere has the geom's centre, so it only bounds a box with the same centre.
    centred = ~np.any(model.geom_aabb[geoms, :3], axis=1)
    half = np.minimum(half, np.where(centred, model.geom_rbound[geoms], np.inf)[:, None])
    return Bounds((centre - half).min(axis=(0, 1)), (centre + half).max(axis=(0, 1)))
