"""The sliding box against an independent implementation."""

import json
from pathlib import Path

import numpy as np
import pytest

from mjx_study.reference import SlidingBox, roll_out, value_and_gradient

DATA = json.loads((Path(__file__).parents[1] / "data" / "sliding_box_rollouts.json").read_text())["sliding_box"]
CASES, SETTINGS = DATA["cases"], DATA["settings"]
HORIZON = SETTINGS["T"]
INPUTS = {
    "u=0": np.zeros((HORIZON, 1)),
    "u=0.3": np.full((HORIZON, 1), 0.3),
    "u=0.36": np.full((HORIZON, 1), 0.36),
    "u=1.0 (slides off)": np.ones((HORIZON, 1)),
    "u=sin(0.02t)": np.sin(0.02 * np.arange(HORIZON))[:, None],
}
START = np.zeros(4)


@pytest.mark.parametrize("name", CASES)
def test_equals_an_independent_implementation(name: str):
    system, controls, expected = SlidingBox(), INPUTS[name], CASES[name]
    states = roll_out(system, START, controls).states
    value, gradient = value_and_gradient(system, START, controls)
    gradient = gradient.ravel()
    # 400 steps of a map that does not amplify rounding: 400 times 1e-16.
    np.testing.assert_allclose(states[HORIZON], expected["xT"], rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(states[200], expected["x200"], rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(value, expected["cost"], rtol=1e-13)
    least = 1e-13 * expected["grad_norm"]
    np.testing.assert_allclose(np.linalg.norm(gradient), expected["grad_norm"], rtol=1e-13)
    np.testing.assert_allclose(gradient[:3], expected["grad_first3"], rtol=1e-13, atol=least)
    np.testing.assert_allclose(gradient[[50, 100, 200, 300]], expected["grad_50_100_200_300"], rtol=1e-13, atol=least)
    np.testing.assert_allclose(gradient[-1], expected["grad_last"], rtol=1e-13, atol=least)
    np.testing.assert_allclose(gradient.sum(), expected["grad_sum"], rtol=0, atol=HORIZON * least)
    off = ~system.on_box(states)
    assert off.sum() == expected["steps_out_of_contact"]
    assert expected["first_step_out_of_contact"] == (int(np.argmax(off)) if off.any() else None)


def test_settings_are_those_of_the_independent_implementation():
    system = SlidingBox()
    assert (system.viscosity, system.slip_tolerance, system.width) == (
        SETTINGS["mu"],
        SETTINGS["vs"],
        SETTINGS["width"],
    )
    assert (system.timestep, system.mass, system.control_weight) == (SETTINGS["h"], SETTINGS["mass"], SETTINGS["R"])
    assert list(system.goal) == SETTINGS["xg"] and list(system.state_weight) == SETTINGS["Q"]
    assert list(START) == SETTINGS["x0"]


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
