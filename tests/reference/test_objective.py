"""Systems and functions through the estimators: what is unbiased, what is not and by how much."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators import (
    ESTIMATORS,
    ORACLES,
    Objective,
    first_order,
    make_estimator,
    zeroth_order,
)
from estimators.noise import split_sample_key, standard_noise
from mjx_study.reference import (
    DoublePendulum,
    ReferenceObjective,
    Tennis,
    draw_start,
    function_objective,
    roll_out,
    smoothed,
)
from tests.estimators.statistics_helpers import assert_batches_agree, assert_mean_is
from tests.reference.functions import FUNCTIONS, JUMPING, QUADRATIC, FunctionCase
from tests.reference.systems import differentiate, linear_quadratic

SAMPLES = 200_000
HORIZON, SIGMA = 3, 0.4
SYSTEM = linear_quadratic()
CASES = {**FUNCTIONS, "quadratic": QUADRATIC}


def start_distribution(key):
    return jnp.array([1.0, -0.5, 0.2]) + 0.3 * jax.random.normal(key, (3,))


OBJECTIVES = {
    "controls": ReferenceObjective(SYSTEM, (1.0, -0.5, 0.2), HORIZON, SIGMA),
    "controls, random start": ReferenceObjective(SYSTEM, start_distribution, HORIZON, SIGMA),
    "feedback": ReferenceObjective(SYSTEM, (1.0, -0.5, 0.2), HORIZON, SIGMA, "feedback"),
    "feedback, random start": ReferenceObjective(SYSTEM, start_distribution, HORIZON, SIGMA, "feedback"),
    "start": ReferenceObjective(SYSTEM, None, HORIZON, SIGMA, "start"),
    "pendulum": ReferenceObjective(DoublePendulum(), None, 5, SIGMA, "start"),
    "tennis": ReferenceObjective(Tennis(), draw_start, 5, 0.01, "feedback"),
    "function": function_objective(QUADRATIC.function, 0.7),
}
table = pytest.mark.parametrize("name", OBJECTIVES)


def keys(count: int, seed: int = 0):
    return jax.random.split(jax.random.key(seed), count)


def point(objective: Objective) -> jax.Array:
    return jnp.asarray(0.1 * np.random.default_rng(0).standard_normal(objective.num_params))


@pytest.mark.parametrize("name", ["controls", "controls, random start"])
def test_noise_start_and_baseline_are_those_of_the_key(name: str):
    objective = OBJECTIVES[name]
    theta = point(objective)
    batch = objective.evaluate(theta, keys(3))
    for index in range(3):
        start_key, noise_key = split_sample_key(keys(3)[index])
        noise = SIGMA * np.asarray(standard_noise(noise_key, (HORIZON, 2), jnp.float64))
        start = np.asarray(start_distribution(start_key)) if "random" in name else np.array([1.0, -0.5, 0.2])
        controls = np.asarray(theta).reshape(HORIZON, 2)
        np.testing.assert_allclose(batch.score[index], noise.ravel() / SIGMA**2, rtol=1e-14)
        np.testing.assert_allclose(batch.value[index], roll_out(SYSTEM, start, controls + noise).value, rtol=1e-13)
        np.testing.assert_allclose(batch.baseline[index], roll_out(SYSTEM, start, controls).value, rtol=1e-13)


@table
def test_value_and_gradient_is_the_noise_free_rollout_from_the_key_s_start(name: str):
    objective = OBJECTIVES[name]
    theta = point(objective)
    value, gradient = objective.value_and_gradient(theta, keys(3)[1])
    assert isinstance(value, float) and gradient.shape == (objective.num_params,)
    assert value == pytest.approx(float(objective.evaluate(theta, keys(3)).baseline[1]), rel=1e-12)

    def moved(direction: np.ndarray, way: float) -> np.ndarray:
        return np.array(objective.value_and_gradient(theta + way * direction, keys(3)[1])[0])

    directions = np.random.default_rng(1).standard_normal((3, objective.num_params))
    slopes = [float(differentiate(partial(moved, each), 1e-3)) for each in directions]
    np.testing.assert_allclose(directions @ gradient, slopes, rtol=1e-6, atol=1e-8 * float(np.linalg.norm(gradient)))


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_zeroth_order_is_unbiased(case: FunctionCase):
    function, theta, sigma = case
    exact = smoothed(function, theta, sigma)
    batch = function_objective(function, sigma).evaluate(jnp.asarray(theta), keys(SAMPLES, 1))
    assert_mean_is(np.asarray(batch.value)[:, None], [exact.value])
    assert_mean_is(zeroth_order(batch, "zero_noise").per_sample, exact.gradient)


@pytest.mark.parametrize("name", [*JUMPING, "relaxed_heaviside", "ball_wall, far", "quadratic"])
def test_first_order_misses_exactly_the_jump_term(name: str):
    function, theta, sigma = CASES[name]
    exact = smoothed(function, theta, sigma)
    estimate = first_order(function_objective(function, sigma).differentiate(jnp.asarray(theta), keys(SAMPLES, 3)))
    if name not in JUMPING:
        np.testing.assert_array_equal(exact.jump_term, 0)
        assert_mean_is(estimate.per_sample, exact.gradient)
        return
    bias = np.asarray(estimate.per_sample) - exact.gradient
    assert_mean_is(bias, -exact.jump_term)  # the resolution is 5 % of the jump term
    for wrong in (np.zeros(1), exact.jump_term, -0.9 * exact.jump_term):
        with pytest.raises(AssertionError, match="off by|no power"):
            assert_mean_is(bias, wrong, resolution=np.inf)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"sigma": 0.0}, "sigma must be positive and finite"),
        ({"parametrises": "everything"}, "parametrises is 'everything'; choose from controls, feedback, start"),
        ({"horizon": 0}, "horizon must be at least 1, got 0"),
        ({"parametrises": "start"}, "or None if theta is the initial state"),
        ({"start": None}, "give a start"),
        ({"start": (0.0, 1.0)}, "the start must have 3 entries, got 2"),
    ],
)
def test_refuses(changes, match):
    arguments = {"system": SYSTEM, "start": (0.0, 0.0, 0.0), "horizon": 3, "sigma": 1.0}
    with pytest.raises(ValueError, match=match):
        ReferenceObjective(**{**arguments, **changes})


@table
def test_refuses_a_theta_of_another_length(name: str):
    objective = OBJECTIVES[name]
    with pytest.raises(ValueError, match=rf"theta must have shape \({objective.num_params},\), got \(2,\)"):
        objective.evaluate(jnp.zeros(2), keys(3))


@table
def test_all_kinds_of_batches_agree(name: str):
    """With everything that theta can parametrise; and every estimator runs on them."""
    objective = OBJECTIVES[name]
    theta = point(objective)
    batches = {kind: getattr(objective, oracle.method)(theta, keys(5, seed=3)) for kind, oracle in ORACLES.items()}
    assert_batches_agree(batches, 10**6, rtol=1e-10)
    for name in ESTIMATORS:
        estimator = make_estimator(name, gamma=1.0, sigma=objective.sigma, max_norm=1.0, window=2)
        assert np.all(np.isfinite(estimator(batches).mean)), name


@table
def test_theta_may_be_one_for_each_sample(name: str):
    """As if each were asked for alone, with its own sample."""
    objective = OBJECTIVES[name]
    thetas = point(objective) * jnp.array([[1.0], [-0.5], [2.0]])
    for oracle in ORACLES.values():
        method = getattr(objective, oracle.method)
        alone = [method(theta, key[None]) for theta, key in zip(thetas, keys(3), strict=True)]
        expected = jax.tree.map(lambda *parts: np.concatenate(parts), *alone)
        jax.tree.map(
            lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12),
            method(thetas, keys(3)),
            expected,
        )
