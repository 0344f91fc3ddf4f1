"""States at which to check a step, from a rollout and its initial state, chosen to exercise the whole model."""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Final

import mujoco
import numpy as np

from mjx_study.gradcheck.coverage import OPTIONAL, Coverage, count_coverage, exercised, possible
from mjx_study.gradcheck.engine_step import forward
from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.engine import HostState, converged_host, host_data, host_state
from mjx_study.simulation.scene import Scene

SPEED: Final = 0.1
"""Standard deviation of sampled initial velocities [m/s or rad/s]: small, but nothing is at rest or at a tie."""
FASTER: Final = (1.0, 5.0)  # standard deviations in rollouts that search for parts the first did not reach
PUSHES: Final = 10  # number of times that new velocities and controls are drawn in such a rollout
CONTROL: Final = 0.3
"""Largest deviation of sampled controls, relative to half their range; absolute for unlimited controls."""
POSES: Final = 30  # number of random poses tried for parts that no rollout reached
FALL: Final = 50  # number of steps of the rollout from each pose
MAX_EXCESS: Final = 0.01  # largest excess of a pose beyond a limit, relative to the range
LOOK: Final = 200  # number of states searched at once for one that exercises a missing part

_SCALAR: Final = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))


@dataclasses.dataclass(frozen=True, eq=False)
class Sample:
    """A state to check, `index` steps after the start of its rollout, with the parts of the model that it exercises."""

    label: str
    index: int
    state: HostState
    parts: frozenset[str]


def start_of(scene: Scene) -> HostState:
    """The model's first keyframe, or its reference pose at rest."""
    data = mujoco.MjData(scene.host)
    if scene.host.nkey:
        mujoco.mj_resetDataKeyframe(scene.host, data, 0)
    return host_state(data)


def states_of(
    scene: Scene,
    contact: ContactModel | None,
    count: int,
    horizon: int,
    seed: int,
    visited: Sequence[HostState] | None = None,
) -> tuple[list[Sample], Coverage]:
    """Choose `count` states, and report the parts of the model that they exercise.

    The first is the initial state: rollouts start there, and most derivative faults show there. The others come from a
    rollout of `horizon` steps, the task's own (`visited`) or one in the C engine with small random velocities and
    controls, evenly spaced over its steps, those with active constraints first. If they leave parts of the model
    unexercised, they are replaced by states that exercise them, from faster rollouts with repeated pushes and from
    random poses within the joint limits.
    """
    host = converged_host(scene, contact)
    random = np.random.default_rng(seed)
    parts, unreachable = possible(scene, host)
    start = start_of(scene) if visited is None else visited[0]
    at_rest = ", at rest" if visited is None and not start.qvel.any() else ""
    first = Sample(f"start{at_rest}", 0, start, exercised(forward(host, start)))
    if visited is None:
        rollout = list(_rollout(host, _stirred(host, start, random, SPEED, CONTROL), horizon))
    else:
        rollout = [
            Sample(f"step {index}", index, state, exercised(forward(host, state)))
            for index, state in enumerate(visited)
        ]
    chosen = _cover([first], rollout[1:], parts - OPTIONAL, count)
    chosen = _cover(chosen, _elsewhere(host, start, horizon, random), parts - OPTIONAL, count)
    rest = [sample for sample in rollout[1:] if sample not in chosen]
    for pool in ([sample for sample in rest if sample.parts], [sample for sample in rest if not sample.parts]):
        chosen += _even(pool, count - len(chosen))
    chosen += itertools.islice(_elsewhere(host, start, horizon, random), count - len(chosen))
    chosen[1:] = sorted(chosen[1:], key=lambda sample: (len(sample.label.split(",")), sample.index))
    return chosen, count_coverage(parts, [sample.parts for sample in chosen], unreachable)


def _cover(chosen: list[Sample], pool: Iterable[Sample], wanted: frozenset[str], count: int) -> list[Sample]:
    """Add samples from a pool, up to `count` in all, until they exercise all wanted parts that the pool offers."""
    chosen, seen = list(chosen), []
    iterator = iter(pool)
    while len(chosen) < count and (missing := wanted.difference(*(sample.parts for sample in chosen))):
        # read a single rollout to its end, but a longer pool only until something helps
        while not any(sample.parts & missing for sample in seen):
            more = list(itertools.islice(iterator, LOOK))
            if not more:
                return chosen
            seen += more
        most = max(len(sample.parts & missing) for sample in seen)
        best = [sample for sample in seen if len(sample.parts & missing) == most]
        chosen.append(best[len(best) // 2])  # the middle one, far from where the part becomes active
    return chosen


def _even(samples: list[Sample], count: int) -> list[Sample]:
    if count >= len(samples):
        return samples
    return [samples[int(round(index))] for index in np.linspace(0, len(samples) - 1, count + 2)[1:-1]]


def _elsewhere(host: mujoco.MjModel, start: HostState, horizon: int, random: np.random.Generator) -> Iterator[Sample]:
    """Yield states that a rollout from the initial state does not reach."""
    for speed in FASTER:
        push = partial(_stirred, host, random=random, speed=speed)
        yield from _rollout(host, start, horizon, f", pushed to {speed:g}", push)
    for number in range(POSES):
        pose = _stirred(host, _posed(host, start, random), random, FASTER[number % len(FASTER)])
        yield from _rollout(host, pose, FALL, f", from pose {number}")


def _rollout(
    host: mujoco.MjModel,
    start: HostState,
    horizon: int,
    label: str = "",
    push: Callable[[HostState], HostState] | None = None,
) -> Iterator[Sample]:
    """Yield the states of a rollout in the C engine while it stays finite, with `PUSHES` pushes if any."""
    data = host_data(host, start)
    for index in range(horizon):
        if push is not None and index % max(horizon // PUSHES, 1) == 0:
            data = host_data(host, push(host_state(data)))
        before = host_state(data)
        mujoco.mj_step(host, data)
        if not np.all(np.isfinite(data.qpos)) or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            return
        yield Sample(f"step {index}{label}", index, before, exercised(data))


def _stirred(
    host: mujoco.MjModel, state: HostState, random: np.random.Generator, speed: float, control: float = 1.0
) -> HostState:
    """Return the state with new random velocities, controls and activations."""
    low, high = host.actuator_ctrlrange.T
    limited = host.actuator_ctrllimited.astype(bool)
    spread = control * np.where(limited, (high - low) / 2, 1.0)
    middle = np.where(limited, np.clip(state.control, low + spread, high - spread), state.control)
    return dataclasses.replace(
        state,
        qvel=state.qvel + speed * random.normal(size=host.nv),
        control=middle + spread * random.uniform(-1, 1, size=host.nu),
        act=state.act + 0.1 * np.abs(random.normal(size=host.na)),
    )


def _posed(host: mujoco.MjModel, state: HostState, random: np.random.Generator) -> HostState:
    """Return the state with every limited slide and hinge somewhere in its range, or slightly beyond."""
    qpos = state.qpos.copy()
    for joint in np.flatnonzero(host.jnt_limited & np.isin(host.jnt_type, _SCALAR)):
        low, high = host.jnt_range[joint]
        share = random.choice([-MAX_EXCESS, 1 + MAX_EXCESS, random.uniform()])
        qpos[host.jnt_qposadr[joint]] = low + share * (high - low)
    return dataclasses.replace(state, qpos=qpos)
