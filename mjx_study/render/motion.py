"""A motion to draw: a compiled model and its configuration at each time."""

import dataclasses
from functools import cached_property
from typing import Final

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

VISIBLE_GROUPS = 3
"""Geom groups that MuJoCo's viewers show by default (0, 1 and 2); collision geometry is usually in 3 and above."""

DEFAULT_RGBA: Final = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
"""MuJoCo's default geom colour, the only one that a material's colour overrides."""


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
    """A model's motion.

    Attributes:
        time: increasing times [s].
        qpos: generalised positions at these times [m or rad; unit quaternions].
        focus: geoms shown in every picture, however far they are from the motion.
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
        model = self.model
        alpha = np.array(model.geom_rgba[:, 3])
        default = np.all(model.geom_rgba == DEFAULT_RGBA, axis=1)
        for geom in np.flatnonzero(default & (model.geom_matid >= 0)):
            alpha[geom] = model.mat_rgba[model.geom_matid[geom], 3]
        return (model.geom_group < VISIBLE_GROUPS) & (alpha > 0)

    @cached_property
    def moving(self) -> Bool[np.ndarray, " nbody"]:
        """Mask of the bodies that can move: those not welded to the world."""
        return self.model.body_weldid != 0

    @cached_property
    def poses(self) -> Poses:
        """Forward kinematics at every time."""
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
        after = np.clip(np.searchsorted(self.time, wanted), 1, max(len(self.time) - 1, 1))
        if len(self.time) == 1:
            return np.zeros(1, int)
        nearer = np.where(wanted - self.time[after - 1] <= self.time[after] - wanted, after - 1, after)
        return np.unique(nearer)
