"""Statistics merged from blocks against those of all rows, and what replaces what rows alone can tell."""

from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import estimators
from estimators import GradientEstimate, make_estimator, merged_samples, summarise
from estimators.merged_samples import Parts, moments_of
from estimators.statistics import merged_estimates

SAMPLES, BLOCK, PARAMS = 4096, 512, 5
Rows = tuple[np.ndarray, np.ndarray]


def drawn(kind: str) -> Rows:
    rng = np.random.default_rng(1)
    zeroth, first = rng.normal(1.0, 3.0, (SAMPLES, PARAMS)), rng.normal(1.0, 1.0, (SAMPLES, PARAMS))
    if kind == "heavy":
        zeroth = rng.standard_t(2.5, (SAMPLES, PARAMS))
        zeroth[77] = 1000.0
    if kind == "lost":
        zeroth[5, 1], first[4000, 0] = np.nan, np.inf
    if kind == "far":
        zeroth += 1e6
    return zeroth, first


def merge(one: Parts, other: Parts) -> Parts:
    return tuple(mine.merged(theirs) for mine, theirs in zip(one, other, strict=True))


def in_blocks(rows: Rows, every: int = 1) -> Parts:
    starts = range(0, SAMPLES, BLOCK)
    return reduce(merge, (moments_of([each[at : at + BLOCK] for each in rows], at, every) for at in starts))


def estimates(rows: Rows, every: int = 1) -> dict[str, tuple[GradientEstimate, GradientEstimate]]:
    """From rows and from blocks: of each batch, and of both."""
    from_rows = [summarise(jnp.asarray(each)) for each in rows]
    from_blocks = merged_estimates(in_blocks(rows, every), SAMPLES)
    mixture = make_estimator("aobg", gamma=2.0)
    mixed = mixture.join(*from_rows), mixture.join(*from_blocks)
    return {"zeroth": (from_rows[0], from_blocks[0]), "first": (from_rows[1], from_blocks[1]), "mixed": mixed}


def numbers(estimate: GradientEstimate) -> dict[str, Any]:
    """What statistics say, the interval and the test apart."""
    reference = summarise(jnp.asarray(np.random.default_rng(2).normal(1.0, 1.0, (300, PARAMS))))
    effective = estimators.effective_samples(estimate)
    found = {name: getattr(estimate, name) for name in ("mean", "variance", "standard_error", "num_finite")}
    found |= vars(estimators.compare(estimate, reference)) | vars(effective)
    found |= {} if estimate.alpha is None else {"alpha": estimate.alpha.alpha, "epsilon": estimate.alpha.epsilon}
    found["quantiles"] = estimators.norm_quantiles(estimate, (0.1, 0.5, 0.9, 1.0))
    options = {"failure_probability": 0.05, "radius": "max_deviation"}
    found["radius"] = estimators.bernstein_epsilon(estimate, variance_proxy="second_moment", **options)
    return found | {"lost": estimate.num_nonfinite}


@pytest.mark.parametrize("kind", ["gaussian", "heavy", "lost", "far"])
def test_merged_statistics_equal_those_of_all_rows(kind: str) -> None:
    for name, (rows, merged) in estimates(drawn(kind)).items():
        exact = numbers(rows)
        for what, value in numbers(merged).items():
            np.testing.assert_allclose(
                value, exact[what], rtol=1e-9 if kind == "far" else 1e-12, err_msg=f"{name} {what}"
            )
        both = [np.log(np.stack(estimators.variance_interval(each, 0.95))) for each in (rows, merged)]
        width = both[0][1] - both[0][0]
        if kind == "heavy" and name == "zeroth":  # one sample carries all but 2 % of the variance
            assert exact["top_share"] > 0.98 and width > 10
        np.testing.assert_allclose(both[1], both[0], atol=2e-3 * width, err_msg=name)


def test_the_bound_of_the_variance_comes_from_pairs() -> None:
    for rows, merged in (estimates(drawn("lost"))[name] for name in ("zeroth", "first")):
        bounds = [estimators.variance_upper_bound(each, jnp.asarray(30.0), 0.05) for each in (rows, merged)]
        np.testing.assert_allclose(bounds[1], bounds[0], rtol=1e-12)


def test_draws_of_the_test_for_bias_have_the_distribution_of_the_rows() -> None:
    """Covariances of as many draws agree to five standard errors of a variance."""
    counts = 2000, 8000
    for rows, merged in estimates(drawn("heavy")).values():
        draws = [
            np.asarray(each.samples.perturbed_means(each.mean, jax.random.key(3), count))
            for each, count in zip((rows, merged), counts, strict=True)
        ]
        found, expected = np.cov(draws[1].T), np.cov(draws[0].T)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert draws[0].shape[1] == draws[1].shape[1]
        assert np.max(np.abs(found - expected) / scale) < 5 * np.sqrt(sum(1 / count for count in counts))


def test_thinned_norms_are_a_sample_of_all() -> None:
    """One in 16: ranks off by at most four standard errors, sqrt(0.25 / 256)."""
    for rows, merged in estimates(drawn("gaussian"), every=16).values():
        norms = np.linalg.norm(np.asarray(rows.per_sample), axis=1)
        median, high, most = map(float, estimators.norm_quantiles(merged, (0.5, 0.9, 1.0)))
        assert abs(np.mean(norms < median) - 0.5) < 4 * np.sqrt(0.25 / 256)
        assert abs(np.mean(norms < high) - 0.9) < 4 * np.sqrt(0.09 / 256)
        assert most == pytest.approx(norms.max(), rel=1e-12)
        assert median != pytest.approx(float(np.median(norms)), rel=1e-6)  # it is a substitute


def test_equal_rows_in_blocks_have_zero_variance() -> None:
    row = np.array([0.1, 1e6 / 3, -7.7])
    (merged,) = merged_estimates(reduce(merge, [moments_of([np.tile(row, (50, 1))], 0, 1)] * 3), 150)
    assert merged.variance == 0.0 and estimators.effective_samples(merged).count == 0.0
    assert estimators.variance_interval(merged, 0.9) == (0.0, 0.0)
    np.testing.assert_array_equal(merged.mean, row)


@pytest.mark.parametrize("scale", [1e-90, 1e80, 1e120])
def test_fourth_powers_out_of_range_leave_the_variance(scale: float) -> None:
    rows = scale * np.random.default_rng(0).normal(size=(100, 3))
    (merged,) = merged_estimates(merge(moments_of([rows[:50]], 0, 1), moments_of([rows[50:]], 50, 1)), 100)
    assert merged.variance == pytest.approx(float(summarise(jnp.asarray(rows)).variance), rel=1e-12)
    assert np.isnan(estimators.effective_samples(merged).count)
    assert np.all(np.isnan(estimators.variance_interval(merged, 0.9)))


def test_blocks_without_a_finite_sample_count_for_nothing() -> None:
    rows = drawn("gaussian")
    empty = moments_of([np.full((BLOCK, PARAMS), np.nan)] * 2, 0, 1)
    for merged, expected in zip(
        merged_estimates(merge(empty, merge(in_blocks(rows), empty)), 2 * BLOCK + SAMPLES),
        merged_estimates(in_blocks(rows), SAMPLES),
        strict=True,
    ):
        np.testing.assert_array_equal(merged.mean, expected.mean)
        assert merged.variance == expected.variance and merged.num_nonfinite == 2 * BLOCK
    for none in merged_estimates(empty, BLOCK):
        assert none.num_finite == 0 and np.all(np.isnan(none.mean)) and np.isnan(none.variance)
        assert np.all(np.isnan(estimators.variance_interval(none, 0.9)))
        assert np.all(np.isnan(estimators.norm_quantiles(none, (0.5, 1.0))))


def test_moments_do_not_grow_with_the_samples() -> None:
    rows = drawn("gaussian")
    sizes = [sum(leaf.size for leaf in jax.tree.leaves(in_blocks((each[:many], each[:many]), many // 256)))
             for many in (1024, 4096) for each in rows[:1]]  # fmt: skip
    assert sizes[1] <= 1.1 * sizes[0]  # as many extremes, of which more or fewer are of two kinds
    assert sum(leaf.size for leaf in jax.tree.leaves(in_blocks(rows))) > 1.5 * sizes[1]  # of all norms
    assert len(in_blocks(rows)[-1].extremes) <= 6 * merged_samples.EXTREMES


def test_rows_of_merged_samples_are_refused() -> None:
    (merged, _) = merged_estimates(in_blocks(drawn("gaussian")), SAMPLES)
    with pytest.raises(ValueError, match="an estimate that was merged from blocks has no rows"):
        _ = merged.per_sample


def test_estimators_say_whether_they_take_blocks() -> None:
    options = {"max_norm": 1.0, "window": 2, "sigma": 0.1, "gamma": 1.0}
    able = {name for name in estimators.ESTIMATORS if make_estimator(name, **options).mergeable}
    whole = {"ivw_h", "total_propagation", "ddcg", "delta"}
    assert able == set(estimators.ESTIMATORS) - whole
    assert not make_estimator("zobg", baseline="leave_one_out").mergeable
    assert not make_estimator("ivw", weights="cross_fitted").mergeable
