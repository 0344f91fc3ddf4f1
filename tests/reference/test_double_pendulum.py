"""The double pendulum against the physics it must obey."""

import numpy as np
import pytest

from mjx_study.reference import DoublePendulum, roll_out, value_and_gradients
from tests.pusher_fixtures import relative
from tests.reference.systems import differentiate

START = np.array([np.pi / 2, 0.0, 5.0, -5.0])
RNG = np.random.default_rng(0)
STATES = RNG.standard_normal((40, 4)) * [2.0, 2.0, 4.0, 4.0]


def simulate(system: DoublePendulum, duration: float, start: np.ndarray = START) -> np.ndarray:
    return roll_out(system, start, np.zeros((round(duration / system.timestep), 0))).states


def cartesian(state: np.ndarray, length: float) -> np.ndarray:
    """Positions of both masses, from the definition of the angles alone."""
    first, second = state[..., 0], state[..., 0] + state[..., 1]
    inner = length * np.stack([np.sin(first), -np.cos(first)], axis=-1)
    return np.stack([inner, inner + length * np.stack([np.sin(second), -np.cos(second)], axis=-1)], axis=-2)


def energy(system: DoublePendulum, state: np.ndarray) -> np.ndarray:
    """Kinetic and potential energy of the two points."""
    turned, rates = np.cumsum(state[..., :2], axis=-1)[..., None], np.cumsum(state[..., 2:], axis=-1)[..., None]
    swings = system.length * rates * np.concatenate([np.cos(turned), np.sin(turned)], axis=-1)
    kinetic = 0.5 * system.mass * np.sum(np.cumsum(swings, axis=-2) ** 2, axis=(-1, -2))
    return kinetic + system.mass * system.gravity * cartesian(state, system.length)[..., 1].sum(axis=-1)


def test_equations_of_motion_obey_newton():
    """In Cartesian terms, m a - m g is the rods' forces on the masses, which act along the rods."""
    system = DoublePendulum(length=0.7)
    rate = np.concatenate([STATES[:, 2:], system.accelerations(STATES)], axis=-1)

    def velocity(state):
        moved = np.concatenate([state[..., 2:], np.zeros_like(state[..., 2:])], axis=-1)
        return differentiate(lambda t: cartesian(state + t * moved, 0.7), 2e-3)

    acceleration = differentiate(lambda t: velocity(STATES + t * rate), 2e-3)
    force = system.mass * (acceleration + [0, system.gravity])
    position = cartesian(STATES, 0.7)
    outer = position[:, 1] - position[:, 0]

    def cross(a, b):
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]

    size = np.abs(force).max()
    np.testing.assert_allclose(cross(outer, force[:, 1]), 0, atol=1e-8 * size)  # the outer mass hangs on its rod alone
    np.testing.assert_allclose(cross(position[:, 0], force.sum(axis=1)), 0, atol=1e-8 * size)


def test_acceleration_jacobian():
    system = DoublePendulum()
    exact = system.acceleration_jacobian(STATES)
    for column, axis in enumerate(np.eye(4)):
        expected = differentiate(lambda shift, axis=axis: system.accelerations(STATES + shift * axis), 1e-3)
        assert relative(exact[..., column], expected) < 1e-9


def test_energy_drift_is_small_and_of_the_method_s_order():
    drifts = []
    for step in (0.004, 0.002, 0.001):
        system = DoublePendulum(timestep=step)
        energies = energy(system, simulate(system, 2.0))
        drifts.append(np.abs(energies - energies[0]).max())
    rates = np.log2(np.divide(drifts[:-1], drifts[1:]))
    assert drifts[-1] < 1e-7 * abs(energy(DoublePendulum(), START))
    assert np.all((rates > 3.7) & (rates < 5.3)), rates


def test_small_swings_have_the_frequencies_of_two_equal_pendulums():
    """omega^2 = (2 +- sqrt 2) g / l."""
    system = DoublePendulum(length=0.5)
    slope = system.acceleration_jacobian(np.zeros(4))[:, :2]
    frequencies = np.sort(-np.linalg.eigvals(slope).real)
    np.testing.assert_allclose(frequencies, (2 + np.array([-1, 1]) * np.sqrt(2)) * 9.81 / 0.5, rtol=1e-12)


def test_neighbours_part_while_the_gradient_stays_exact():
    """Chaos: over two seconds the gradient grows, and is still the derivative of the computed map."""
    system, direction = DoublePendulum(timestep=0.005), np.array([1.0, -0.5, 0.3, 0.2])
    sizes = []
    for steps in (20, 400):
        controls = np.zeros((steps, 0))
        _, gradients = value_and_gradients(system, START, controls)
        expected = differentiate(
            lambda shift, controls=controls: roll_out(system, START + shift * direction, controls).value, 1e-4
        )
        assert gradients.start @ direction == pytest.approx(expected, rel=1e-8)
        sizes.append(np.linalg.norm(gradients.start))
    assert sizes[1] > 5 * sizes[0]
