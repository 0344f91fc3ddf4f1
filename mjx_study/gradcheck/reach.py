"""Contacts that a model can make, from bounds on where joints can bring geoms and how geoms can move there.

Undecided cases count as within reach.
"""

import dataclasses
import sys
from collections import Counter
from collections.abc import Iterator
from typing import Any, Final

import mujoco
import numpy as np

from mjx_study.gradcheck.coordinates import joints_above
from mjx_study.simulation._mjx import mjx

_driver: Any = sys.modules[mjx.collision.__module__]  # its collision candidates are not public
_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_PLANE, _SPHERE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_SPHERE)
NO_FRICTION: Final = mujoco.mjMINMU
"""Sliding friction that MuJoCo assigns to a contact whose geoms have none."""
ALIGNED: Final = 1e-9
"""Sine of the angle below which directions coincide."""


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two geoms tested by MJX for collision.

    Attributes:
        first: the geom whose type has the smaller number.
        friction: whether their contact has friction.
        margin: upper bound on the distance at which contact begins [m].
    """

    first: int
    second: int
    friction: bool
    margin: float


def pairs_of(host: mujoco.MjModel) -> Iterator[Pair]:
    for first, second, index in _driver.geom_pairs(host):
        both = [first, second]
        if index >= 0:
            condim, friction, margin = host.pair_dim[index], host.pair_friction[index, 0], host.pair_margin[index]
        else:
            priority = host.geom_priority[both]
            ruling = np.array(both)[priority == max(priority)]
            condim, friction = max(host.geom_condim[ruling]), max(host.geom_friction[ruling, 0])
            margin = sum(host.geom_margin[both])
        yield Pair(first, second, bool(condim > 1 and friction > NO_FRICTION), float(margin))


class Reach:
    """Regions that a model's joints can bring its geoms to; joint limits are ignored, since they are soft."""

    def __init__(self, host: mujoco.MjModel):
        self._host, self._zero = host, mujoco.MjData(host)
        mujoco.mj_kinematics(host, self._zero)
        self._balls: dict[int | None, tuple[np.ndarray, np.ndarray]] = {}

    def touch(self, pair: Pair) -> bool:
        """Whether two geoms may come into contact."""
        if self._host.nmocap:  # may move anything fixed
            return True
        plane = self._host.geom_type[pair.first] == _PLANE
        centre, radius = self._geoms(pair.first if plane else None)
        first, second = pair.first, pair.second
        if plane:
            distance = self._normal(first) @ (centre[second] - self._zero.geom_xpos[first]) - radius[second]
        else:
            distance = np.linalg.norm(centre[second] - centre[first]) - radius[first] - radius[second]
        return bool(distance <= pair.margin)

    def slide(self, pair: Pair) -> bool:
        """Whether two geoms may move tangentially to their contact, rather than along its normal alone."""
        host, zero = self._host, self._zero
        one, other = (joints_above(host, int(host.geom_bodyid[geom])) for geom in (pair.first, pair.second))
        joints, types = sorted(one ^ other), host.geom_type[[pair.first, pair.second]]
        if host.nmocap or any(host.jnt_type[joint] != _SLIDE for joint in joints):
            return True
        if types[0] == _PLANE:
            normal = self._normal(pair.first)
        elif all(types == _SPHERE):
            normal = zero.geom_xpos[pair.second] - zero.geom_xpos[pair.first]
            normal = normal / max(float(np.linalg.norm(normal)), 1e-300)
        else:
            return True
        return any(
            np.linalg.norm(zero.xaxis[joint] - (zero.xaxis[joint] @ normal) * normal) > ALIGNED for joint in joints
        )

    def _normal(self, plane: int) -> np.ndarray:
        return self._zero.geom_xmat[plane].reshape(3, 3)[:, 2]

    def _geoms(self, plane: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Bounding balls of geoms, centres (ngeom, 3) and radii (ngeom,) [m]; for a plane, only along its normal."""
        if plane not in self._balls:
            self._balls[plane] = self._ball_of_each(None if plane is None else self._normal(plane))
        return self._balls[plane]

    def _ball_of_each(self, normal: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        host, zero = self._host, self._zero
        centre, radius, turning = zero.xpos.copy(), np.zeros(host.nbody), np.zeros(host.nbody, bool)

        def follow(body: int, offset: np.ndarray) -> tuple[np.ndarray, float]:
            """Bounding ball of a point fixed to a body at an offset from its origin in the reference pose."""
            if turning[body]:
                return centre[body], radius[body] + float(np.linalg.norm(offset))
            return centre[body] + offset, radius[body]

        for body in range(1, host.nbody):
            parent = int(host.body_parentid[body])
            centre[body], radius[body] = follow(parent, zero.xpos[body] - zero.xpos[parent])
            turning[body] = turning[parent]
            for joint in range(host.body_jntadr[body], host.body_jntadr[body] + host.body_jntnum[body]):
                kind = host.jnt_type[joint]
                if kind == _SLIDE:
                    along = normal is not None and not turning[body] and abs(zero.xaxis[joint] @ normal) <= ALIGNED
                    radius[body] += 0.0 if along else np.inf
                else:
                    radius[body] += np.inf if kind == _FREE else 2 * float(np.linalg.norm(host.jnt_pos[joint]))
                    turning[body] = True
        bodies = host.geom_bodyid
        balls = [
            follow(int(bodies[geom]), zero.geom_xpos[geom] - zero.xpos[bodies[geom]]) for geom in range(host.ngeom)
        ]
        return np.array([ball for ball, _ in balls]), np.array([size for _, size in balls]) + host.geom_rbound


def contact_parts(host: mujoco.MjModel) -> tuple[set[str], dict[str, int]]:
    """Contact zones that may be reached, and those that cannot, with the number of pairs of geoms."""
    reach, had, within = Reach(host), Counter(), set()
    for pair in pairs_of(host):
        had.update({"contact", *(("stick", "slide") if pair.friction else ("push",))})
        if reach.touch(pair):
            within |= {"contact", "separate", "stick" if pair.friction else "push"}
            within |= {"slide"} if pair.friction and reach.slide(pair) else set()
    out = {part: count for part, count in had.items() if part not in within}
    return within, {"contact": out["contact"]} if "contact" in out else out
