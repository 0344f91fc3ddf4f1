"""Means: every estimator on every objective with a closed form."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators import BASELINES, Objective, delta_control_variate, zeroth_order
from tests.estimators import objectives
from tests.estimators.statistics_helpers import assert_mean_is

SAMPLES = 200_000


class Case(NamedTuple):
    objective: Objective
    theta: list[float]
    gradient: Callable[[Any], Any]


CASES = {
    "quadratic": Case(
        objectives.quadratic(objectives.HESSIAN, 0.7),
        [1.5, -2.0, 1.0],
        lambda theta: jnp.asarray(objectives.HESSIAN) @ theta,
    ),
    "linear-quadratic": Case(objectives.FEEDBACK, [0.4, 0.1, 0.2, 0.5], lambda theta: objectives.of_feedback(theta)[1]),
    "heaviside": Case(objectives.heaviside(0.6), [0.3], lambda theta: objectives.heaviside_gradient(theta, 0.6)),
}
OPEN_LOOP = [name for name in CASES if name != "linear-quadratic"]
cases = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())


@cases
@pytest.mark.parametrize("baseline", BASELINES)
def test_zeroth_order_is_unbiased(case: Case, baseline: str):
    theta = jnp.asarray(case.theta)
    batch = case.objective.evaluate(theta, jax.random.split(jax.random.key(1), SAMPLES))
    estimate = jax.jit(lambda batch: zeroth_order(batch, baseline))(batch)
    assert_mean_is(estimate.per_sample, case.gradient(theta))


@pytest.mark.parametrize("name", OPEN_LOOP)
@pytest.mark.parametrize("wrongness", [0.0, 1.0])
def test_control_variate_is_unbiased_for_a_wrong_gradient(name: str, wrongness: float):
    case = CASES[name]
    theta = jnp.asarray(case.theta)
    exact = case.gradient(theta)
    batch = jax.jit(case.objective.evaluate)(theta, jax.random.split(jax.random.key(3), SAMPLES))
    sigma = getattr(case.objective, "sigma")  # noqa: B009
    estimate = delta_control_variate(batch, exact + wrongness * jnp.ones_like(exact), sigma)
    assert_mean_is(estimate.per_sample, exact)


@pytest.mark.parametrize("size", [2, 3])
def test_leave_one_out_baseline_is_unbiased_and_its_variance_excess_is_as_documented(size: int):
    case = CASES["quadratic"]
    theta, exact = jnp.asarray(case.theta), np.asarray(case.gradient(jnp.asarray(case.theta)))
    keys = jax.random.split(jax.random.key(4), (200_000, size))
    found = jax.jit(jax.vmap(lambda each: zeroth_order(case.objective.evaluate(theta, each), "leave_one_out")))(keys)
    means, variances = np.asarray(found.mean), np.asarray(found.variance)
    assert_mean_is(means, exact)
    with pytest.raises(AssertionError, match="off by"):
        assert_mean_is(means, exact * (1 - 1 / size))  # as by the mean of the whole batch
    excess = np.sum((means - exact) ** 2, axis=1) - variances / size
    assert_mean_is(excess[:, None], [np.sum(exact**2) / (size - 1) ** 2], resolution=0.2)
