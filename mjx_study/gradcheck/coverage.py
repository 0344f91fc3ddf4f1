"""Parts of a model's dynamics that a state exercises: contact by zone, limits, friction loss, equalities.

Which contacts a model can make follows from bounds on where joints can bring geoms, and how geoms can move there;
undecided cases count as within reach.
"""

import dataclasses
import functools
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final

import mujoco
import numpy as np

from mjx_study.gradcheck.coordinates import joints_above
from mjx_study.simulation.contact_pair import NO_FRICTION, ContactPair, contact_pairs
from mjx_study.simulation.scene import Scene
from mjx_study.table import plural

ZONES: Final = ("push", "stick", "slide", "separate")
"""Contact zones: push is frictionless; stick and slide have friction; separate is within the margin, without force."""
PARTS: Final = ("contact", *ZONES, "limit", "friction loss", "held", "slipping", "equality")
"""Parts that a state can exercise; friction loss is held, or slipping at its bound."""
OPTIONAL: Final = frozenset({"separate", "contact", "friction loss"})
"""Parts counted but not required: undamped contact never separates within its margin; the others have subparts."""
ALIGNED_SINE: Final = 1e-9  # sine of the angle below which directions coincide
_STATE, _KIND = mujoco.mjtConstraintState, mujoco.mjtConstraint
_LIMITS = (int(_KIND.mjCNSTR_LIMIT_JOINT), int(_KIND.mjCNSTR_LIMIT_TENDON))
_LOSSES = (int(_KIND.mjCNSTR_FRICTION_DOF), int(_KIND.mjCNSTR_FRICTION_TENDON))
_SATISFIED, _QUADRATIC = int(_STATE.mjCNSTRSTATE_SATISFIED), int(_STATE.mjCNSTRSTATE_QUADRATIC)
_FREE, _SLIDE = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_SLIDE)
_PLANE, _SPHERE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_SPHERE)


@dataclasses.dataclass(frozen=True)
class Coverage:
    """Number of states that exercise each part that a model has, and the parts that no state exercises.

    `unreachable` has contact, or zones of it, that no pair of geoms can reach, with the number of pairs.
    """

    states: int
    counts: dict[str, int]
    missing: tuple[str, ...]
    unreachable: dict[str, int] = dataclasses.field(default_factory=dict)

    def line(self) -> str:
        parts, subparts = [], {"contact": ZONES, "limit": (), "friction loss": ("held", "slipping"), "equality": ()}
        for part, inner in subparts.items():
            if part in self.counts:
                details = ", ".join(f"{zone} {self.counts[zone]}" for zone in inner if zone in self.counts)
                parts.append(f"{part} in {self.counts[part]}{f' ({details})' if details else ''}")
        parts += [
            f"{part} out of reach of {'the only pair' if pairs == 1 else f'all {pairs} pairs'} of geoms"
            for part, pairs in self.unreachable.items()
        ]
        return f"of {plural(self.states, 'state')}, {'; '.join(parts)}" if parts else ""


def count_coverage(
    parts: frozenset[str], states: Sequence[Collection[str]], unreachable: Mapping[str, int] = MappingProxyType({})
) -> Coverage:
    counts = {part: sum(part in state for state in states) for part in PARTS if part in parts}
    missing = [part for part, count in counts.items() if not count and part not in OPTIONAL]
    if "contact" in counts and not counts["contact"]:
        missing = ["contact", *(part for part in missing if part not in ZONES)]
    return Coverage(len(states), counts, tuple(missing), dict(unreachable))


def exercised(data: mujoco.MjData) -> frozenset[str]:
    """Parts active in a state of the C engine after its forward pass."""
    kinds, states = np.asarray(data.efc_type), np.asarray(data.efc_state)
    parts = {
        _zone(contact, kinds, states) for contact in data.contact if contact.exclude == 0 and contact.efc_address >= 0
    }
    if parts - {"separate"}:
        parts.add("contact")
    if np.any(np.isin(kinds, _LIMITS) & (states == _QUADRATIC)):
        parts.add("limit")
    losses = states[np.isin(kinds, _LOSSES)]
    if len(losses):
        parts |= {"friction loss"} | {"held" if state == _QUADRATIC else "slipping" for state in losses}
    if np.any(kinds == int(_KIND.mjCNSTR_EQUALITY)):
        parts.add("equality")
    return frozenset(parts)


def _zone(contact: Any, kinds: np.ndarray, states: np.ndarray) -> str:
    """Zone of a contact: its row's, or for a pyramid by whether all or some of its edges push."""
    first, dim = int(contact.efc_address), int(contact.dim)
    pyramid = kinds[first] == int(_KIND.mjCNSTR_CONTACT_PYRAMIDAL)
    found = set(states[first : first + (2 * (dim - 1) if pyramid else 1)].tolist())
    if found == {_SATISFIED}:
        return "separate"
    if dim == 1 or contact.friction[0] <= NO_FRICTION:
        return "push"
    return "stick" if found == {_QUADRATIC} else "slide"


def possible(scene: Scene, host: mujoco.MjModel) -> tuple[frozenset[str], dict[str, int]]:
    """Parts that a model has, from the constraint rows that MJX allocates; and `Coverage.unreachable`."""
    rows: Any = scene.template._impl
    parts, unreachable = contact_parts(host) if len(rows.contact.dim) else (set(), {})
    parts |= {"limit"} if rows.nl else set()
    parts |= {"friction loss", "held", "slipping"} if rows.nf else set()
    parts |= {"equality"} if rows.ne and host.eq_active0.any() else set()
    return frozenset(parts), unreachable


class Reach:
    """Regions that a model's joints can bring its geoms to; joint limits are ignored, since they are soft."""

    def __init__(self, host: mujoco.MjModel):
        self._host, self._zero = host, mujoco.MjData(host)
        mujoco.mj_kinematics(host, self._zero)
        self._balls = functools.cache(self._bounding_balls)

    def touch(self, pair: ContactPair) -> bool:
        if self._host.nmocap:  # may move anything fixed
            return True
        plane = self._host.geom_type[pair.first] == _PLANE
        centre, radius = self._balls(pair.first if plane else None)
        first, second = pair.first, pair.second
        if plane:
            distance = self._normal(first) @ (centre[second] - self._zero.geom_xpos[first]) - radius[second]
        else:
            distance = np.linalg.norm(centre[second] - centre[first]) - radius[first] - radius[second]
        return bool(distance <= pair.margin)

    def slide(self, pair: ContactPair) -> bool:
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
            np.linalg.norm(zero.xaxis[joint] - (zero.xaxis[joint] @ normal) * normal) > ALIGNED_SINE for joint in joints
        )

    def _normal(self, plane: int) -> np.ndarray:
        return self._zero.geom_xmat[plane].reshape(3, 3)[:, 2]

    def _bounding_balls(self, plane: int | None) -> tuple[np.ndarray, np.ndarray]:
        """Bounding balls of geoms, centres (ngeom, 3) and radii (ngeom,) [m]; for a plane, only along its normal."""
        host, zero, normal = self._host, self._zero, None if plane is None else self._normal(plane)
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
                    along = normal is not None and not turning[body] and abs(zero.xaxis[joint] @ normal) <= ALIGNED_SINE
                    radius[body] += 0.0 if along else np.inf
                else:
                    radius[body] += np.inf if kind == _FREE else 2 * float(np.linalg.norm(host.jnt_pos[joint]))
                    turning[body] = True
        bodies = enumerate(host.geom_bodyid.tolist())
        balls = [follow(body, zero.geom_xpos[geom] - zero.xpos[body]) for geom, body in bodies]
        return np.array([ball for ball, _ in balls]), np.array([size for _, size in balls]) + host.geom_rbound


def contact_parts(host: mujoco.MjModel) -> tuple[set[str], dict[str, int]]:
    """Contact zones that may be reached, and those that cannot, with the number of pairs of geoms."""
    reach, had, within = Reach(host), Counter(), set()
    for pair in contact_pairs(host):
        had.update({"contact", *(("stick", "slide") if pair.slides else ("push",))})
        if reach.touch(pair):
            within |= {"contact", "separate", "stick" if pair.slides else "push"}
            within |= {"slide"} if pair.slides and reach.slide(pair) else set()
    out = {part: count for part, count in had.items() if part not in within}
    return within, {"contact": out["contact"]} if "contact" in out else out
