"""Whether a first-order mean is biased, and how much of it a rare event carries."""

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
    """A test of E[g_1] = E[g_0]. See `bias_test`.

    Attributes:
        distance: ||gbar_1 - gbar_0||, [cost/param].
        squared_bias: An unbiased estimate of ||E g_1 - E g_0||^2, which may be negative, [cost^2/param^2].
        p_value: Probability of a distance at least as large if there is no bias.
        effective_samples: n_eff of the batch that has fewer; below `ENOUGH_EFFECTIVE` the p-value says nothing.
    """

    distance: Float[Array, ""]
    squared_bias: Float[Array, ""]
    p_value: Float[Array, ""]
    effective_samples: Float[Array, ""]


def bias_test(first: GradientEstimate, zeroth: GradientEstimate, key: Key[Array, ""], *, num_draws: int) -> BiasTest:
    """Two-sample test of whether a first-order mean estimates another gradient than a zeroth-order one.

        T = ||gbar_1 - gbar_0||,   T* = ||z_1 - z_0||,   z_k = sqrt(nu_k / chi^2_k) sum_i e_ki (g_ki - gbar_k) / n_k

    with independent standard normal multipliers e_ki and chi^2_k of nu_k degrees of freedom. The p-value is the share
    of draws of T* that reach T, the observed T among them: a multiplier bootstrap, which needs no inverse covariance
    and so works with more parameters than samples. The chi^2_k allow for the error of the variance, as Student's t
    does, with nu_k = 2 / (1/n_eff - 1/n) degrees of freedom by the method of moments (n for Gaussian samples in one
    dimension, 2 k for k rare ones).

    Asymptotic all the same. A batch that holds few of the rare samples that carry the gradient underestimates mean
    and variance together: below `ENOUGH_EFFECTIVE` effective samples, do not believe the result. No test sees a rare
    event that the batch does not hold, and on strongly skewed samples this one rejects too often: docs/coverage.md.

    Args:
        first: First-order estimate, the one whose bias is tested.
        zeroth: Zeroth-order estimate from independent samples.
        key: For the multipliers; used up.
        num_draws: Of T*, >= 1; 1 / (num_draws + 1) is the least p-value.

    Returns:
        The test; a p-value of NaN where an estimate has fewer than two finite rows, or all of them equal: they say
        nothing about how far their mean may be off.

    Raises:
        ValueError: There is nothing to draw, or the parameters differ in number.

    Reference: Chernozhukov, Chetverikov, Kato, "Gaussian approximations and multiplier bootstrap for maxima of sums
    of high-dimensional random vectors", Annals of Statistics 41, 2013, there for another norm.
    """
    if num_draws < 1:
        raise ValueError(f"num_draws must be at least 1; got {num_draws}; 999 gives p-values down to 0.001")
    if first.mean.shape != zeroth.mean.shape:
        raise ValueError(f"the estimates must have the same parameters; got {first.mean.shape} and {zeroth.mean.shape}")
    distance = jnp.linalg.norm(first.mean - zeroth.mean)
    noise = sum(jnp.sum(estimate.standard_error**2) for estimate in (first, zeroth))
    effective = [effective_samples(estimate).count for estimate in (first, zeroth)]
    drawn = sum(
        _multiplied(estimate, count, stream, num_draws)
        for estimate, count, stream in zip((first, zeroth), effective, jax.random.split(key), strict=True)
    )
    reached = jnp.sum(jnp.linalg.norm(drawn, axis=1) >= distance).astype(distance.dtype)
    p_value = (1.0 + reached) / (1.0 + num_draws)
    fewest = jnp.minimum(*effective)
    return BiasTest(distance, distance**2 - noise, jnp.where(fewest > 0, p_value, jnp.nan), fewest)


def _multiplied(
    estimate: GradientEstimate, effective: Float[Array, ""], key: Key[Array, ""], num_draws: int
) -> Float[Array, "draws params"]:
    """z_k; the sign that a difference gives is immaterial."""
    dtype = estimate.mean.dtype
    multiplier_key, scale_key = jax.random.split(key)
    means = estimate.samples.perturbed_means(estimate.mean, multiplier_key, num_draws)
    count = estimate.num_finite.astype(dtype)
    freedom = 2.0 / jnp.maximum(1.0 / jnp.maximum(effective, 1.0) - 1.0 / count, 1e-9)
    # chi^2 / nu as the cube of a normal number, by Wilson and Hilferty
    spread = jnp.sqrt(2.0 / (9.0 * freedom))
    cube_root = 1.0 - spread**2 + spread * jax.random.normal(scale_key, (num_draws, 1), dtype)
    return means / jnp.maximum(cube_root, 1e-2) ** 1.5


def squared_bias_of_means(
    means: Float[Array, "batches params"], reference: GradientEstimate
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """An unbiased estimate of ||E gbar - E g||^2 from the means of independent batches, for any estimator.

        sum_{i != j} d_i^T d_j / (S (S - 1)) - sum_k se_k^2,   d_i = gbar_i - reference, se its standard error

    The products of different batches leave out the noise of the means, the second term that of the reference, which all
    share. It may be negative where there is no bias to be seen.

    Args:
        means: Of S >= 3 batches, [cost/param].
        reference: An unbiased estimate of the gradient from other samples.

    Returns:
        The estimate and its standard error, [cost^2/param^2]: a jackknife over the batches, and twice the bias
        times the reference's error, plus its square, which is the most that the reference can contribute. NaN for
        fewer batches.
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
    """(beta, Delta, S)-empirical bias, estimated. See `empirical_bias`.

    Attributes:
        beta: Share of the samples that are set aside.
        discrepancy: Delta = ||mean of the others - reference||, [cost/param].
        variance: S, the variance of the others, [cost^2/param^2].
    """

    beta: Float[Array, ""]
    discrepancy: Float[Array, ""]
    variance: Float[Array, ""]


def empirical_bias(estimate: GradientEstimate, reference: Float[Array, " params"], num_rare: int) -> EmpiricalBias:
    """How a batch that happens to lack its rarest samples looks.

    A random vector z has (beta, Delta, S)-empirical bias if there is an event of probability at least 1 - beta on which
    its mean is Delta or more from E z, though its variance is at most S: a batch of fewer than about 1 / beta samples
    then looks precise and is wrong. The event here: all but the `num_rare` samples farthest from the median.

    Args:
        estimate: The batch of z, a row per sample, [cost/param].
        reference: E z, from elsewhere, [cost/param].
        num_rare: Samples to set aside, from 0 to the number of samples less 2.

    Returns:
        The three numbers; a lower bound on Delta at that beta as far as this event goes.

    Raises:
        ValueError: Too few samples would be left.

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
