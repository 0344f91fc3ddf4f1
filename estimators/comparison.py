"""Distance of an estimate from a reference or from another, and how much of its mean rare events carry."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from estimators.batches import GradientEstimate
from estimators.confidence import effective_samples
from estimators.pytree import register_pytree
from estimators.samples import finite_rows
from estimators.statistics import summarise

Scalar = Float[Array, ""]
Means = Array | np.ndarray


@register_pytree
@dataclass(frozen=True)
class Comparison:
    """Distance of an estimate from a reference, with standard errors. See `compare`.

    Attributes:
        error: ||gbar - gref||, [cost/param].
        relative_error: r = ||gbar - gref|| / ||gref||, noise of both means included.
        relative_error_se: Standard error of r about its own mean.
        debiased_error: r_d, an estimate of ||E gbar - grad F|| / ||grad F|| with the contribution of noise removed.
        debiased_error_se: Standard error of r_d.
        cosine: c = gbar . gref / (||gbar|| ||gref||).
        cosine_se: Standard error of c about its own mean.
        debiased_cosine: c_d, the cosine of the angle between E gbar and grad F, estimated.
        debiased_cosine_se: Standard error of c_d.
        reference_uncertainty: sqrt(tr Cov[gref]) / ||gref||, the smallest relative error that can be resolved.
    """

    error: Scalar
    relative_error: Scalar
    relative_error_se: Scalar
    debiased_error: Scalar
    debiased_error_se: Scalar
    cosine: Scalar
    cosine_se: Scalar
    debiased_cosine: Scalar
    debiased_cosine_se: Scalar
    reference_uncertainty: Scalar


def compare(estimate: GradientEstimate, reference: GradientEstimate) -> Comparison:
    """Compute relative error and cosine against an independent reference, with delta-method standard errors.

    With unit vectors u, v, a along d = gbar - gref, gref, gbar,

        se(r)^2 = ( Var[u . g_i]/N + Var[(u + r v) . gref_j]/M ) / ||gref||^2
        se(c)^2 = Var[(v - c a) . g_i]/(N ||gbar||^2) + Var[(a - c v) . gref_j]/(M ||gref||^2)

    where the variances are those of the projected samples. Both r and c are biased, since noise has length: r upwards
    and |c| downwards, by many standard errors if there are many parameters. With the noise of both means removed,

        r_d^2 = max(0, q),   q = (||d||^2 - s^2 - t^2) / m,   m = ||gref||^2 - t^2,
        c_d = gbar . gref / sqrt((||gbar||^2 - s^2) m), clipped to [-1, 1],
        s^2 = sum_k se_k(gbar)^2,   t^2 = sum_k se_k(gref)^2,
        se(q)^2 = 4 ( Var[d . g_i]/N + Var[(d + q gref) . gref_j]/M ) / m^2,
        se(r_d) = min( se(q) / (2 r_d), sqrt(se(q)) )

    and se(c_d) is se(c) with the norms of c_d. First order in the noise; se(q) counts the second order twice, which is
    conservative near q = 0, where the root has no derivative and the second form of se(r_d) bounds its error.
    For an interpolated estimate the weight is treated as fixed.

    gbar is the mean of N samples, gref of M others. An undefined direction (a mean or difference of exactly zero) makes
    every dependent number NaN; so does, for the debiased ones, a reference mean indistinguishable from zero (m <= 0).
    """
    difference = estimate.mean - reference.mean
    error = jnp.linalg.norm(difference)
    size, reference_size = jnp.linalg.norm(estimate.mean), jnp.linalg.norm(reference.mean)
    along_error, along_estimate = difference / error, estimate.mean / size
    along_reference = reference.mean / reference_size
    relative = error / reference_size
    cosine = jnp.sum(along_estimate * along_reference)

    def propagate(slope: Float[Array, " params"], slope_reference: Float[Array, " params"]) -> Scalar:
        return jnp.sqrt(estimate.samples.variance_along(slope) + reference.samples.variance_along(slope_reference))

    def cosine_error(cosine: Scalar, size: Scalar, reference_size: Scalar) -> Scalar:
        across = size * reference_size
        return propagate(
            reference.mean / across - cosine / size**2 * estimate.mean,
            estimate.mean / across - cosine / reference_size**2 * reference.mean,
        )

    noise, reference_noise = (jnp.sum(each.standard_error**2) for each in (estimate, reference))
    true_size, true_reference_size = _root(size**2 - noise), _root(reference_size**2 - reference_noise)
    square = true_reference_size**2
    quotient = (error**2 - noise - reference_noise) / square
    quotient_se = 2.0 * propagate(difference / square, (difference + quotient * reference.mean) / square)
    debiased, bound = jnp.sqrt(jnp.maximum(quotient, 0.0)), jnp.sqrt(quotient_se)
    debiased_cosine = jnp.clip(cosine * (size / true_size) * (reference_size / true_reference_size), -1.0, 1.0)
    return Comparison(
        error=error,
        relative_error=relative,
        relative_error_se=propagate(
            along_error / reference_size, (along_error + relative * along_reference) / reference_size
        ),
        debiased_error=debiased,
        debiased_error_se=quotient_se / jnp.maximum(2.0 * debiased, bound),
        cosine=cosine,
        cosine_se=cosine_error(cosine, size, reference_size),
        debiased_cosine=debiased_cosine,
        debiased_cosine_se=cosine_error(debiased_cosine, true_size, true_reference_size),
        reference_uncertainty=jnp.linalg.norm(reference.standard_error) / reference_size,
    )


def _root(square: Scalar) -> Scalar:
    """Square root; NaN for nonpositive numbers."""
    return jnp.sqrt(jnp.where(square > 0, square, jnp.nan))


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

    distance: Scalar
    squared_bias: Scalar
    p_value: Scalar
    effective_samples: Scalar


def bias_test(first: GradientEstimate, zeroth: GradientEstimate, key: Key[Array, ""], *, num_draws: int) -> BiasTest:
    """Two-sample test of equal means of a first-order and a zeroth-order estimate.

        T = ||gbar_1 - gbar_0||,   T* = ||z_1 - z_0||,
        z_k = sqrt(nu_k / chi^2_k) sum_i e_ki (g_ki - gbar_k) / sqrt(n_k (n_k - 1))

    with independent standard normal multipliers e_ki, and chi^2_k with nu_k degrees of freedom. The p-value is the
    share of T* that reach T, with T itself counted as a draw: a multiplier bootstrap, which needs no inverse covariance
    and so works with more parameters than samples. The chi^2_k account for the error of the variance, as Student's t
    does; nu_k = 2 / (1/n_eff - 1/n) by the method of moments (n for Gaussian samples in one dimension, 2 k for k rare
    ones).

    The test is still asymptotic. A batch with few of the rare samples that carry the gradient underestimates both mean
    and variance: do not trust the result below `ENOUGH_EFFECTIVE` effective samples. No test sees a rare event absent
    from the batch, and this one rejects too often for strongly skewed samples: docs/coverage.md.

    The p-value is NaN if an estimate has fewer than two finite rows or all its rows are equal, since the error of its
    mean is then unknown.

    Args:
        first: First-order estimate, the one tested for bias; its samples are independent of those of `zeroth`.
        zeroth: Zeroth-order estimate from independent samples.
        key: Random key for the multipliers; consumed.
        num_draws: Number of draws of T*, >= 1; the smallest possible p-value is 1 / (num_draws + 1).

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


def squared_bias_of_means(means: Float[Means, "batches params"], reference: GradientEstimate) -> tuple[Any, Any]:
    """Estimate ||E gbar - E g||^2 without bias from the means of independent batches of any estimator.

        sum_{i != j} d_i^T d_j / (S (S - 1)) - sum_k se_k^2,   d_i = gbar_i - reference, se its standard error

    Products of different batches are free of the noise of the means; the second term removes the noise of the
    reference, which all share. The estimate may be negative if the bias is below the noise. With NumPy's arrays, in the
    reference too, nothing is compiled.

    Args:
        means: Means of S >= 3 batches, [cost/param].
        reference: Unbiased estimate of the gradient from other samples.

    Returns:
        The estimate and its standard error, [cost^2/param^2]. The error combines a jackknife over the batches with the
        largest contribution of the reference: twice the bias times its error, plus its squared error. NaN for S < 3.
    """
    numpy, count = means.__array_namespace__(), means.shape[0]
    if count < 3:
        return (numpy.full((), numpy.nan, means.dtype),) * 2
    gaps = means - reference.mean[None, :]
    others = numpy.sum(gaps * (numpy.sum(gaps, axis=0)[None, :] - gaps), axis=1)  # sum of d_i^T d_j over all j but i
    noise = numpy.sum(reference.standard_error**2)
    value = numpy.sum(others) / (count * (count - 1)) - noise
    without = (numpy.sum(others) - 2 * others) / ((count - 1) * (count - 2)) - noise
    own = (count - 1) / count * numpy.sum((without - numpy.mean(without)) ** 2)
    shared = 2 * numpy.sqrt(numpy.maximum(value, 0.0) * noise) + noise
    return value, numpy.hypot(numpy.sqrt(own), shared)


@register_pytree
@dataclass(frozen=True)
class EmpiricalBias:
    """Estimated (beta, Delta, S)-empirical bias. See `empirical_bias`.

    Attributes:
        beta: Share of samples set aside.
        discrepancy: Delta = ||mean of the remaining samples - reference||, [cost/param].
        variance: S, the variance of the remaining samples, [cost^2/param^2].
    """

    beta: Scalar
    discrepancy: Scalar
    variance: Scalar


def empirical_bias(estimate: GradientEstimate, reference: Float[Array, " params"], num_rare: int) -> EmpiricalBias:
    """Estimate how a batch looks if it happens to lack its rarest samples.

    A random vector z has (beta, Delta, S)-empirical bias if, on an event of probability at least 1 - beta, its mean is
    at least Delta from E z while its variance is at most S: a batch of fewer than about 1 / beta samples then looks
    precise but is wrong. The event used here is all but the `num_rare` samples farthest from the median.

    For this choice of event, Delta is a lower bound at that beta.

    Args:
        estimate: Batch of z, one row per sample, [cost/param].
        reference: E z, from an independent source, [cost/param].
        num_rare: Samples to set aside, from 0 to the number of samples minus 2; else a ValueError.

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
