"""Summaries, intervals and comparisons against brute force and repetition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.stats import norm
from scipy.stats import t as student_t

import estimators
from estimators import GradientEstimate, effective_samples, norm_quantiles, variance_interval
from estimators.confidence import student_quantile
from tests.estimators.statistics_helpers import binomial_standard_error

# Compiled whole: a fraction of the time of compiling operation by operation.
summarise = jax.jit(estimators.summarise)
compare = jax.jit(estimators.compare)
interpolate = jax.jit(estimators.interpolate)


@pytest.fixture
def rng() -> np.random.Generator:
    """One per test: a shared one would draw other numbers in every order of the tests."""
    return np.random.default_rng(3)


def test_summary_is_numpys(rng: np.random.Generator):
    rows = rng.normal(size=(30, 4))
    estimate = summarise(jnp.asarray(rows))
    np.testing.assert_allclose(estimate.mean, rows.mean(0), rtol=1e-13)
    np.testing.assert_allclose(estimate.variance, rows.var(0, ddof=1).sum(), rtol=1e-13)
    np.testing.assert_allclose(estimate.standard_error, rows.std(0, ddof=1) / np.sqrt(30), rtol=1e-13)
    assert (estimate.num_finite, estimate.num_nonfinite) == (30, 0)


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_nonfinite_rows_are_left_out_and_counted(rng: np.random.Generator, poison: float):
    rows = rng.normal(size=(30, 4))
    poisoned = rows.copy()
    poisoned[4, 2] = poisoned[9, :] = poison
    estimate = summarise(jnp.asarray(poisoned))
    expected = summarise(jnp.asarray(np.delete(rows, [4, 9], axis=0)))
    for name in ("mean", "variance", "standard_error"):
        np.testing.assert_allclose(getattr(estimate, name), getattr(expected, name), rtol=1e-13)
    assert (estimate.num_finite, estimate.num_nonfinite) == (28, 2)
    np.testing.assert_array_equal(estimate.per_sample, poisoned)
    np.testing.assert_allclose(variance_interval(estimate, 0.9), variance_interval(expected, 0.9), rtol=1e-12)
    np.testing.assert_allclose(norm_quantiles(estimate, [0.5]), norm_quantiles(expected, [0.5]), rtol=1e-14)


def test_too_few_rows_are_undefined_and_no_exception():
    none = summarise(jnp.full((3, 2), jnp.nan))
    assert none.num_finite == 0 and np.all(np.isnan(none.mean)) and np.isnan(none.variance)
    one = summarise(jnp.array([[1.0, 2.0], [jnp.nan, 0.0]]))
    np.testing.assert_array_equal(one.mean, [1.0, 2.0])
    assert np.isnan(one.variance) and np.all(np.isnan(one.standard_error))
    two = summarise(jnp.array([[1.0, 2.0], [3.0, 0.0]]))
    assert two.variance == 4.0
    for estimate in (none, one, two):
        assert np.all(np.isnan(variance_interval(estimate, 0.9)))


def test_equal_rows_have_zero_variance():
    rows = jnp.broadcast_to(jnp.array([0.1, 1e6 / 3, -7.7]), (977, 3))
    estimate = summarise(rows)
    assert estimate.variance == 0.0
    np.testing.assert_array_equal(estimate.mean, rows[0])
    assert variance_interval(estimate, 0.9) == (0.0, 0.0)


def test_variance_resting_on_one_sample_has_no_upper_end():
    lower, upper = variance_interval(summarise(jnp.zeros((100, 2)).at[17, 1].set(3.3)), 0.9)
    assert lower == 0.0 and upper == np.inf


@pytest.mark.parametrize("tail", [1.5, 2.5, 30.0])
def test_jackknife_is_leave_one_out(rng: np.random.Generator, tail: float):
    confidence, floored = 0.8, 0
    for _ in range(20):
        rows = rng.standard_t(tail, size=(25, 3))
        variance = rows.var(0, ddof=1).sum()
        logs = np.log([np.delete(rows, i, axis=0).var(0, ddof=1).sum() for i in range(25)])
        deviation = np.sqrt(24 / 25 * np.sum((logs - logs.mean()) ** 2))
        squares = np.sum((rows - rows.mean(0)) ** 2, axis=1)
        freedom = squares.sum() ** 2 / np.sum(squares**2) - 1
        floored += freedom < 2
        expected = np.array([-1, 1]) * student_t.ppf(0.9, max(freedom, 2)) * deviation
        found = np.log(np.array(variance_interval(summarise(jnp.asarray(rows)), confidence)) / variance)
        np.testing.assert_allclose(found, expected, rtol=2e-2)  # of the approximate quantile, at 2 degrees of freedom
    assert (floored > 0) == (tail < 3)  # both sides of the floor are seen


@pytest.mark.parametrize("kind", ["one batch", "interpolated"])
def test_interval_covers_the_variance_of_gaussian_samples(kind: str):
    trials, num_samples, dimension, confidence = 4000, 200, 3, 0.9

    def one(key: Array) -> tuple[Array, Array, Array]:
        first_key, zeroth_key = jax.random.split(key)
        zeroth = summarise(jax.random.normal(zeroth_key, (num_samples, dimension)))
        if kind == "one batch":
            return *variance_interval(zeroth, confidence), zeroth.variance
        first = summarise(jax.random.normal(first_key, (num_samples, dimension)))
        estimate = interpolate(zeroth, first, 0.5)
        return *variance_interval(estimate, confidence), estimate.variance

    ends = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), trials))
    lower, upper, variance = (np.asarray(end) for end in ends)
    exact = dimension * (1.0 if kind == "one batch" else 0.5)
    coverage = float(np.mean((lower <= exact) & (exact <= upper)))
    noise = 4 * binomial_standard_error(confidence, trials)
    # Equal weights, Gaussian: the pairs' variance and the estimate's own differ by N(0, 1) / sqrt(2) of the
    # former's standard errors. Where that exceeds the half-width, 1.645, the interval is widened: 2 percent.
    widened = 0.0 if kind == "one batch" else 2 * norm.sf(norm.ppf(0.95) * np.sqrt(2))
    assert confidence - noise <= coverage <= confidence + noise + widened
    assert np.all((lower <= variance) & (variance <= upper))


def gaussian_estimate(key: Array, mean: np.ndarray, deviation: np.ndarray, num_samples: int) -> GradientEstimate:
    noise = jax.random.normal(key, (num_samples, len(mean)))
    return summarise(jnp.asarray(mean)[None, :] + jnp.asarray(deviation)[None, :] * noise)


def test_comparison_of_known_vectors():
    estimate = summarise(jnp.array([[3.0, 0.0], [3.0, 8.0]]))  # mean (3, 4)
    reference = summarise(jnp.array([[5.0, -1.0], [5.0, 1.0]]))  # mean (5, 0), standard error (0, 1)
    comparison = compare(estimate, reference)
    np.testing.assert_allclose(comparison.error, np.sqrt(20.0), rtol=1e-14)
    np.testing.assert_allclose(comparison.relative_error, np.sqrt(20.0) / 5, rtol=1e-14)
    np.testing.assert_allclose(comparison.cosine, 0.6, rtol=1e-14)
    np.testing.assert_allclose(comparison.reference_uncertainty, 0.2, rtol=1e-14)
    # Only second entries are uncertain. r = |(3, b) - (5, c)| / |(5, c)|: dr/db = 4/(5 sqrt 20) = -dr/dc
    slope = 4 / (5 * np.sqrt(20.0))
    np.testing.assert_allclose(comparison.relative_error_se, np.sqrt((slope * 4) ** 2 + slope**2), rtol=1e-13)
    # cosine = (15 + b c) / (|(3, b)| |(5, c)|): d/db = -15 * 4 / (125 * 5), d/dc = 4 / 25
    expected = np.hypot(15 * 4 / 625 * 4, 4 / 25 * 1)
    np.testing.assert_allclose(comparison.cosine_se, expected, rtol=1e-13)


@pytest.mark.parametrize("kind", ["one batch", "interpolated"])
def test_standard_errors_of_a_comparison_against_repetition(kind: str):
    """The spread over R repetitions is the mean standard error, within 4/sqrt(2 R) and a bias of 1/N."""
    trials, num_samples = 2000, 400
    mean, target = np.array([1.0, 0.5, -0.3]), np.array([1.2, -0.2, 0.4])
    deviation = np.array([1.0, 2.0, 0.5])

    def one(key: Array):
        keys = jax.random.split(key, 3)
        estimate = gaussian_estimate(keys[0], mean, deviation, num_samples)
        if kind == "interpolated":
            other = gaussian_estimate(keys[1], mean, 2 * deviation, num_samples)
            estimate = interpolate(estimate, other, 0.4)
        return compare(estimate, gaussian_estimate(keys[2], target, deviation[::-1], num_samples // 2))

    comparisons = jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), trials))
    tolerance = 4 / np.sqrt(2 * trials) + 4 / num_samples
    for name in ("relative_error", "cosine"):
        spread = np.std(getattr(comparisons, name), ddof=1)
        np.testing.assert_allclose(np.mean(getattr(comparisons, f"{name}_se")), spread, rtol=tolerance)


# True relative error, parameters, samples, the reference's own relative standard error.
DEBIASED = [pytest.param(0.3, 200, 400, 0.1, marks=pytest.mark.slow), (0.0, 20, 400, 0.02), (0.3, 5, 50, 0.02)]


@pytest.mark.parametrize(("true", "params", "samples", "uncertainty"), DEBIASED)
def test_debiased_numbers_are_right_where_noise_has_a_length(true, params, samples, uncertainty) -> None:
    """A mean whose noise is 0.125 of the gradient's norm: biased by up to 14 standard errors before, not after."""
    trials, others = 200, 600
    gradient, offset = np.zeros(params), np.zeros(params)
    gradient[0], offset[1] = 1.0, true
    spread = [scale * (count / params) ** 0.5 for scale, count in ((0.125, samples), (uncertainty, others))]

    @jax.jit
    def run(keys: Array):
        def one(key: Array):
            streams = jax.random.split(key)
            means = (gradient + offset, gradient)
            return compare(
                *(
                    gaussian_estimate(stream, mean, np.full(params, scale), count)
                    for stream, mean, scale, count in zip(streams, means, spread, (samples, others), strict=True)
                )
            )

        return jax.lax.map(one, keys, batch_size=20)

    found = run(jax.random.split(jax.random.key(2), trials))
    cosine = 1 / np.hypot(1, true)
    noise = 4 * binomial_standard_error(0.95, trials)
    for name, exact in (("error", true), ("cosine", cosine)):
        value, error = (np.asarray(getattr(found, f"debiased_{name}{end}")) for end in ("", "_se"))
        covered = np.mean(np.abs(value - exact) <= 1.96 * error)
        assert covered >= 0.95 - noise, (name, covered)
        if true == 0.3 and params == 200:
            assert abs(np.mean(value) - exact) < 0.003
            assert np.mean(error) == pytest.approx(np.std(value), rel=0.2)  # no coverage bought by wide errors
            raw = "relative_error" if name == "error" else "cosine"
            misses = np.abs(getattr(found, raw) - exact) > 1.96 * getattr(found, f"{raw}_se")
            assert np.mean(misses) > 0.6, "nothing to put right"


def test_effective_samples_are_those_that_carry_the_variance(rng: np.random.Generator) -> None:
    """k equal rare samples of many, Gaussian ones, one alone, none; lost rows are left out."""
    rare = jnp.zeros((1000, 3)).at[:7, 1].set(5.0)
    found = effective_samples(summarise(rare.at[900].set(jnp.nan)))
    assert found.count == pytest.approx(7, rel=0.02) and found.top_share == pytest.approx(1 / 7, rel=0.02)
    for params in (1, 4):
        found = effective_samples(summarise(jnp.asarray(rng.normal(size=(20_000, params)))))
        assert found.count == pytest.approx(20_000 / (1 + 2 / params), rel=0.1)
    alone = effective_samples(summarise(jnp.zeros((1000, 2)).at[3].set(1.0)))
    assert alone.count == pytest.approx(1, rel=0.01) and alone.top_share == pytest.approx(1, rel=0.01)
    for equal in (jnp.full((50, 2), 0.1), jnp.full((50, 2), 0.1) * (1 + 1e-17 * jnp.arange(50.0)[:, None])):
        found = effective_samples(summarise(equal))
        assert found.count == 0 and np.isnan(found.top_share)
    assert np.isnan(effective_samples(summarise(jnp.full((3, 2), jnp.nan))).count)


@pytest.mark.parametrize(
    ("freedom", "inner", "outer"), [(2.0, 0.021, 0.17), (3.0, 0.007, 0.07), (5.0, 0.0025, 0.016), (50.0, 5e-5, 1e-4)]
)
def test_the_quantiles_of_student(freedom: float, inner: float, outer: float) -> None:
    for probability in (0.75, 0.9, 0.975, 0.995, 0.999):
        found = student_quantile(probability, jnp.asarray(freedom)) / student_t.ppf(probability, freedom) - 1
        assert -inner < found < (inner if probability <= 0.975 else outer)


def test_a_direction_that_does_not_exist_is_nan():
    reference = summarise(jnp.array([[1.0, 0.0], [1.0, 2.0]]))
    comparison = compare(summarise(jnp.zeros((2, 2))), reference)
    assert np.isnan(comparison.cosine) and np.isnan(comparison.cosine_se)
    np.testing.assert_allclose(comparison.relative_error, 1.0, rtol=1e-15)


def test_norm_quantiles():
    rows = jnp.array([[3.0, 4.0], [0.0, 1.0], [jnp.nan, 0.0], [0.0, 3.0]])
    np.testing.assert_allclose(norm_quantiles(summarise(rows), [0.0, 0.25, 0.5, 1.0]), [1.0, 2.0, 3.0, 5.0])
    assert np.all(np.isnan(norm_quantiles(summarise(jnp.full((2, 2), jnp.nan)), [0.5])))


def test_arguments_out_of_range_are_refused():
    estimate = summarise(jnp.ones((3, 2)))
    for confidence in (0.0, 1.0):
        with pytest.raises(ValueError, match=f"strictly between 0 and 1; got {confidence}"):
            variance_interval(estimate, confidence)
    with pytest.raises(ValueError, match=r"in \[0, 1\]; got \[0.5, 1.5\]"):
        norm_quantiles(estimate, [0.5, 1.5])
