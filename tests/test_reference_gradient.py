"""The yardstick of the study: unbiased across a jump whatever its candidates, and precise enough on the pusher."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from estimators import Evaluation, GradientEstimate, delta_control_variate, first_order, summarise
from mjx_study.experiment.reference_gradient import TARGET, averaged, estimate_reference, uncertainty
from tests.estimators.statistics_helpers import assert_mean_is
from tests.pusher_fixtures import SIGMA, penalty, pusher_simulator, pusher_task, sample_keys

# f(x) = slope . x + x' curvature x / 2 + jump [x_0 >= 0] at x = theta + w
SLOPE = np.array([1.0, -2.0, 0.5])
CURVATURE = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, -0.4], [0.0, -0.4, 0.5]])
JUMP = 3.0
THETA = np.array([0.1, -0.4, 0.2])
NOISE = 0.3
SMOOTH = SLOPE + CURVATURE @ THETA  # what first-order gradients see
EXACT = SMOOTH + np.array([JUMP * stats.norm.pdf(THETA[0] / NOISE) / NOISE, 0.0, 0.0])
BAD = np.array([-500.0, 800.0, 900.0])


def objective(x: np.ndarray) -> np.ndarray:
    return x @ SLOPE + np.einsum("...i,ij,...j->...", x, CURVATURE, x) / 2 + JUMP * (x[..., 0] >= 0)


def odd_batch(samples: int, seed: int) -> Evaluation:
    noise = NOISE * np.random.default_rng(seed).standard_normal((samples, 3))
    odd = (objective(THETA + noise) - objective(THETA - noise)) / 2
    return Evaluation(jnp.asarray(odd), jnp.asarray(noise / NOISE**2), jnp.zeros(samples))


def estimate(*candidates: np.ndarray, samples: int = 40_000):
    return estimate_reference(odd_batch(samples, 1), odd_batch(200, 2), [*map(jnp.asarray, candidates)], NOISE)


@pytest.mark.parametrize(
    "candidates", [(), (BAD,), (SMOOTH,), (BAD, SMOOTH)], ids=["none", "bad", "smooth part", "both"]
)
def test_is_unbiased_across_a_jump(candidates):
    """The smooth part alone, a first-order gradient, is 60 % off; the test resolves 5 %."""
    assert np.linalg.norm(SMOOTH - EXACT) > 0.5 * np.linalg.norm(EXACT)
    assert_mean_is(estimate(*candidates).per_sample, EXACT)


def test_picks_the_candidate_that_explains_most():
    good, both = estimate(EXACT), estimate(BAD, EXACT, SMOOTH)
    np.testing.assert_array_equal(both.per_sample, good.per_sample)
    assert good.variance < 0.5 * estimate(BAD).variance
    np.testing.assert_array_equal(estimate(SMOOTH, EXACT, BAD).per_sample, good.per_sample)  # order is no matter


def test_scale_of_a_candidate_does_not_matter():
    np.testing.assert_allclose(estimate(1e6 * EXACT).per_sample, estimate(EXACT).per_sample, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("entry", [np.nan, np.inf])
def test_candidate_that_is_not_finite_is_ignored(entry):
    broken = np.array([1.0, entry, 1.0])
    np.testing.assert_array_equal(estimate(broken, EXACT).per_sample, estimate(EXACT).per_sample)
    np.testing.assert_array_equal(estimate(EXACT, broken).per_sample, estimate(EXACT).per_sample)


def test_without_a_usable_candidate_it_is_the_plain_estimate():
    plain = delta_control_variate(odd_batch(1000, 1), jnp.zeros(3), NOISE)
    for candidates in ((), (np.zeros(3),), (np.full(3, np.nan),), (np.full(3, 1e200),)):
        np.testing.assert_array_equal(estimate(*candidates, samples=1000).per_sample, plain.per_sample)


def test_non_finite_samples_of_the_pilot_do_not_poison_it():
    pilot = odd_batch(200, 2)
    broken = Evaluation(pilot.value.at[3].set(jnp.nan), pilot.score, pilot.baseline)
    result = estimate_reference(odd_batch(1000, 1), broken, [jnp.asarray(EXACT)], NOISE)
    assert result.num_nonfinite == 0 and np.all(np.isfinite(result.per_sample))
    assert result.variance < 0.5 * estimate_reference(odd_batch(1000, 1), pilot, [], NOISE).variance


@pytest.mark.parametrize(("scale", "parts"), [(0.01, 1), (0.4, 4), (30.0, 8)])
def test_as_many_references_are_averaged_as_a_verdict_needs(scale: float, parts: int) -> None:
    """Noise of 0.4 times the gradient's norm in 20 samples is uncertain by 9 %; the mean is that of all samples."""
    drawn: list[np.ndarray] = []

    def part(index: int) -> GradientEstimate:
        noise = np.random.default_rng(index).standard_normal((20, 1))
        drawn.append(1 + scale * (noise - noise.mean()) / noise.std(ddof=1))
        return summarise(jnp.asarray(drawn[-1]))

    found, used = averaged(part, 8)
    assert used == parts == len(drawn)
    assert uncertainty(found) <= TARGET or used == 8
    np.testing.assert_allclose(found.mean, np.mean(np.concatenate(drawn)), rtol=1e-12)
    assert found.per_sample.shape == (20, 1)


def test_lost_samples_cost_their_rows_no_others() -> None:
    """A row that is finite in one part only is that part's; one that is in none stays lost."""
    rows = [np.array([[1.0], [np.nan], [3.0], [np.nan]]), np.array([[3.0], [5.0], [np.inf], [np.nan]])]
    found, used = averaged(lambda index: summarise(jnp.asarray(rows[index])), 2)
    assert used == 2 and found.num_nonfinite == 1
    np.testing.assert_array_equal(found.per_sample, [[2.0], [5.0], [3.0], [np.nan]])


@pytest.mark.slow
def test_is_precise_on_the_pusher():
    """At K = 10 the cost is nearly linear in the noise: 500 odd samples give 1e-2 of the gradient."""
    mjx, theta = pusher_simulator().objective(penalty(10.0)), pusher_task().theta
    candidate = jnp.median(mjx.differentiate(theta, sample_keys(64, 3)).gradient, axis=0)
    odd, pilot = mjx.evaluate_odd(theta, sample_keys(500, 1)), mjx.evaluate_odd(theta, sample_keys(100, 2))
    reference = estimate_reference(odd, pilot, [candidate], SIGMA)
    size = np.linalg.norm(reference.mean)
    uncertainty = np.linalg.norm(reference.standard_error)
    assert uncertainty < 1e-2 * size
    # The cost is continuous here up to 1e-4, so first-order gradients are right. The squared distance of the two means
    # has about the sum of their squared standard errors as its mean, and in 200 dimensions less than twice as spread.
    first = first_order(mjx.differentiate(theta, sample_keys(500, 4)))
    allowed = np.hypot(uncertainty, np.linalg.norm(first.standard_error))
    assert np.linalg.norm(reference.mean - first.mean) < 2 * allowed
