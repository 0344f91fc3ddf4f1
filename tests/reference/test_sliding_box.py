"""The sliding box as a law of nature; its numbers are in `test_published`."""

import numpy as np
import pytest

from mjx_study.reference import SlidingBox, roll_out

HORIZON = 400
START = np.zeros(4)


def test_friction_is_internal_and_limited():
    """Total momentum follows the force alone; the box is never driven by more than mu v_s."""
    system, rng = SlidingBox(), np.random.default_rng(0)
    controls = 0.3 + 0.3 * rng.standard_normal((HORIZON, 1))
    states = roll_out(system, START, controls).states
    momentum = system.mass * states[:, 2:].sum(axis=1)
    np.testing.assert_allclose(momentum[1:], system.timestep * np.cumsum(controls), rtol=1e-12)
    force = system.mass * np.diff(states[:, 3]) / system.timestep
    assert np.abs(force).max() == pytest.approx(system.viscosity * system.slip_tolerance)
    assert np.all(force[~system.on_box(states[:-1])] == 0) and not system.on_box(states).all()
