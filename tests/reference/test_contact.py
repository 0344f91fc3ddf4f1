"""Contact of the pusher and of the sliding box as laws of nature; their numbers are in `test_published`."""

import numpy as np
import pytest

from mjx_study.reference import Pusher, SlidingBox, roll_out
from tests.pusher_fixtures import HORIZON, INPUTS, START


def test_equal_masses_exchange_their_velocities():
    """An elastic collision, up to the integrator's error: its order is measured."""
    errors = []
    for halvings in range(3):
        system = Pusher(100.0, timestep=1e-3 / 2**halvings, damping=1.0)
        states = roll_out(system, np.array([0.0, 1.1, 2.0, -1.0]), np.zeros((300 * 2**halvings, 1))).states
        assert states[-1, 1] - states[-1, 0] > 1  # they met and parted
        errors.append(np.abs(states[-1, 2:] - [-1.0, 2.0]).max())
    assert errors[0] < 0.05 and errors[2] < errors[0]


@pytest.mark.parametrize("stiffness", [10.0, 1e4])
def test_momentum_balance(stiffness):
    """Contact is internal: total momentum follows p' = damping p + h u whatever the stiffness, even an unstable one."""
    system, controls = Pusher(stiffness), INPUTS["reversing"]
    states = roll_out(system, START, controls).states
    momentum = system.mass * states[:, 2:].sum(axis=1)
    expected = [0.0]
    for control in controls[:, 0]:
        expected.append(system.damping * expected[-1] + system.timestep * control)
    size = system.mass * np.abs(states[:, 2:]).max()
    np.testing.assert_allclose(momentum, expected, rtol=0, atol=HORIZON * np.finfo(float).eps * size)
    assert np.abs(states[:, 2] - states[:, 3]).max() > 0.05 * np.abs(states[:, 2:]).max()  # they do exchange it


def test_contact_only_pushes():
    pulled = roll_out(Pusher(1000.0), START, np.full((50, 1), -1.0)).states
    np.testing.assert_array_equal(pulled[:, [1, 3]], np.broadcast_to([1.0, 0.0], (51, 2)))
    assert pulled[-1, 0] < -0.1


def test_friction_is_internal_and_limited():
    """Total momentum follows the force alone; the box is never driven by more than mu v_s."""
    system, rng = SlidingBox(), np.random.default_rng(0)
    controls = 0.3 + 0.3 * rng.standard_normal((400, 1))
    states = roll_out(system, np.zeros(4), controls).states
    momentum = system.mass * states[:, 2:].sum(axis=1)
    np.testing.assert_allclose(momentum[1:], system.timestep * np.cumsum(controls), rtol=1e-12)
    force = system.mass * np.diff(states[:, 3]) / system.timestep
    assert np.abs(force).max() == pytest.approx(system.viscosity * system.slip_tolerance)
    assert np.all(force[~system.on_box(states[:-1])] == 0) and not system.on_box(states).all()
