"""The double pendulum against the physics it must obey."""

import numpy as np

from mjx_study.reference import DoublePendulum, roll_out
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


def test_energy_drift_is_small_and_of_the_method_s_order():
    drifts = []
    for step in (0.004, 0.002, 0.001):
        system = DoublePendulum(timestep=step)
        energies = energy(system, simulate(system, 2.0))
        drifts.append(np.abs(energies - energies[0]).max())
    rates = np.log2(np.divide(drifts[:-1], drifts[1:]))
    assert drifts[-1] < 1e-7 * abs(energy(DoublePendulum(), START))
    assert np.all((rates > 3.7) & (rates < 5.3)), rates
