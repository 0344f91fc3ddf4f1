"""The weight against a numerical minimum, its edge cases, and what the interpolated estimate promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import estimators
from estimators import GradientEstimate, alpha_order, bernstein_epsilon, first_order, zeroth_order
from tests.estimators import objectives

# Compiled whole: a fraction of the time of compiling operation by operation.
summarise = jax.jit(estimators.summarise)
constrained_alpha = jax.jit(estimators.constrained_alpha)
inverse_variance_alpha = jax.jit(estimators.inverse_variance_alpha)
interpolate = jax.jit(estimators.interpolate)

INF, NAN = np.inf, np.nan
EPS = float(np.finfo(np.float64).eps)


def random_inputs(count: int) -> np.ndarray:
    """Columns variance_zeroth, variance_first, discrepancy, epsilon, gamma; often 0, often tied."""
    rng = np.random.default_rng(0)
    inputs = 10.0 ** rng.uniform(-4, 4, size=(count, 5))
    inputs[:, 3:] = 10.0 ** rng.uniform(-2, 2, size=(count, 2))
    inputs[rng.random((count, 5)) < 0.1] = 0.0
    ties = rng.random(count) < 0.1
    inputs[ties, 4] = inputs[ties, 3]
    inputs[rng.random(count) < 0.1, 4] = INF
    return inputs


def test_weight_is_the_constrained_minimum():
    """Feasible, and no feasible point of a fine grid has a smaller variance."""
    inputs = random_inputs(5000)
    alphas = np.asarray(jax.vmap(constrained_alpha)(*jnp.asarray(inputs).T))
    grid = np.linspace(0.0, 1.0, 2001)
    num_bound = num_free = num_infeasible = 0
    for (zeroth, first, discrepancy, epsilon, gamma), alpha in zip(inputs, alphas, strict=True):
        assert 0.0 <= alpha <= 1.0
        if epsilon > gamma:
            num_infeasible += 1
            assert alpha == 0.0
            continue
        assert epsilon + alpha * discrepancy <= gamma * (1 + 4 * EPS)
        feasible = grid[epsilon + grid * discrepancy <= gamma]
        best = np.min(feasible**2 * first + (1 - feasible) ** 2 * zeroth)
        # (1 - alpha)^2 loses digits where alpha is close to 1: an error of eps in alpha
        assert alpha**2 * first + (1 - alpha) ** 2 * zeroth <= best * (1 + 16 * EPS) + 4 * EPS * first
        bound = alpha < (zeroth / (zeroth + first) if zeroth else 0.0) * (1 - 1e-9)
        num_bound, num_free = num_bound + bound, num_free + (not bound)
    assert min(num_bound, num_free, num_infeasible) > 500


@pytest.mark.parametrize(
    ("zeroth", "first", "exact"),
    [
        (3.0, 1.0, 0.75), (0.0, 1.0, 0.0), (1.0, 0.0, 1.0), (0.0, 0.0, 0.0), (INF, 1.0, 1.0), (1.0, INF, 0.0),
        (INF, INF, 0.0), (1.5e308, 1.5e308, 0.5), (NAN, 1.0, 0.0), (1.0, NAN, 0.0), (0.0, NAN, 0.0), (NAN, 0.0, 0.0),
    ],
)  # fmt: skip
def test_inverse_variance_weight(zeroth: float, first: float, exact: float):
    assert inverse_variance_alpha(jnp.array(zeroth), jnp.array(first)) == exact


@pytest.mark.parametrize(
    ("discrepancy", "epsilon", "gamma", "exact"),
    [
        (1.0, 0.5, 2.0, 0.75),  # free
        (4.0, 0.5, 2.5, 0.5),  # bound
        (2.0, 0.5, 2.0, 0.75),  # just touching
        (1.0, 3.0, 2.0, 0.0),  # infeasible
        (1.0, 2.0, 2.0, 0.0),  # no room
        (0.0, 2.0, 2.0, 0.75),  # nothing to disagree about
        (0.0, 3.0, 2.0, 0.0),
        (INF, 0.5, 2.0, 0.0),
        (NAN, 0.5, 2.0, 0.0),
        (1.0, NAN, 2.0, 0.0),
        (1.0, INF, 2.0, 0.0),
        (1.0, 0.5, INF, 0.75),
        (1.0, INF, INF, 0.75),
        (INF, NAN, INF, 0.75),
        (NAN, 0.5, INF, 0.75),
    ],
)
def test_constrained_weight_edge_cases(discrepancy: float, epsilon: float, gamma: float, exact: float):
    """With variances 3 and 1, whose inverse-variance weight is 3/4."""
    alpha = constrained_alpha(jnp.array(3.0), jnp.array(1.0), jnp.array(discrepancy), epsilon, gamma)
    assert alpha == exact


def pair(seed: int = 0, num_samples: int = 50, dim: int = 3) -> tuple[GradientEstimate, GradientEstimate]:
    rng = np.random.default_rng(seed)
    zeroth = summarise(jnp.asarray(rng.normal(1.0, 2.0, size=(num_samples, dim))))
    return zeroth, summarise(jnp.asarray(rng.normal(1.2, 1.0, size=(num_samples, dim))))


@pytest.mark.parametrize("alpha", [0.0, 0.4, 1.0])
def test_interpolation_pairs_by_index(alpha: float):
    zeroth, first = pair()
    estimate = interpolate(zeroth, first, alpha)
    expected = alpha * np.asarray(first.per_sample) + (1 - alpha) * np.asarray(zeroth.per_sample)
    np.testing.assert_allclose(estimate.per_sample, expected, rtol=1e-14)
    np.testing.assert_allclose(estimate.mean, expected.mean(0), rtol=1e-13)
    assert estimate.num_finite == 50 and estimate.alpha is None


def test_choice_is_reported_and_used():
    zeroth, first = pair()
    estimate = alpha_order(zeroth, first, gamma=0.6, epsilon=0.5)
    choice = estimate.alpha
    assert choice is not None and choice.discrepancy is not None
    discrepancy = np.linalg.norm(np.asarray(first.mean) - np.asarray(zeroth.mean))
    np.testing.assert_allclose(choice.discrepancy, discrepancy, rtol=1e-14)
    np.testing.assert_allclose(choice.alpha, 0.1 / discrepancy, rtol=1e-14)
    assert choice.epsilon == 0.5
    assert (choice.variance_zeroth, choice.variance_first) == (zeroth.variance, first.variance)
    np.testing.assert_array_equal(estimate.mean, interpolate(zeroth, first, choice.alpha).mean)


def assert_same_summary(estimate: GradientEstimate, expected: GradientEstimate) -> None:
    for name in ("per_sample", "mean", "variance", "standard_error", "num_finite"):
        np.testing.assert_array_equal(getattr(estimate, name), getattr(expected, name))


def test_a_batch_of_no_weight_cannot_spoil_the_other():
    zeroth, first = pair()
    lost = summarise(jnp.full((50, 3), jnp.nan))
    for gamma in (0.6, INF):
        estimate = alpha_order(zeroth, lost, gamma=gamma, epsilon=0.1)
        assert estimate.alpha is not None and estimate.alpha.alpha == 0.0
        assert_same_summary(estimate, zeroth)
    assert_same_summary(interpolate(lost, first, 1.0), first)
    both = interpolate(lost, first, 0.5)
    assert both.num_finite == 0 and np.all(np.isnan(both.mean))


def test_pairs_with_a_nonfinite_half_are_counted():
    zeroth, first = pair()
    first = summarise(first.per_sample.at[3, 1].set(jnp.nan))
    zeroth = summarise(zeroth.per_sample.at[7, 0].set(jnp.inf))
    estimate = alpha_order(zeroth, first, gamma=INF, epsilon=0.1)
    assert (zeroth.num_nonfinite, first.num_nonfinite, estimate.num_nonfinite) == (1, 1, 2)
    assert np.all(np.isfinite(estimate.mean)) and np.isfinite(estimate.variance)


def test_batches_of_different_shape_are_refused():
    zeroth, _ = pair()
    first = summarise(jnp.ones((40, 3)))
    with pytest.raises(ValueError, match=r"same shape .* \(50, 3\) .* \(40, 3\)"):
        alpha_order(zeroth, first, gamma=1.0, epsilon=0.1)


def test_error_is_within_gamma_whenever_epsilon_covers():
    """Robustness lemma, where the first-order gradient misses everything and gamma is half of that."""
    sigma, theta = 0.6, jnp.array([0.3])
    objective = objectives.heaviside(sigma)
    exact = objectives.heaviside_gradient(theta, sigma)
    gamma = float(exact[0]) / 2

    def one(key: jax.Array):
        keys = jax.random.split(key, (2, 400))
        zeroth = zeroth_order(objective.evaluate(theta, keys[0]), "none")
        first = first_order(objective.differentiate(theta, keys[1]))
        epsilon = bernstein_epsilon(
            zeroth, failure_probability=0.1, variance_proxy="second_moment", radius="max_deviation"
        )
        safe = alpha_order(zeroth, first, gamma=gamma, epsilon=epsilon)
        naive = alpha_order(zeroth, first, gamma=jnp.inf, epsilon=epsilon)
        assert safe.alpha is not None
        return zeroth.mean, safe.mean, naive.mean, epsilon, safe.alpha.alpha

    zeroth, safe, naive, epsilon, alpha = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 300))
    covered = np.abs(zeroth - exact[None, :])[:, 0] <= epsilon
    feasible = epsilon <= gamma
    assert np.mean(covered & feasible) > 0.5 and np.mean(alpha) > 0.05  # the constraint binds, and leaves room
    assert np.all(np.abs(safe - exact[None, :])[covered & feasible] <= gamma * (1 + 4 * EPS))
    # inverse variances alone trust the batch without variance: it is off by all of the gradient
    assert np.all(naive == 0.0)
