"""Rotations against SciPy and MJX, and their derivative at rest, where MJX's own is zero."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src import math as mjx_math
from scipy.spatial.transform import Rotation

from mjx_study.simulation import integration
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.integration import integrate_position, rotate_quaternion
from tests.scenes import central_jacobian, compiled, scene_of, split, step_flat

TIMESTEP = 0.004
FLOATING = f"""
<mujoco><option timestep="{TIMESTEP}" gravity="0 0 0"/><worldbody>
  <body><freejoint/><geom type="box" size=".1 .2 .3" mass="1"/></body>
  <body pos="1 0 0"><joint type="slide" axis="1 0 0"/><joint type="ball"/>
    <geom type="box" size=".3 .1 .2" mass="1" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>"""
RNG = np.random.default_rng(3)
AXES = [axis / np.linalg.norm(axis) for axis in RNG.normal(size=(4, 3))]
SWITCH = float(np.sqrt(integration._SMALL))
# On both sides of the switch from series to trigonometry, at rest, at denormal and at large angles [rad].
ANGLES = [0.0, 1e-300, 1e-160, 1e-9, 1e-4, 0.9999 * SWITCH, 1.0001 * SWITCH, 0.1, 1.0, 3.0, 7.0]


def unit_quaternion(seed: int) -> np.ndarray:
    quaternion = np.random.default_rng(seed).normal(size=4)
    return quaternion / np.linalg.norm(quaternion)


@pytest.fixture(scope="module")
def rotate():
    return jax.jit(rotate_quaternion)


@pytest.fixture(scope="module")
def jacobians():
    both = (0, 1)
    return jax.jit(
        lambda *args: (jax.jacfwd(rotate_quaternion, both)(*args), jax.jacrev(rotate_quaternion, both)(*args))
    )


@pytest.mark.parametrize("angle", ANGLES)
def test_values_are_scipys_and_mjxs(angle: float, rotate) -> None:
    for seed, axis in enumerate(AXES):
        start = unit_quaternion(seed)
        turned = np.asarray(rotate(start, angle * axis))
        composed = Rotation.from_quat(start, scalar_first=True) * Rotation.from_rotvec(angle * axis)
        expected = composed.as_quat(scalar_first=True)
        # Two products of four terms each below 1, and one normalisation: some ten roundings.
        np.testing.assert_allclose(turned, expected * np.sign(expected @ turned), rtol=0, atol=3e-15)
        theirs = mjx_math.quat_integrate(jnp.asarray(start), jnp.asarray(angle * axis), jnp.asarray(1.0))
        stopped = angle / 2 if angle < 1e-8 else 0.0  # MJX leaves out what turns slower
        np.testing.assert_allclose(turned, theirs, rtol=0, atol=3e-15 + stopped)
        assert abs(np.linalg.norm(turned) - 1) < 1e-15 * 2


def exact_derivative(rotation: np.ndarray) -> np.ndarray:
    """d exp(rotation / 2) / d rotation, (4, 3), in extended precision from power series of the angle squared."""
    rotation = rotation.astype(np.longdouble)
    square = np.longdouble(rotation @ rotation)
    # sin(a / 2) / a = sum term_n, term_n = (-s)^n / (2^(2n+1) (2n+1)!) and its derivative over s; s <= 49
    sine, slope = np.longdouble(0), np.longdouble(0)
    term, term_slope = np.longdouble(0.5), np.longdouble(-1) / 48
    for n in range(60):
        factor = -square / ((2 * n + 2) * (2 * n + 3) * 4)
        sine, slope = sine + term, slope + (n + 1) * term_slope
        term, term_slope = term * factor, term_slope * -square / ((2 * n + 4) * (2 * n + 5) * 4)
    # d cos(a / 2) / d rotation = -sin(a / 2) / 2 * rotation / a
    return np.vstack([-0.5 * sine * rotation, sine * np.eye(3) + 2 * slope * np.outer(rotation, rotation)]).astype(
        float
    )


@pytest.mark.parametrize("angle", ANGLES)
def test_derivatives_are_exact_across_the_switch(angle: float, jacobians) -> None:
    identity = np.array([1.0, 0.0, 0.0, 0.0])
    for axis in AXES:
        forward, reverse = jacobians(identity, angle * axis)
        exact = exact_derivative(angle * axis)
        # the trigonometric branch divides by the angle twice: a cancellation of up to eps / angle near the switch
        tolerance = 1e-15 + 4 * np.finfo(float).eps / max(angle, SWITCH)
        np.testing.assert_allclose(forward[1], exact, rtol=0, atol=tolerance)
        np.testing.assert_allclose(reverse[1], exact, rtol=0, atol=tolerance)
        assert np.all(np.isfinite(forward[0])) and np.all(np.isfinite(reverse[0]))


def test_derivative_with_respect_to_the_quaternion(jacobians, rotate) -> None:
    """Raw, off the unit sphere too: the product is normalised, as MJX does."""
    for angle in (0.0, 0.5 * SWITCH, 0.7):
        start, rotation = unit_quaternion(5), angle * AXES[0]
        numeric = central_jacobian(lambda q, rotation=rotation: rotate(q, rotation), start, 1e-3)
        # Richardson at 1e-3: (1e-3)^4 / 120 and 1e-16 / 1e-3
        for derivative in jacobians(start, rotation):
            np.testing.assert_allclose(derivative[0], numeric, rtol=0, atol=1e-11)


def test_every_joint_moves_as_in_mujoco() -> None:
    host = mujoco.MjModel.from_xml_string(FLOATING)
    qpos = np.concatenate([RNG.normal(size=3), unit_quaternion(7), RNG.normal(size=1), unit_quaternion(8)])
    qvel = 5 * RNG.normal(size=host.nv)
    ours = integrate_position(host, jnp.asarray(qpos), jnp.asarray(qvel), TIMESTEP)
    expected = qpos.copy()
    mujoco.mj_integratePos(host, expected, qvel, TIMESTEP)
    np.testing.assert_allclose(ours, expected, rtol=0, atol=3e-15)


@pytest.fixture(scope="module")
def floating():
    """Our step, its Jacobian over (qpos, qvel) at rest, and its value and MJX's."""
    scene = scene_of(FLOATING)
    rest = jnp.concatenate([scene.template.qpos, jnp.zeros(scene.host.nv)])

    def ours(point):
        return step_flat(scene, scene.model, point, jnp.zeros(scene.host.nv))[0]

    def stock(point):
        qpos, qvel, *_ = split(scene, point)
        data = mjx.step(scene.model, scene.template.replace(qpos=qpos, qvel=qvel))
        return jnp.concatenate([data.qpos, data.qvel])

    found = compiled(lambda x: (jax.jacrev(ours)(x), ours(x), stock(x)), rest)(rest)
    return scene, rest, compiled(ours, rest), found


def angular(scene) -> list[tuple[int, int]]:
    """Rows of the quaternions' vector parts and columns of their angular velocities."""
    nq = scene.host.nq
    free = [(4 + i, nq + 3 + i) for i in range(3)]
    return free + [(9 + i, nq + 7 + i) for i in range(3)]


def test_at_rest_orientation_follows_angular_velocity(floating) -> None:
    """d qpos' / d angular velocity is half a timestep per component, by differences too."""
    scene, rest, step, (reverse, ours, stock) = floating
    np.testing.assert_allclose(ours, stock, rtol=0, atol=1e-15)
    numeric = central_jacobian(step, np.asarray(rest), 1e-2)
    for row, column in angular(scene):
        for jacobian in (reverse, numeric):
            assert jacobian[row, column] == pytest.approx(TIMESTEP / 2, rel=1e-9)
    # qpos' of order 1 with rounding 1e-16 over a step of 1e-2; the curvature over 1e-2 is Richardson's (1e-2)^4
    np.testing.assert_allclose(reverse, numeric, rtol=0, atol=1e-8)
