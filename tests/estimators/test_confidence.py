"""The Bernstein radius: its formula, its coverage, and what a misread delta costs."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import root_scalar

import estimators
from estimators import bernstein_epsilon

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


def test_the_rigorous_formula():
    """Half of the failure probability goes to the variance, of two pairs: 2 kl(p, q) = log(1 / 0.05)."""
    radius, logarithm = 7.0, np.log(3 / 0.05)
    share = np.mean([25.0, 5.0]) / 2 / (2 * radius**2)
    divergence = lambda q: share * np.log(share / q) + (1 - share) * np.log((1 - share) / (1 - q))  # noqa: E731
    bracket = share, 1 - 1e-12
    found = root_scalar(lambda q: 2 * divergence(q) - np.log(1 / 0.05), bracket=bracket, method="brentq", xtol=1e-14)
    variance = 2 * radius**2 * found.root
    epsilon = bernstein_epsilon(
        summarise(jnp.asarray(ROWS)), failure_probability=0.1, variance_proxy="upper_bound", radius=radius
    )
    np.testing.assert_allclose(epsilon, np.sqrt(2 * variance * logarithm / 4) + 2 * radius * logarithm / 12, rtol=1e-9)


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
