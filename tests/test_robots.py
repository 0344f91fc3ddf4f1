"""The tasks of robot scale, in the C engine, under the policy that a descent starts from."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.arm import GOAL, LENGTH, SPEED
from mjx_study.simulation.dynamics import State
from mjx_study.tasks import make_task
from mjx_study.tasks.landing import TORQUE
from mjx_study.tasks.task import Task


def played(task: Task, seed: int) -> tuple[np.ndarray, list[tuple[State, np.ndarray, np.ndarray]]]:
    """One rollout: whether each pair of geoms touches, by step; and states, controls and forces of the servos."""
    assert callable(task.start)
    model, state = task.scene.host, task.start(jax.random.key(seed))
    data, random = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos, data.qvel = state.qpos, state.qvel
    policy, touching, way = jax.jit(lambda state: task.policy.feedback(task.theta, state)), [], []
    for _ in range(task.horizon):
        state = dataclasses.replace(state, qpos=jnp.array(data.qpos), qvel=jnp.array(data.qvel))
        data.ctrl = policy(state) + task.sigma * random.standard_normal(model.nu)
        mujoco.mj_step(model, data)
        way.append((state, data.ctrl.copy(), data.actuator_force.copy()))
        touching.append({tuple(sorted(pair)) for pair in data.contact.geom.tolist()})
    pairs = sorted(set().union(*touching))
    return np.array([[pair in step for pair in pairs] for step in touching]), way


@pytest.mark.parametrize("name", ["gripper", "landing"])
def test_contact_is_made_and_broken(name: str) -> None:
    """Made by both tips or feet in every sample, with at most the eight onsets that are corrected; broken in most."""
    task, broken = make_task(name), 0
    for seed in range(3):
        touching, _ = played(task, seed)
        begins, ends = (np.sum(np.diff(touching.astype(int), axis=0) == sign, axis=0) for sign in (1, -1))
        assert not touching[0].any() and len(begins) == 2 and min(begins) >= 1 and sum(begins) <= 8, begins
        broken += sum(ends) >= 1
    assert broken >= 2


def test_the_torques_of_landing_are_the_servos() -> None:
    task = make_task("landing")
    assert callable(task.running_cost)
    for state, control, force in played(task, 0)[1][::20]:
        own = float(task.costs()[0](state, jnp.array(control))) * task.horizon
        assert own == pytest.approx(np.sum((force / TORQUE) ** 2), rel=1e-9)


def test_the_table_brakes_the_box_by_its_weight() -> None:
    """Friction 0.2 m g along each axis, and that times the mean distance from a square's centre about the vertical."""
    host = make_task("gripper").scene.host
    side = 2 * host.geom("box").size[0]
    arm = side * (math.sqrt(2) + math.asinh(1)) / 6
    assert host.dof_frictionloss[4:] == pytest.approx(
        0.2 * 9.81 * host.body("box").mass[0] * np.array([1, 1, arm]), rel=0.02
    )
    _, way = played(make_task("gripper"), 0)
    assert np.abs(way[-1][0].qpos[4:6]).max() > 0.02


def test_an_arm_knocks_its_box_towards_the_goal() -> None:
    """The knuckle touches the box, which starts apart, moves on and stays flat on the floor; costs see C's bodies."""
    task = make_task("experiments.arm:push")
    host = task.scene.host
    for seed in range(3):
        touching, way = played(task, seed)
        first, last = way[0][0], way[-1][0]
        data = mujoco.MjData(host)
        data.qpos, data.qvel = last.qpos, last.qvel
        mujoco.mj_forward(host, data)
        assert not touching[0].all() and touching.any(axis=0).all()
        assert float(last.qpos[7] - first.qpos[7]) > 0.03 and data.body("box").xmat[8] > 0.99
        miss = np.sum((data.body("box").xpos[:2] - np.array(GOAL)) ** 2) / LENGTH**2
        expected = miss + np.sum(np.asarray(last.qvel[7:10]) ** 2) / SPEED**2
        assert float(task.costs()[1](last)) == pytest.approx(expected, rel=1e-9)
