"""Variances against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from estimators import (
    Antithetic,
    Evaluation,
    StepEvaluation,
    cost_to_go,
    delta_control_variate,
    first_order,
    interpolate,
    zeroth_order,
)
from tests.estimators import objectives
from tests.estimators.statistics_helpers import assert_mean_is, assert_variance_is

SAMPLES = 200_000
RNG = np.random.default_rng(1)
SLOPE = RNG.normal(size=5)
HESSIAN = (lambda root: root + root.T)(RNG.normal(size=(3, 3)))
THETA = np.array([0.5, -0.4, 0.3])
SIGMA = 0.7


def keys(seed: int, num_samples: int = SAMPLES) -> Array:
    return jax.random.split(jax.random.key(seed), num_samples)


def zeroth_variance_of_quadratic(baseline_gap: float = 0.0) -> float:
    """(d+1)||G||^2 + (sigma^2/4)(d+4)(tr(H)^2 + 2 tr(H^2)) with a zero-noise baseline, by Isserlis.

    A baseline off by c adds E||(c + w^T H w/2) s||^2 - E||(w^T H w/2) s||^2 = c^2 d/sigma^2 + c (d+2) tr(H).
    """
    dimension, trace = len(THETA), np.trace(HESSIAN)
    slope = np.sum((HESSIAN @ THETA) ** 2)
    curvature = SIGMA**2 / 4 * (dimension + 4) * (trace**2 + 2 * np.sum(HESSIAN**2))
    gap = baseline_gap**2 * dimension / SIGMA**2 + baseline_gap * (dimension + 2) * trace
    return float((dimension + 1) * slope + curvature + gap)


def test_linear_first_order_has_no_variance():
    estimate = first_order(objectives.linear(SLOPE, 0.3).differentiate(jnp.ones(5), keys(0, 1000)))
    assert estimate.variance == 0.0
    np.testing.assert_array_equal(estimate.mean, SLOPE)


def test_linear_control_variate_variance_is_that_of_the_wrong_part_of_the_gradient():
    batch = objectives.linear(SLOPE, 0.3).evaluate(jnp.ones(5), keys(2))
    wrong = SLOPE + np.array([1.0, -2.0, 0.0, 0.5, 0.0])
    estimate = delta_control_variate(batch, jnp.asarray(wrong), 0.3)
    assert_variance_is(estimate, SLOPE, 6 * np.sum((wrong - SLOPE) ** 2))
    exact_model = delta_control_variate(batch, jnp.asarray(SLOPE), 0.3)
    # f - f(0) - w.g cancels to rounding, of relative size 1e-16 before the division by sigma^2
    assert exact_model.variance < 1e-24


def test_quadratic_variances():
    objective, theta = objectives.quadratic(HESSIAN, SIGMA), jnp.asarray(THETA)
    gradient = HESSIAN @ THETA
    assert_variance_is(first_order(objective.differentiate(theta, keys(3))), gradient, SIGMA**2 * np.sum(HESSIAN**2))
    batch = objective.evaluate(theta, keys(4))
    assert_variance_is(zeroth_order(batch, "zero_noise"), gradient, zeroth_variance_of_quadratic())
    gap = float(THETA @ HESSIAN @ THETA) / 2
    assert_variance_is(zeroth_order(batch, "none"), gradient, zeroth_variance_of_quadratic(gap))


def test_antithetic_pairs_leave_no_variance_of_curvature():
    """A pair of a quadratic is (w.G) w / sigma^2, whatever H is: (d+1)||G||^2."""
    gradient = HESSIAN @ THETA
    noise = SIGMA * np.asarray(jax.random.normal(jax.random.key(7), (SAMPLES, 3)))

    def half(sign: float) -> Evaluation:
        points = THETA + sign * noise
        value = 0.5 * np.einsum("ni,ij,nj->n", points, HESSIAN, points)
        return Evaluation(
            jnp.asarray(value), jnp.asarray(sign * noise / SIGMA**2), jnp.full(SAMPLES, 0.5 * THETA @ HESSIAN @ THETA)
        )

    pairs = Antithetic().combine((half(1.0), half(-1.0)))
    assert_variance_is(pairs, gradient, 4 * np.sum(gradient**2), resolution=0.06)
    single = zeroth_order(half(1.0), "zero_noise")
    assert_variance_is(single, gradient, zeroth_variance_of_quadratic(), resolution=0.06)


def test_costs_to_go_omit_earlier_costs():
    """Step costs c_h w_h: sample h is w_h sum_{k >= h} c_k w_k / sigma^2, of variance 2 c_h^2 + sum_{k > h} c_k^2.

    With total costs it is (d + 1) sum c^2.
    """
    costs, sigma = np.array([1.0, -0.5, 2.0, 0.3]), 0.4
    noise = sigma * np.asarray(jax.random.normal(jax.random.key(8), (SAMPLES, 4)))
    to_go = jnp.asarray(np.cumsum((costs * noise)[:, ::-1], axis=1)[:, ::-1])
    score = jnp.asarray(noise / sigma**2)
    steps = StepEvaluation(to_go, jnp.zeros_like(to_go), score[:, :, None], None)
    later = np.sum(costs**2) - np.cumsum(costs**2)
    assert_variance_is(cost_to_go(steps, "none"), costs, float(np.sum(costs**2 + later + costs**2)))
    total = zeroth_order(Evaluation(to_go[:, 0], score, jnp.zeros(SAMPLES)), "none")
    assert_variance_is(total, costs, 5 * float(np.sum(costs**2)))


@pytest.mark.parametrize("alpha", [0.25, 0.9])
def test_interpolated_variance(alpha: float):
    """alpha^2 sigma_1^2 + (1-alpha)^2 sigma_0^2, each with its own batch; the erratum swaps them."""
    objective, theta, num_samples = objectives.quadratic(HESSIAN, SIGMA), jnp.asarray(THETA), 6
    grid = jax.random.split(jax.random.key(11), (20_000, 2, num_samples))

    def one(pair: Array):
        zeroth = zeroth_order(objective.evaluate(theta, pair[0]), "zero_noise")
        return interpolate(zeroth, first_order(objective.differentiate(theta, pair[1])), alpha)

    estimates = jax.jit(jax.vmap(one))(grid)
    first, zeroth = SIGMA**2 * np.sum(HESSIAN**2), zeroth_variance_of_quadratic()
    exact = alpha**2 * first + (1 - alpha) ** 2 * zeroth
    assert_mean_is(np.asarray(estimates.variance)[:, None], [exact], resolution=0.1)
    squares = np.sum((np.asarray(estimates.mean) - HESSIAN @ THETA) ** 2, axis=1)
    assert_mean_is(squares[:, None], [exact / num_samples], resolution=0.1)
    se_squares = np.sum(np.asarray(estimates.standard_error) ** 2, axis=1)
    np.testing.assert_allclose(se_squares, np.asarray(estimates.variance) / num_samples, rtol=1e-10)
