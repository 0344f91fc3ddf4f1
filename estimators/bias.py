"""Bias of first-order means, and how much of the mean rare events carry."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from estimators.effective import effective_samples
from estimators.pytree import register_pytree
from estimators.rows import finite_rows
from estimators.statistics import summarise
from estimators.types import GradientEstimate


@register_pytree
@dataclass(frozen=True)
class BiasTest:
    """Result of a test of E[g_1] = E[g_0]. See `bias_test`.

    Attributes:
        distance: ||gbar_1 - gbar_0||, [cost/param].
        squared_bias: Unbiased estimate of ||E g_1 - E g_0||^2; may be negative, [cost^2/param^2].
        p_value: Probability of a distance at least as large if there is no bias.
        effective_samples: The smaller n_eff of the two batches; below `ENOUGH_EFFECTIVE` the p-value is meaningless.
    """

    distance: Float[Array, ""]
    squared_bias: Float[Array, ""]
    p_value: Float[Array, ""]
    effective_samples: Float[Array, ""]


def bias_test(first: GradientEstimate, zeroth: GradientEstimate, key: Key[Array, ""], *, num_draws: int) -> BiasTest:
    """Two-sample test of equal means of a first-order and a zeroth-order estimate.

        T = ||gbar_1 - gbar_0||,   T* = ||z_1 - z_0||,   z_k = sqrt(nu_k / chi^2_k) sum_i e_ki (g_ki - gbar_k) / n_k

    with independent standard normal multipliers e_ki, and chi^2_k with nu_k degrees of freedom. The p-value is the
    share of T* that reach T, with T itself counted as a draw: a multiplier bootstrap, which needs no inverse covariance
    and so works with more parameters than samples. The chi^2_k account for the error of the variance, as Student's t
    does; nu_k = 2 / (1/n_eff - 1/n) by the method of moments (n for Gaussian samples in one dimension, 2 k for k rare
    ones).

    The test is still asymptotic. A batch with few of the rare samples that carry the gradient underestimates both mean
    and variance: do not trust the result below `ENOUGH_EFFECTIVE` effective samples. No test sees a rare event absent
    from the batch, and this one rejects too often for strongly skewed samples: docs/coverage.md.

    Args:
        first: First-order estimate, the one tested for bias.
        zeroth: Zeroth-order estimate from independent samples.
        key: Random key for the multipliers; consumed.
        num_draws: Number of draws of T*, >= 1; the smallest possible p-value is 1 / (num_draws + 1).

    Returns:
        The test result. The p-value is NaN if an estimate has fewer than two finite rows or all its rows are equal,
        since the error of its mean is then unknown.

    Raises:
        ValueError: `num_draws` is below 1, or the numbers of parameters differ.

    Reference: Chernozhukov, Chetverikov, Kato, "Gaussian approximations and multiplier bootstrap for maxima of sums
    of high-dimensional random vectors", Annals of Statistics 41, 2013, for another norm.
    """
    if num_draws < 1:
        raise ValueError(f"num_draws must be at least 1; got {num_draws}; 999 gives p-values down to 0.001")
    if first.mean.shape != zeroth.mean.shape:
        raise ValueError(f"the estimates must have the same parameters; got {first.mean.shape} and {zeroth.mean.shape}")
    distance = jnp.linalg.norm(first.mean - zeroth.mean)
    noise = sum(jnp.sum(estimate.standard_error**2) for estimate in (first, zeroth))
    effective = [effective_samples(estimate).count for estimate in (first, zeroth)]
    *streams, scale_key = jax.random.split(key, 3)
    scales = jax.random.normal(scale_key, (2, num_draws, 1), distance.dtype)
    drawn = sum(map(_multiplied, (first, zeroth), effective, streams, scales))
    reached = jnp.sum(jnp.linalg.norm(drawn, axis=1) >= distance).astype(distance.dtype)
    p_value = (1.0 + reached) / (1.0 + num_draws)
    fewest = jnp.minimum(*effective)
    return BiasTest(distance, distance**2 - noise, jnp.where(fewest > 0, p_value, jnp.nan), fewest)


def _multiplied(
    estimate: GradientEstimate, effective: Float[Array, ""], key: Key[Array, ""], scales: Float[Array, "draws 1"]
) -> Float[Array, "draws params"]:
    """Draws of z_k, up to sign, which is irrelevant to a difference."""
    means = estimate.samples.perturbed_means(estimate.mean, key, len(scales))
    count = estimate.num_finite.astype(estimate.mean.dtype)
    freedom = 2.0 / jnp.maximum(1.0 / jnp.maximum(effective, 1.0) - 1.0 / count, 1e-9)
    # Wilson-Hilferty: chi^2 / nu as the cube of a normal variate
    spread = jnp.sqrt(2.0 / (9.0 * freedom))
    cube_root = 1.0 - spread**2 + spread * scales
    return means / jnp.maximum(cube_root, 1e-2) ** 1.5


def squared_bias_of_means(
    means: Float[Array, "batches params"], reference: GradientEstimate
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Estimate ||E gbar - E g||^2 without bias from the means of independent batches of any estimator.

        sum_{i != j} d_i^T d_j / (S (S - 1)) - sum_k se_k^2,   d_i = gbar_i - reference, se its standard error

    Products of different batches are free of the noise of the means; the second term removes the noise of the
    reference, which all share. The estimate may be negative if the bias is below the noise.

    Args:
        means: Means of S >= 3 batches, [cost/param].
        reference: Unbiased estimate of the gradient from other samples.

    Returns:
        The estimate and its standard error, [cost^2/param^2]. The error combines a jackknife over the batches with the
        largest contribution of the reference: twice the bias times its error, plus its squared error. NaN for S < 3.
    """
    count = means.shape[0]
    if count < 3:
        undefined = jnp.full((), jnp.nan, means.dtype)
        return undefined, undefined
    gaps = means - reference.mean[None, :]
    products = jnp.matmul(gaps, gaps.T, precision="highest")
    others = products - jnp.diag(jnp.diag(products))
    noise = jnp.sum(reference.standard_error**2)
    value = jnp.sum(others) / (count * (count - 1)) - noise
    without = (jnp.sum(others) - 2 * jnp.sum(others, axis=1)) / ((count - 1) * (count - 2)) - noise
    own = (count - 1) / count * jnp.sum((without - jnp.mean(without)) ** 2)
    shared = 2 * jnp.sqrt(jnp.maximum(value, 0.0) * noise) + noise
    return value, jnp.hypot(jnp.sqrt(own), shared)


@register_pytree
@dataclass(frozen=True)
class EmpiricalBias:
    """Estimated (beta, Delta, S)-empirical bias. See `empirical_bias`.

    Attributes:
        beta: Share of samples set aside.
        discrepancy: Delta = ||mean of the remaining samples - reference||, [cost/param].
        variance: S, the variance of the remaining samples, [cost^2/param^2].
    """

    beta: Float[Array, ""]
    discrepancy: Float[Array, ""]
    variance: Float[Array, ""]


def empirical_bias(estimate: GradientEstimate, reference: Float[Array, " params"], num_rare: int) -> EmpiricalBias:
    """Estimate how a batch looks if it happens to lack its rarest samples.

    A random vector z has (beta, Delta, S)-empirical bias if, on an event of probability at least 1 - beta, its mean is
    at least Delta from E z while its variance is at most S: a batch of fewer than about 1 / beta samples then looks
    precise but is wrong. The event used here is all but the `num_rare` samples farthest from the median.

    Args:
        estimate: Batch of z, one row per sample, [cost/param].
        reference: E z, from an independent source, [cost/param].
        num_rare: Samples to set aside, from 0 to the number of samples minus 2.

    Returns:
        The three numbers; for this choice of event, Delta is a lower bound at that beta.

    Raises:
        ValueError: Fewer than two samples would remain.

    Reference: Suh et al. 2022, def. of empirical bias, and the lemma Var z >= Delta_0^2 / beta with Delta_0 =
    max(0, (1 - beta) Delta - beta ||E z||).
    """
    rows = estimate.per_sample
    if not 0 <= num_rare <= rows.shape[0] - 2:
        raise ValueError(f"num_rare must leave at least 2 of {rows.shape[0]} samples; got {num_rare}")
    finite = finite_rows(rows)
    centre = jnp.nanmedian(jnp.where(finite[:, None], rows, jnp.nan), axis=0)
    distance = jnp.where(finite, jnp.linalg.norm(rows - centre[None, :], axis=1), -1.0)
    rank = jnp.argsort(jnp.argsort(-distance))
    kept = summarise(jnp.where((rank >= num_rare)[:, None], rows, jnp.nan))
    beta = jnp.asarray(num_rare, rows.dtype) / estimate.num_finite.astype(rows.dtype)
    return EmpiricalBias(beta, jnp.linalg.norm(kept.mean - reference), kept.variance)
