"""Each task's physics in MJX against its analytic reference, and the rate at which they meet.

A contact of stiffness K lasts pi sqrt(m / K) and gives way by v sqrt(m / K), so what it changes against a rigid one
falls as 1 / sqrt(K); a rollout's compilation serves all stiffnesses of a task.
"""

import math
import re
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from estimators.noise import split_sample_key
from mjx_study.objective import simulate
from mjx_study.reference import BallWall, MomentumTransfer, SlidingBox, Tennis, draw_start, roll_out
from mjx_study.simulation.contact import ContactModel, ContactWarning
from mjx_study.tasks import make_task, task_with_options
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

BATCH = 7
CRITICAL_RESTITUTION = math.exp(-2)
"""Of a critically damped spring that lets go when its force ends."""


def rollouts(task: Task) -> Callable[..., Any]:
    """Noise-free rollouts as a function of parameters (batch, params) and contact model, compiled once."""
    program = jax.jit(
        jax.vmap(lambda theta, contact: simulate(task, theta, contact, jax.random.key(0), 0.0), in_axes=(0, None)),
        compiler_options={"xla_backend_optimization_level": "0"},
    )

    def run(theta, contact):
        size = len(theta)
        assert size <= BATCH
        found = program(jnp.resize(theta, (BATCH, theta.shape[1])), contact)
        return jax.tree.map(lambda leaf: leaf[:size], found)

    return run


def contact(task: Task, family: str, stiffness: float) -> ContactModel:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactWarning)
        ((cell,), _) = family_grid(task, [family], [stiffness])
    assert cell.contact is not None
    return cell.contact


def rate(errors: np.ndarray, stiffness: tuple[float, ...]) -> np.ndarray:
    """Exponents p of error ~ K^p between neighbouring stiffnesses."""
    return np.diff(np.log(errors)) / np.diff(np.log(np.array(stiffness)))


OUT_OF_CONTACT = {  # coordinates, where these and their velocities are in the reference's state, and its unit of time
    "pusher": ([-1.0, 1.0], [0, 1], 1.0),
    "sliding_box": ([0.5, 0.0, 0.0], [0, 2], 1.0),
    "tennis": ([0.0, 2.0, 0.0, 0.0, 0.0], [0, 1], 10.0),
}


@pytest.mark.parametrize("name", OUT_OF_CONTACT)
def test_a_reference_has_the_timestep_mass_and_damping_of_its_task(name: str, tmp_path: Path) -> None:
    """One step of MuJoCo's is the reference's, and rollouts take as long."""
    qpos, kept, scale = OUT_OF_CONTACT[name]
    source = (Path(__file__).parents[1] / "models" / f"{name}.xml").read_text()
    (tmp_path / "other.xml").write_text(re.sub(r'mass="(0\.1|1)"', 'mass="0.3"', source))
    task = task_with_options(name, {"timestep": 0.0025, "model": str(tmp_path / "other.xml")})
    reference, data = task.analytic(1000.0), mujoco.MjData(task.scene.host)
    data.qpos[:], data.qvel[kept] = qpos, (0.7, -0.2)
    state, control = np.zeros(reference.system.num_states), np.zeros(task.scene.host.nu)
    state[:2], state[2:4] = data.qpos[kept], data.qvel[kept] / scale
    control[0] = data.ctrl[0] = 0.1
    mujoco.mj_step(task.scene.host, data)
    np.testing.assert_allclose(reference.system.step(state, control)[2:4], data.qvel[kept] / scale, rtol=1e-12)
    assert reference.horizon == task.horizon == 2 * make_task(name).horizon
    assert vars(reference.system)["timestep"] == pytest.approx(scale * task.scene.timestep)


# The ball and the wall


@cache
def thrown() -> tuple[Task, Callable[..., Any]]:
    task = make_task("ball_wall", timestep=0.001, horizon=800)
    return task, rollouts(task)


def test_the_ball_lands_where_it_should() -> None:
    """Short of the wall and beyond it, in the paper's lengths; the error falls with the stiffness."""
    task, run = thrown()
    angles = np.array([0.15, 0.2, 0.25, 0.85, 0.9, 0.95, 1.0])[:, None]
    landing = np.sqrt(-BallWall().value(angles))
    errors = []
    for stiffness in (3000.0, 30000.0):
        states, *_ = run(jnp.asarray(angles), contact(task, "mujoco", stiffness))
        errors.append(np.abs(np.asarray(states.qpos)[:, -1, 0] / 10 - landing))
    assert np.all(errors[0] < 3e-3) and np.all(errors[1] < 8e-4)  # 30 mm and 8 mm of 1 m
    assert np.all(errors[1] < 0.5 * errors[0])


def test_the_wall_stops_the_ball_and_its_top_is_real() -> None:
    task, run = thrown()
    angles = np.array([0.45, 0.55, 0.7, 0.9])[:, None]
    states, *_ = run(jnp.asarray(angles), contact(task, "mujoco", 30000.0))
    x, z = np.asarray(states.qpos)[:, -1].T
    np.testing.assert_allclose(x[:2], 0.6, atol=0.08)  # dropped at the wall's face, less a small bounce
    np.testing.assert_allclose(z[:2], 0, atol=2e-3)
    assert z[2] == pytest.approx(0.2, abs=2e-3) and 0.6 < x[2] < 0.74  # came to rest on top of the wall
    assert x[3] > 0.9  # cleared it


@pytest.mark.slow
def test_on_the_dome_the_bounce_turns_with_the_angle() -> None:
    """A flat face throws all of these back alike; the round top throws them up, the more the higher they meet it."""
    angles = np.linspace(0.56, 0.62, 7)[:, None]
    spread = {}
    for variant in ("ball_wall", "ball_wall:dome"):
        task = make_task(variant, timestep=0.001, horizon=400)
        states, *_ = rollouts(task)(jnp.asarray(angles), contact(task, "mujoco", 30000.0))
        spread[variant] = np.ptp(np.asarray(states.qvel)[:, 300, 1])  # of the upward speed soon after the hit
    assert spread["ball_wall:dome"] > 2.5 * spread["ball_wall"]


# The ball and the bar


@cache
def shot() -> tuple[Task, Callable[..., Any]]:
    task = make_task("momentum_transfer", timestep=0.0005, horizon=1400)
    return task, rollouts(task)


@pytest.mark.parametrize(("family", "restitution"), [("penalty", 1.0), ("mujoco", CRITICAL_RESTITUTION)])
def test_transferred_momentum(family: str, restitution: float) -> None:
    """An undamped spring is elastic; with critical damping e = exp(-2), up to what the impedance of 0.95 takes."""
    task, run = shot()
    angles = np.array([0.1, 0.3, 0.5, 0.7])[:, None]
    closed = np.sqrt(-MomentumTransfer(restitution=restitution, inertia_ratio=0.1).value(angles))
    stiffnesses = (10000.0, 100000.0)
    errors = []
    for stiffness in stiffnesses:
        _, _, cost, residual = run(jnp.asarray(angles), contact(task, family, stiffness))
        errors.append(np.sqrt(-np.asarray(cost)) / closed - 1)
        assert np.max(residual) < 1e-8
    if family == "penalty":
        assert np.all(np.abs(errors[0]) < 0.05) and np.all(np.abs(errors[1]) < 0.016)
        np.testing.assert_allclose(rate(np.abs(np.array(errors)).mean(axis=1), stiffnesses), -0.5, atol=0.1)
    else:
        assert np.all(np.abs(errors[0]) < 0.015)


def test_past_its_end_the_ball_misses_the_bar() -> None:
    task, run = shot()
    _, _, cost, _ = run(jnp.array([[0.7], [0.85], [1.0]]), contact(task, "penalty", 10000.0))
    assert cost[0] < -1 and cost[1] == cost[2] == 0


# The block on the box


@cache
def dragged() -> tuple[Task, Callable[..., Any]]:
    task = make_task("sliding_box", horizon=200)
    return task, rollouts(task)


FORCES = {
    "creeps": np.full(200, 0.1),
    "creeps fast": np.full(200, 0.3),
    "to and fro": 0.15 * np.sin(0.05 * np.arange(200)),
    "slides off": np.full(200, 0.6),
}


def test_the_box_is_dragged_as_in_the_reference() -> None:
    """Penalty contact with 1.8 N s/m is the paper's friction: below the limit, where the normal force plays no part."""
    task, run = dragged()
    forces = np.stack(list(FORCES.values()))
    closed = roll_out(SlidingBox(), np.zeros(4), forces[..., None]).states[:, -1]
    states, *_ = run(jnp.asarray(forces), contact(task, "penalty", 1000.0))
    found = np.concatenate([np.asarray(states.qpos)[:, -1, [0, 2]], np.asarray(states.qvel)[:, -1, [0, 2]]], axis=1)
    errors = np.abs(found - closed).max(axis=1)
    assert errors[0] < 5e-5 and errors[2] < 5e-5 and errors[1] < 2e-3
    assert errors[3] < 0.02  # sliding: the normal force rings about the weight, and the foot rounds the edge


def test_past_the_edge_the_block_falls_and_the_box_is_free() -> None:
    task, run = dragged()
    states, *_ = run(jnp.asarray(FORCES["slides off"])[None], contact(task, "mujoco", 500.0))
    (height,), (box,) = np.asarray(states.qpos)[:, :, 1], np.asarray(states.qvel)[:, :, 2]
    gone = int(np.argmax(height < -0.05))
    assert 0 < gone < 120
    fallen = task.scene.timestep * (200 - gone)
    assert height[-1] - height[gone] < -0.9 * 9.81 / 2 * fallen**2
    np.testing.assert_allclose(box[gone + 20 :], box[-1], rtol=1e-12)


def test_a_stiff_damper_creeps_less() -> None:
    """The slip tolerance is the contact's damping: twice the damping, half the slip."""
    task, run = dragged()
    slips = []
    for damping in (1.8, 3.6):
        ((cell,), _) = family_grid(task, ["penalty"], [1000.0], damping)
        states, *_ = run(jnp.asarray(FORCES["creeps"])[None], cell.contact)
        velocity = np.asarray(states.qvel)[0, -1]
        slips.append(velocity[0] - velocity[2])
    assert slips[0] == pytest.approx(0.05 / 1.8, rel=0.01)  # half the force accelerates the box
    assert slips[0] / slips[1] == pytest.approx(2, rel=0.01)


# Tennis


@pytest.mark.slow
def test_balls_bounce_as_in_the_reference() -> None:
    """64 starts and a policy that reaches every ball: where the ball ends, an error that falls as 1 / sqrt(K)."""
    task = make_task("tennis")
    gains = np.zeros((3, 7))
    gains[0, 0], gains[0, 4], gains[2, 0] = 1.5, -1.5, 0.05
    keys = jax.random.key_data(jax.random.split(jax.random.key(3), 64))

    def play(key_data, contact):
        return simulate(task, jnp.asarray(gains.ravel()), contact, jax.random.wrap_key_data(key_data), 0.0)

    run = jax.jit(jax.vmap(play, in_axes=(0, None)), compiler_options={"xla_backend_optimization_level": "0"})
    starts = np.stack([np.asarray(draw_start(split_sample_key(jax.random.wrap_key_data(key))[0])) for key in keys])
    closed = roll_out(Tennis(), starts, np.zeros((64, task.horizon, 3)), gains).states[:, -1]
    assert np.all(closed[:, 3] > 0), "every ball is hit"
    stiffnesses = (1000.0, 4000.0, 16000.0)
    errors = []
    for stiffness in stiffnesses:
        states, *_ = run(keys, contact(task, "penalty", stiffness))
        errors.append(np.median(np.linalg.norm(np.asarray(states.qpos)[:, -1, :2] - closed[:, :2], axis=1)))
        speed = np.linalg.norm(np.asarray(states.qvel)[:, -1, :2], axis=1) / 10
        if stiffness == stiffnesses[-1]:
            np.testing.assert_allclose(np.median(speed / np.linalg.norm(closed[:, 2:4], axis=1)), 1, atol=0.03)
    np.testing.assert_allclose(rate(np.array(errors), stiffnesses), -0.5, atol=0.1)


# The double pendulum


@pytest.mark.slow
def test_the_pendulum_is_the_reference() -> None:
    """The same equations of motion and Runge-Kutta steps; chaos multiplies the 1e-14 kg m^2 of MuJoCo's points."""
    task = make_task("double_pendulum", horizon=500)
    assert task.reference is not None
    reference = task.reference(0.0)
    exact, slope = reference.value_and_gradient(task.theta, jax.random.key(0))

    def cost(theta):
        return simulate(task, theta, None, jax.random.key(0), 0.0)[2]

    value, gradient = jax.jit(jax.value_and_grad(cost), compiler_options={"xla_backend_optimization_level": "0"})(
        task.theta
    )
    assert float(value) == pytest.approx(exact, rel=1e-8)
    np.testing.assert_allclose(gradient, slope, rtol=1e-7)
