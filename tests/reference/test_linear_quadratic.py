"""The linear-quadratic system: its closed forms against rollouts and samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators import first_order, zeroth_order
from mjx_study.reference import ReferenceObjective, value_and_gradients
from tests.estimators.statistics_helpers import assert_mean_is, assert_variance_is
from tests.reference.systems import linear_quadratic

HORIZON, SIGMA, SAMPLES = 4, 0.3, 100_000
SYSTEM = linear_quadratic()
START = (1.0, -0.5, 0.7)
RNG = np.random.default_rng(0)
CONTROLS = RNG.standard_normal((HORIZON, 2))
OBJECTIVE = ReferenceObjective(SYSTEM, START, HORIZON, SIGMA)


def keys(seed: int):
    return jax.random.split(jax.random.key(seed), SAMPLES)


def test_smoothed_by_moments():
    """F by the recursion of the state's mean and covariance; its gradient is that of the noise-free cost."""
    mean, covariance, cost = np.array(START), np.zeros((3, 3)), 0.0
    for control in CONTROLS:
        cost += mean @ SYSTEM.state_weight @ mean + np.trace(SYSTEM.state_weight @ covariance)
        cost += control @ SYSTEM.control_weight @ control + SIGMA**2 * np.trace(SYSTEM.control_weight)
        mean = SYSTEM.transition @ mean + SYSTEM.control @ control
        covariance = SYSTEM.transition @ covariance @ SYSTEM.transition.T + SIGMA**2 * SYSTEM.control @ SYSTEM.control.T
    cost += mean @ SYSTEM.final_weight @ mean + np.trace(SYSTEM.final_weight @ covariance)
    exact = SYSTEM.smoothed(np.array(START), CONTROLS, SIGMA)
    assert exact.value == pytest.approx(cost, rel=1e-12)
    gradient = value_and_gradients(SYSTEM, np.array(START), CONTROLS)[1].controls
    np.testing.assert_allclose(exact.gradient, gradient.ravel(), rtol=1e-12)
    np.testing.assert_array_equal(exact.jump_term, 0)


def test_both_orders_are_unbiased_and_the_first_has_the_variance_of_the_closed_form():
    exact, theta = SYSTEM.smoothed(np.array(START), CONTROLS, SIGMA), jnp.asarray(CONTROLS.ravel())
    batch = OBJECTIVE.evaluate(theta, keys(0))
    assert_mean_is(np.asarray(batch.value)[:, None], [exact.value])
    assert_mean_is(zeroth_order(batch, "zero_noise").per_sample, exact.gradient)
    estimate = first_order(OBJECTIVE.differentiate(theta, keys(1)))
    assert_mean_is(estimate.per_sample, exact.gradient)
    assert_variance_is(estimate, exact.gradient, SYSTEM.first_order_variance(HORIZON, SIGMA))
