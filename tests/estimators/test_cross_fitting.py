"""Weights from the other half of the samples: the bias that they take away, and what they cost."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import estimators
from estimators import ESTIMATORS, Estimator, InverseVariance, make_estimator
from tests.estimators import objectives
from tests.estimators.statistics_helpers import assert_mean_is

CASES = {
    "feedback": (objectives.FEEDBACK, np.array([0.4, 0.1, 0.2, 0.5])),
    "open loop": (objectives.quadratic(objectives.HESSIAN, 0.7), np.array([0.5, -0.6, 0.3])),
}
WEIGHED = ("aobg", "ivw", "ivw_h", "total_propagation", "ddcg")
SAMPLES, TRIALS = 10, 12_000


def exact(case: str) -> np.ndarray:
    theta = CASES[case][1]
    return objectives.of_feedback(theta)[1] if case == "feedback" else objectives.HESSIAN @ theta


@pytest.fixture(scope="module")
def batches() -> dict[str, dict[str, object]]:
    """Batches of ten samples of each case, with an axis of trials."""
    found = {}
    needed = estimators.oracles_of(ESTIMATORS[name] for name in WEIGHED)
    for case, (objective, theta) in CASES.items():
        drawn = estimators.draw(needed, objective, jnp.asarray(theta), jax.random.key(20), SAMPLES * TRIALS)
        found[case] = jax.tree.map(lambda leaf: leaf.reshape(TRIALS, SAMPLES, *leaf.shape[1:]), drawn)
    return found


def made(case: str, name: str, weights: str) -> Estimator:
    """Of a gamma that binds in some trials and not in others."""
    gamma = 8.0 if case == "feedback" else 6.0
    return make_estimator(name, gamma=gamma, failure_probability=0.5, sigma=CASES[case][0].sigma, weights=weights)


def combined(batches, case: str, name: str, weights: str) -> estimators.GradientEstimate:
    estimator = made(case, name, weights)
    return jax.jit(jax.vmap(estimator))({oracle: batches[case][oracle] for oracle in estimator.needs})


@pytest.mark.parametrize("name", WEIGHED)
@pytest.mark.parametrize("case", CASES)
def test_cross_fitted_weights_leave_no_bias(batches, case: str, name: str) -> None:
    """Means of ten samples, 12,000 times; the variance that each states is that of its mean over them."""
    found = combined(batches, case, name, "cross_fitted")
    gradient, means = exact(case), np.asarray(found.mean)
    assert_mean_is(means, gradient, resolution=0.05)
    stated = np.sum(np.asarray(found.standard_error) ** 2, axis=1)
    actual = np.sum((means - gradient) ** 2, axis=1)
    np.testing.assert_allclose(np.mean(stated), np.mean(actual), rtol=0.1)
    np.testing.assert_allclose(np.mean(np.asarray(found.variance)) / SAMPLES, np.mean(stated), rtol=1e-10)
    np.testing.assert_allclose(np.mean(np.asarray(found.per_sample), 1), means, rtol=1e-9, atol=1e-12)
    alpha = np.asarray(found.alpha.alpha)  # type: ignore[union-attr]
    assert np.std(alpha) > 0.01, "nothing is weighed"


@pytest.mark.parametrize(("case", "name"), [("feedback", "ivw"), ("feedback", "ivw_h"), ("open loop", "ddcg")])
def test_plugged_in_weights_are_biased(batches, case: str, name: str) -> None:
    """By several percent of the gradient at ten samples: the same assertion sees it."""
    with pytest.raises(AssertionError, match="off by"):
        assert_mean_is(np.asarray(combined(batches, case, name, "plug_in").mean), exact(case), resolution=0.05)


@pytest.mark.parametrize("name", WEIGHED)
def test_a_row_does_not_depend_on_the_weights_of_its_own_half(batches, name: str) -> None:
    """What changes in the first half leaves the weights of its rows as they were, and changes those of the second."""
    estimator = made("feedback", name, "cross_fitted")
    one = jax.tree.map(lambda leaf: leaf[0], {oracle: batches["feedback"][oracle] for oracle in estimator.needs})
    other = jax.tree.map(lambda leaf: leaf.at[2].set(leaf[7]), one)
    before, after = (np.asarray(estimator(drawn).per_sample) for drawn in (one, other))
    unchanged = [0, 1, 3, 4]
    np.testing.assert_allclose(after[unchanged], before[unchanged], rtol=1e-12)
    assert np.all(np.any(after[5:] != before[5:], axis=1))


def test_halves_may_differ_by_one_and_lost_rows_are_counted() -> None:
    objective, theta = CASES["open loop"]
    drawn = estimators.draw(("evaluation", "differentiation"), objective, jnp.asarray(theta), jax.random.key(3), 11)
    value = drawn["evaluation"].value.at[2].set(jnp.nan)
    lossy = drawn | {"evaluation": replace(drawn["evaluation"], value=value)}
    for batch, lost in ((drawn, 0), (lossy, 1)):
        found = InverseVariance(weights="cross_fitted")(batch)
        assert found.per_sample.shape == (11, 3) and found.num_nonfinite == lost
        assert np.all(np.isfinite(found.mean)) and np.all(np.isfinite(found.standard_error))
    found = InverseVariance(weights="cross_fitted")(drawn)
    np.testing.assert_allclose(found.mean, np.mean(found.per_sample, 0), rtol=1e-12)


def test_too_few_samples_and_unknown_weights_are_refused() -> None:
    objective, theta = CASES["open loop"]
    drawn = estimators.draw(("evaluation", "differentiation"), objective, jnp.asarray(theta), jax.random.key(3), 3)
    with pytest.raises(ValueError, match="cross-fitted weights need at least 4 samples, two in each half; got 3"):
        InverseVariance(weights="cross_fitted")(drawn)
    with pytest.raises(ValueError, match="unknown weights 'split'; choose from plug_in, cross_fitted"):
        InverseVariance(weights="split")
