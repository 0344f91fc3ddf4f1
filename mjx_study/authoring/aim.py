"""What a task asks of a model: which body should be where, at the end of a rollout.

The body is one that noise moves: the load that a driven model pushes, else the trunk of one that walks, else the tip of
its longest chain. The goal is as far from where it ends by itself as held controls typically take it.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Final

import mujoco
import numpy as np

from mjx_study.authoring.trial import Drive, Trial, moments_of, start_of

MOVED: Final = 1e-6  # spread of an end that counts as moved by noise [m or rad]
TYPICAL: Final = 1.5
"""Standard deviation of normal numbers in median absolute deviations; a single fall or throw does not count."""
LEAST: Final = 0.02  # least distance of a goal, in extents of the model, or of a body's own coordinate [rad]
HINGE: Final = int(mujoco.mjtJoint.mjJNT_HINGE)
BEYOND: Final = 0.25  # share of that distance over which held controls must move a body for it to have a goal
REACHED: Final = 0.25
"""Share of the ends under held controls from which on a side counts as within reach; else the goal is on the other."""
FORWARD: Final = 0.3
"""Share of the greatest spread along an axis from which on the x axis is preferred, and others may be chosen."""


@dataclasses.dataclass(frozen=True)
class Aim:
    """Where something should end.

    Attributes:
        body: index of the body whose centre of mass is to move; None for a coordinate of qpos.
        axis: axis of the world (0 to 2), or index in qpos.
        end: where it ends by itself [m, or unit of qpos]; all three axes for a body.
        distance, side: how far the goal is from there along the axis, and its direction, 1 or -1.
    """

    body: int | None
    role: str
    axis: int
    end: tuple[float, ...]
    distance: float
    side: int = 1

    @property
    def goal(self) -> tuple[float, ...]:
        moved = self.axis if self.body is not None else 0
        return tuple(
            rounded(value + self.side * self.distance * (place == moved)) for place, value in enumerate(self.end)
        )

    def misses(self, trial: Trial, steps: int) -> float:
        """Squared distance from the goal, in units of the distance."""
        ends = trial.qpos[steps, [self.axis]] if self.body is None else trial.centres[steps, self.body]
        return float(np.sum((ends - np.array(self.goal)) ** 2)) / self.distance**2


def rounded(value: float, digits: int = 3) -> float:
    """A value with so many significant digits."""
    return float(f"{value:.{digits}g}")


def choose_aim(drive: Drive, quiet: Trial, noisy: Sequence[Trial], held: Sequence[Trial], steps: int) -> Aim | None:
    """The first of the candidates that noise moves, by rollouts without noise, with it, and with large constant
    changes, up to some step; None if it moves nothing."""
    for body, role in _candidates(drive):
        ends, far = (np.array([each.centres[steps, body] for each in trials]) for trials in (noisy, held))
        spread = TYPICAL * np.median(np.abs(far - np.median(far, axis=0)), axis=0)
        hardly = np.ptp(far, axis=0).max() < BEYOND * LEAST * drive.host.stat.extent  # as of a wheel on its axle
        if hardly and (aim := _coordinate(quiet, noisy, held, steps, _own_hinges(drive.host, body), LEAST)):
            return aim
        near = np.std(ends, axis=0)
        if not hardly and near.max() > MOVED:
            along = spread * (near >= FORWARD * near.max())  # a stretched arm moves sideways first
            axis = 0 if along[0] >= FORWARD * along.max() else int(np.argmax(along))
            end = tuple((np.round(quiet.centres[steps, body], 9) + 0.0).tolist())  # without what rounding leaves of 0
            distance = rounded(max(spread[axis], LEAST * drive.host.stat.extent), 1)
            return Aim(body, role, axis, end, distance, _side(far[:, axis], end[axis]))
    return _coordinate(quiet, noisy, held, steps, range(drive.host.nq))


def _coordinate(
    quiet: Trial, noisy: Sequence[Trial], held: Sequence[Trial], steps: int, among: Sequence[int], least: float = MOVED
) -> Aim | None:
    """The coordinate among some that noise moves most; None if it moves none, or held controls less than the least."""
    if not among:
        return None
    ends, far = (np.array([each.qpos[steps] for each in trials]) for trials in (noisy, held))
    axis = max(among, key=lambda each: float(np.std(ends[:, each])))
    if np.std(ends[:, axis]) <= MOVED or np.std(far[:, axis]) <= least:
        return None
    end, distance = round(float(quiet.qpos[steps, axis]), 9) + 0.0, rounded(float(np.std(far[:, axis])), 1)
    return Aim(None, "coordinate", axis, (end,), distance, _side(far[:, axis], end))


def _own_hinges(host: mujoco.MjModel, body: int) -> list[int]:
    """Indices in qpos of a body's hinges."""
    joints = range(host.body_jntadr[body], host.body_jntadr[body] + host.body_jntnum[body])
    return [int(host.jnt_qposadr[each]) for each in joints if host.jnt_type[each] == HINGE]


def _side(ends: np.ndarray, end: float) -> int:
    """The side on which a goal is within reach: forward, unless hardly any rollout ends there."""
    return 1 if np.mean(ends > end) >= REACHED else -1


def _candidates(drive: Drive) -> Iterator[tuple[int, str]]:
    """Bodies that a task may be about, the best first."""
    host, driven = drive.host, (moments_of(start_of(drive.host)) != 0).any(axis=0)
    dofs = {root: np.flatnonzero(host.body_rootid[host.dof_bodyid] == root) for root in set(host.body_rootid[1:])}
    moving = sorted(int(root) for root, own in dofs.items() if len(own))
    if not drive.at_start:
        yield from ((root, "load") for root in moving if not driven[dofs[root]].any())
    for root in moving:
        own = np.flatnonzero(host.dof_bodyid == root)
        if len(own) and not driven[own].any():
            yield root, "body" if drive.at_start else "trunk"
    depth = np.zeros(host.nbody, int)
    for body in range(1, host.nbody):
        depth[body] = depth[host.body_parentid[body]] + 1
    yield from ((int(body), "tip") for body in np.argsort(-depth, kind="stable") if host.body_rootid[body] in moving)
