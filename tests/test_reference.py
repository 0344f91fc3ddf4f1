"""The analytic pusher: its derivatives against differences; see also `test_published`.

Along any direction of the controls the cost is a quadratic as long as no contact event changes, because the dynamics
are affine between events. Central differences then have no truncation error, only rounding, about
eps_machine cost / (step ||gradient||): 1e-11 for a step of 1e-3. The tolerance of 1e-8 also allows for the sums.
"""

import jax.numpy as jnp
import numpy as np
import pytest

from estimators import first_order, variance_interval, zeroth_order
from mjx_study.reference import Pusher, ReferenceObjective, System, roll_out, value_and_gradients
from tests.pusher_fixtures import (
    HORIZON,
    INPUTS,
    SIGMA,
    START,
    ImpedancePusher,
    contact_events,
    directions,
    relative,
    sample_keys,
)


def test_is_a_system():
    assert isinstance(Pusher(10.0), System)


@pytest.mark.parametrize("stiffness", [10.0, 1000.0, 1e4])
@pytest.mark.parametrize("make", [Pusher, ImpedancePusher])
def test_jacobians_against_differences(make, stiffness):
    system, rng, step = make(stiffness), np.random.default_rng(1), 1e-4
    state = rng.standard_normal((50, 4))
    state[:, 1] = state[:, 0] + 1 + rng.choice([-1, 1], 50) * rng.uniform(0.01, 0.1, 50)  # none at the kink
    control = rng.standard_normal((50, 1))
    assert 10 < np.sum(state[:, 1] - state[:, 0] < 1) < 40
    over_state, over_control = system.jacobians(state, control)
    for column in range(4):
        shift = step * np.eye(4)[column]
        quotient = (system.step(state + shift, control) - system.step(state - shift, control)) / (2 * step)
        np.testing.assert_allclose(over_state[..., column], quotient, rtol=1e-8, atol=1e-8)
    quotient = (system.step(state, control + step) - system.step(state, control - step)) / (2 * step)
    np.testing.assert_allclose(over_control[..., 0], quotient, rtol=1e-8, atol=1e-8)


def test_cost_gradients_against_differences():
    system, rng, step = Pusher(10.0), np.random.default_rng(2), 1e-3
    state, control = rng.standard_normal((5, 4)), rng.standard_normal((5, 1))
    over_state, over_control = system.cost_gradients(state, control)
    for column in range(4):
        shift = step * np.eye(4)[column]
        running = (system.cost(state + shift, control) - system.cost(state - shift, control)) / (2 * step)
        final = (system.final_cost(state + shift) - system.final_cost(state - shift)) / (2 * step)
        np.testing.assert_allclose(over_state[:, column], running, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(system.final_gradient(state)[:, column], final, rtol=1e-8, atol=1e-8)
    quotient = (system.cost(state, control + step) - system.cost(state, control - step)) / (2 * step)
    np.testing.assert_allclose(over_control[:, 0], quotient, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("name", ["constant", "swell"])
@pytest.mark.parametrize("stiffness", [10.0, 100.0, 1000.0])
@pytest.mark.parametrize("make", [Pusher, ImpedancePusher])
def test_adjoint_gradient_against_differences(make, stiffness, name):
    system, controls, step = make(stiffness), INPUTS[name], 1e-3
    gradient = value_and_gradients(system, START, controls)[1].controls.ravel()
    events = contact_events(system, controls)
    for direction in directions(6, (0, 50, HORIZON - 1)):
        shifted = [controls + sign * step * direction[:, None] for sign in (1, -1)]
        assert all(np.array_equal(contact_events(system, one), events) for one in shifted), "straddles an event"
        ahead, behind = (roll_out(system, START, one).value for one in shifted)
        error = abs((ahead - behind) / (2 * step) - gradient @ direction)
        assert error <= 1e-8 * np.linalg.norm(gradient)


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


@pytest.mark.parametrize("make", [Pusher, ImpedancePusher])
def test_batch_equals_loop(make):
    system = make(1000.0)
    controls = 0.1 + 0.1 * np.random.default_rng(3).standard_normal((4, HORIZON, 1))
    values, gradients = value_and_gradients(system, START, controls)
    for one, value, gradient in zip(controls, values, gradients.controls, strict=True):
        alone_value, alone = value_and_gradients(system, START, one)
        # Sums over a batch may be vectorised in another order; this K amplifies rounding by the gradient's growth.
        assert value == pytest.approx(alone_value, rel=1e-9)
        assert relative(gradient, alone.controls) < 1e-6


def reference_variances(stiffness: float, seed: int):
    """99 % intervals of the variance of one sample, zeroth and first order."""
    objective = ReferenceObjective(Pusher(stiffness), tuple(START), HORIZON, SIGMA)
    theta = jnp.full(HORIZON, 0.1)
    zeroth = zeroth_order(objective.evaluate(theta, sample_keys(300, 2 * seed)), "zero_noise")
    first = first_order(objective.differentiate(theta, sample_keys(300, 2 * seed + 1)))
    return variance_interval(zeroth, 0.99), variance_interval(first, 0.99)


@pytest.mark.parametrize("seed", range(4))
def test_stiffness_turns_the_order_of_variances(seed):
    """The figure: at K = 10 first-order gradients vary less than zeroth-order ones, at K = 1000 more."""
    (zeroth_low, _), (_, first_high) = reference_variances(10.0, seed)
    assert first_high < zeroth_low
    (_, zeroth_high), (first_low, _) = reference_variances(1000.0, seed)
    assert zeroth_high < first_low
