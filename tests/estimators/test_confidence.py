"""The Bernstein radius: its formula, its coverage, and what a misread delta costs."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import estimators
from estimators import bernstein_epsilon
from tests.estimators.statistics_helpers import binomial_standard_error

# Compiled whole: a fraction of the time of compiling operation by operation.
summarise = jax.jit(estimators.summarise)

ROWS = np.array([[3.0, 4.0], [0.0, 0.0], [1.0, -1.0], [0.0, 1.0]])  # mean (1, 1)
LOGARITHM = np.log(3 / 0.1)


@pytest.mark.parametrize("extra", [[], [[np.nan, 1e9]]], ids=["all finite", "one row lost"])
@pytest.mark.parametrize(
    ("variance_proxy", "variance"), [("variance", 20.0 / 3), ("second_moment", (25.0 + 2.0 + 1.0) / 4)]
)
@pytest.mark.parametrize(("radius", "bound"), [("max_deviation", np.sqrt(13.0)), (7.0, 7.0)])
def test_formula(extra: list[list[float]], variance_proxy: str, variance: float, radius: str | float, bound: float):
    estimate = summarise(jnp.asarray([*ROWS.tolist(), *extra]))
    epsilon = bernstein_epsilon(estimate, failure_probability=0.1, variance_proxy=variance_proxy, radius=radius)
    expected = np.sqrt(2 * variance * LOGARITHM / 4) + 2 * bound * LOGARITHM / 12
    np.testing.assert_allclose(epsilon, expected, rtol=1e-14)


def test_radius_may_be_traced():
    def of_radius(radius: jax.Array) -> jax.Array:
        return bernstein_epsilon(
            summarise(jnp.asarray(ROWS)), failure_probability=0.1, variance_proxy="variance", radius=radius
        )

    slope = jax.jit(jax.grad(of_radius))(jnp.array(2.0))
    np.testing.assert_allclose(slope, 2 * LOGARITHM / 12, rtol=1e-14)


def test_one_sample_has_no_variance_and_so_no_radius():
    estimate = summarise(jnp.asarray(ROWS[:1]))
    options = {"failure_probability": 0.1, "radius": "max_deviation"}
    assert np.isnan(bernstein_epsilon(estimate, variance_proxy="variance", **options))
    second = bernstein_epsilon(estimate, variance_proxy="second_moment", **options)
    np.testing.assert_allclose(second, np.sqrt(2 * 25.0 * LOGARITHM), rtol=1e-14)


@pytest.mark.parametrize("dimension", [1, 4])
def test_coverage_with_a_valid_variance_and_radius(dimension: int):
    """Random signs: mean 0 and ||g||^2 = d exactly, so that second moment and R = sqrt(d) are both valid."""
    failure_probability, num_samples, trials = 0.05, 40, 10_000
    grid = jax.random.split(jax.random.key(0), (trials,))

    def one(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        estimate = summarise(jax.random.rademacher(key, (num_samples, dimension), jnp.float64))
        epsilon = bernstein_epsilon(
            estimate,
            failure_probability=failure_probability,
            variance_proxy="second_moment",
            radius=float(np.sqrt(dimension)),
        )
        misread = bernstein_epsilon(estimate, failure_probability=0.95, variance_proxy="second_moment", radius=0.0)
        error = jnp.linalg.norm(estimate.mean)
        return error > epsilon, error > misread

    failures, misread_failures = (float(np.mean(failed)) for failed in jax.jit(jax.vmap(one))(grid))
    noise = 4 * binomial_standard_error(failure_probability, trials)
    assert failures <= failure_probability + noise
    if dimension == 1:  # 0.95 read as a probability of success: sqrt(2 log(2/0.95)) is 1.2 standard deviations
        assert misread_failures > 0.05 + noise


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"failure_probability": 0.0}, "strictly between 0 and 1; got 0.0"),
        ({"failure_probability": 1.0}, "strictly between 0 and 1; got 1.0"),
        ({"variance_proxy": "variances"}, "unknown variance proxy 'variances'; did you mean variance"),
        ({"radius": "max"}, "'max_deviation' or a number; got 'max'"),
        ({"radius": -1.0}, "not negative; got -1.0"),
        ({"radius": float("nan")}, "finite and not negative; got nan"),
    ],
)
def test_arguments_out_of_range_are_refused(change: dict[str, Any], message: str):
    arguments = {"failure_probability": 0.1, "variance_proxy": "variance", "radius": "max_deviation"} | change
    with pytest.raises(ValueError, match=message):
        bernstein_epsilon(summarise(jnp.asarray(ROWS)), **arguments)
