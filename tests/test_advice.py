"""docs/diagnose.md states the results in advice.jsonl; good, bad and undecided advice are classified as planted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators.statistics import summarise
from experiments import advice

RESULTS = advice.read()
TRUTH = 2.0


def test_the_table_of_the_page_is_that_of_the_file() -> None:
    assert advice.table(RESULTS) in advice.PAGE.read_text()
    assert len(RESULTS) == len(advice.RESULTS.read_text().splitlines()) >= 30
    assert len({each["model"] for each in RESULTS if each["held_out"]}) >= 6


def test_the_recommended_estimator_is_within_a_factor_of_two() -> None:
    """In at least 90 % of at least 20 decided cases of held-out models."""
    decided = [each for each in RESULTS if each["held_out"] and advice.verdict(each) != "undecided"]
    good = [advice.verdict(each) == "good" for each in decided]
    assert np.mean(good) >= 0.9 and len(decided) >= 20


@pytest.mark.parametrize(
    ("bias", "seconds", "factor", "expected"),
    [(0.0, 1.0, 1.0, "good"), (0.0, 2.25, 1.5, "good"), (0.0, 16.0, 4.0, "bad"), (1.0, 1e-6, 100.0, "bad")],
)
def test_factors_compare_errors_at_equal_times(bias: float, seconds: float, factor: float, expected: str) -> None:
    """An estimator of unit error after a second (a hundredth of that if it is biased) against another."""
    size, count = 50, 400
    keys = jax.random.split(jax.random.key(0), 3)
    scale = size**-0.5 * (0.01 if bias else 1.0)
    one, other = (np.asarray(TRUTH + scale * jax.random.normal(key, (count, 1))) for key in keys[:2])
    truth = summarise(TRUTH + 0.1 * jax.random.normal(keys[2], (20_000, 1)))
    found = advice.factors({"a": one + bias, "b": other}, {"a": seconds, "b": 1.0}, size, truth, "a")
    assert found["factor"] == pytest.approx(factor, rel=0.1)
    low, high = found["interval"]
    assert low <= found["factor"] <= high and advice.verdict(found) == expected
    assert found["errors"]["b"] == pytest.approx((0.01 if bias else 1.0) / TRUTH, rel=0.1)


def test_a_factor_within_the_noise_of_the_reference_is_undecided() -> None:
    keys = jax.random.split(jax.random.key(0), 3)
    means = {
        name: np.asarray(TRUTH + 0.01 * jax.random.normal(key, (40, 1))) for name, key in zip("ab", keys, strict=False)
    }
    truth = summarise(TRUTH + 5 * jax.random.normal(keys[2], (100, 1)))
    shifted = means | {"a": means["a"] + float(truth.mean[0]) - TRUTH + 0.5}
    found = advice.factors(shifted, {"a": 1e-3, "b": 1e-3}, 10, truth, "a")
    assert advice.verdict(found) == "undecided" and jnp.isfinite(found["factor"])
