"""The pusher's contact as a law of nature: it conserves momentum."""

import numpy as np
import pytest

from mjx_study.reference import Pusher, roll_out


@pytest.mark.parametrize("stiffness", [10.0, 1000.0])
def test_momentum_is_conserved_without_damping_and_force(stiffness: float):
    system = Pusher(stiffness, damping=1.0)
    states = roll_out(system, np.array([0.0, 1.1, 2.0, -1.0]), np.zeros((200, 1))).states
    momentum = system.mass * states[:, 2:].sum(axis=1)
    np.testing.assert_allclose(momentum, momentum[0], rtol=0, atol=200 * np.finfo(float).eps * system.mass * 3)
    assert states[-1, 2] < 0 < states[-1, 3] and states[-1, 1] - states[-1, 0] > 1  # they met and parted


def test_equal_masses_exchange_their_velocities():
    """An elastic collision, up to the integrator's error: its order is measured."""
    errors = []
    for halvings in range(3):
        system = Pusher(100.0, timestep=1e-3 / 2**halvings, damping=1.0)
        states = roll_out(system, np.array([0.0, 1.1, 2.0, -1.0]), np.zeros((300 * 2**halvings, 1))).states
        errors.append(np.abs(states[-1, 2:] - [-1.0, 2.0]).max())
    assert errors[0] < 0.05 and errors[2] < errors[0]
