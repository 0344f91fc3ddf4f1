"""A task made from an MJCF alone, with the displacement of its bodies as cost."""

import dataclasses
from pathlib import Path
from typing import Final

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_study.choices import CHECKED_STEPS
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.engine import HostState, host_data, quiet_engine
from mjx_study.simulation.scene import Scene, SceneOption, load_scene
from mjx_study.tasks.policy import InitialStatePolicy, OpenLoop
from mjx_study.tasks.task import StudyDefaults, Task

NOISE: Final = 0.1  # share of the middle actuator's half range, or [m/s, rad/s] for initial velocities
MIN_MOTION: Final = 1e-9  # displacement that counts as motion [m or rad]
_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)


def mjcf_task(path: str | Path, *, horizon: int = CHECKED_STEPS, **scene_options: SceneOption) -> Task:
    """Make a task from a file; see `scene_task`."""
    return scene_task(load_scene(path, **scene_options), horizon=horizon)


def scene_task(scene: Scene, *, horizon: int = CHECKED_STEPS, pair: tuple[str, str] | None = None) -> Task:
    """Make a task with half the squared final displacement of free bodies as cost, or of joints if none is free.

    The initial state is the first keyframe or the reference pose. The parameters are the controls of every step,
    initially the keyframe's; without actuators, increments of the initial velocity. If nothing moves then, so that the
    cost has no gradient, all parameters are raised by one standard deviation of the noise.

    Args:
        pair: names of the two geoms whose contact stiffness is swept, or None.

    Raises:
        ValueError: nothing in the scene can move.
    """
    host, dtype = scene.host, scene.template.qpos.dtype
    if host.nv == 0:
        raise ValueError(f"{scene.name} has no degree of freedom: there is nothing to study")
    key = host.nkey > 0
    keyframe = map(jnp.asarray, (host.key_qpos[0], host.key_qvel[0], host.key_act[0])) if key else ()
    start = initial_state(scene, *keyframe)
    measured, what = _measured(host)
    origin = start.qpos[measured]

    def push(start: State, change: Float[Array, " params"]) -> State:
        return dataclasses.replace(start, qvel=start.qvel + change)

    if host.nu:
        policy, changed = OpenLoop(horizon, host.nu), "controls"
        theta = np.tile(host.key_ctrl[0] if key else np.zeros(host.nu), horizon)
        limited = host.actuator_ctrllimited.astype(bool)
        half = np.diff(host.actuator_ctrlrange[limited], axis=1) / 2
        sigma = NOISE * float(np.median(half)) if limited.any() else NOISE
    else:
        policy, changed = InitialStatePolicy(host.nv, horizon, 0, push, _unit_of_velocities(host)), "initial velocities"
        theta, sigma = np.zeros(host.nv), NOISE
    cost = f"half the squared displacement of {what} after {horizon} steps; parameters: the {changed}"
    if _rests(host, start, theta[: host.nu], horizon, measured):
        theta, cost = theta + sigma, f"{cost}, which are raised by {sigma:g} since nothing moves otherwise"
    return Task(
        name=scene.name,
        description=cost,
        scene=scene,
        horizon=horizon,
        policy=policy,
        theta=jnp.asarray(theta, dtype),
        sigma=sigma,
        start=start,
        final_cost=lambda state: jnp.sum((state.qpos[measured] - origin) ** 2) / 2,
        contact_pair=pair,
        defaults=StudyDefaults(families=("mjcf",)),
    )


def _rests(host: mujoco.MjModel, start: State, control: np.ndarray, horizon: int, measured: np.ndarray) -> bool:
    """Whether the coordinates end where they begin under constant control, in the C engine."""
    parts = (np.asarray(part) for part in (start.qpos, start.qvel, start.act, control, start.warmstart))
    data = host_data(host, HostState(*parts))
    origin = data.qpos[measured].copy()
    with quiet_engine():
        for _ in range(horizon):
            mujoco.mj_step(host, data)
    return bool(np.all(np.abs(data.qpos[measured] - origin) < MIN_MOTION))


def _unit_of_velocities(host: mujoco.MjModel) -> str:
    kinds = set(host.jnt_type.tolist())
    linear = kinds & {int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_FREE)}
    angular = kinds - {int(mujoco.mjtJoint.mjJNT_SLIDE)}
    return " or ".join(["m/s"] * bool(linear) + ["rad/s"] * bool(angular))


def _measured(host: mujoco.MjModel) -> tuple[np.ndarray, str]:
    """Indices in qpos of the coordinates whose displacement is the cost, and a description of them."""
    free, balls = (host.jnt_qposadr[host.jnt_type == kind] for kind in (_FREE, _BALL))
    scalar = np.setdiff1d(host.jnt_qposadr, [*free, *balls])
    if len(free):
        return (free[:, None] + np.arange(3)).reshape(-1), _count(len(free), "free body", "free bodies")
    if len(scalar):
        return scalar, _count(len(scalar), "joint", "joints")
    # the vector part of the quaternion: half the angle if small
    return (balls[:, None] + np.arange(1, 4)).reshape(-1), _count(len(balls), "ball joint", "ball joints")


def _count(number: int, singular: str, plural: str) -> str:
    return f"the {singular}" if number == 1 else f"{number} {plural}"
