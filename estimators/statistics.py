"""What a set of per-sample gradients says: mean, spread, and how sure it is of either."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float

from estimators.pytree import register_pytree
from estimators.types import GradientEstimate


def finite_rows(per_sample: Float[Array, "samples params"]) -> Bool[Array, " samples"]:
    """Whether every entry of a row is finite."""
    return jnp.all(jnp.isfinite(per_sample), axis=1)


def summarise(per_sample: Float[Array, "samples params"]) -> GradientEstimate:
    """Mean, variance and standard error over the n rows that are finite.

        gbar = (1/n) sum_i g_i,   sigmahat^2 = 1/(n-1) sum_i ||g_i - gbar||^2

    Other rows are left out and counted. If any were, the mean is that of the samples that could be computed,
    which is another expectation than the one sought: look at `num_nonfinite` before the mean. Rows that are
    all equal have a variance of exactly zero.

    Args:
        per_sample: g_i, [cost/param].

    Returns:
        The estimate. n = 0 has an undefined (NaN) mean, n < 2 an undefined variance and standard error.

    Reference: Suh et al. 2022, def. of empirical variance.
    """
    finite = finite_rows(per_sample)
    mean, centred = _centre(per_sample, finite)
    num_finite = jnp.sum(finite)
    count = num_finite.astype(per_sample.dtype)
    spread = jnp.where(count > 1, jnp.sum(centred**2, axis=0) / jnp.maximum(count - 1.0, 1.0), jnp.nan)
    return GradientEstimate(
        per_sample=per_sample,
        mean=mean,
        variance=jnp.sum(spread),
        standard_error=jnp.sqrt(spread / count),
        num_finite=num_finite,
    )


def variance_interval(estimate: GradientEstimate, confidence: float) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Jackknife confidence interval of the variance of one sample.

        S/(n-1) exp(-+ q t),   t^2 = (n-1)/n sum_i (l_i - lbar)^2,
        l_i = log( (S - n/(n-1) ||g_i - gbar||^2) / (n-2) ),   S = sum_i ||g_i - gbar||^2

    with q the normal quantile: l_i is the log variance without sample i. On the logarithmic scale the
    interval stays positive and heavy tails widen it upwards. The g_i of an interpolated estimate are its
    pairs, and S/(n-1) differs from the estimate's own variance by the batches' chance covariance; where that
    puts the estimate's own variance outside, the interval is widened to contain it.

    Args:
        estimate: An estimate with n finite rows.
        confidence: Nominal coverage, in (0, 1); reached as n grows.

    Returns:
        Lower and upper end, [cost^2/param^2]. (0, 0) for zero variance, (0, inf) if one sample carries all of
        it, NaN for n < 3.

    Raises:
        ValueError: The confidence is outside (0, 1).
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie strictly between 0 and 1; got {confidence}; 0.95 is customary")
    rows, variance = estimate.per_sample, estimate.variance
    finite = finite_rows(rows)
    count = jnp.sum(finite).astype(rows.dtype)
    squared = jnp.sum(_centre(rows, finite)[1] ** 2, axis=1)
    total = jnp.sum(squared)
    remaining = total - squared * (count / (count - 1.0))
    rounding = 4.0 * jnp.sqrt(count) * jnp.finfo(rows.dtype).eps * total  # of a sum of `count` terms
    exhausted = finite & (remaining <= rounding)
    # The constant 1/(n-2) drops out of the deviation.
    log_variance = jnp.log(jnp.where(finite & ~exhausted, remaining, 1.0))
    deviation = jnp.where(finite, log_variance - jnp.sum(log_variance) / count, 0.0)
    standard_error = jnp.sqrt((count - 1.0) / count * jnp.sum(deviation**2))
    standard_error = jnp.where(jnp.any(exhausted), jnp.inf, standard_error)
    half_width = ndtri(jnp.asarray(0.5 + confidence / 2.0, rows.dtype)) * standard_error

    lower = total / (count - 1.0) * jnp.exp(-half_width)
    upper = jnp.where(jnp.isinf(half_width), jnp.inf, total / (count - 1.0) * jnp.exp(half_width))

    def settle(end: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.where(count > 2, jnp.where(variance == 0, 0.0, end), jnp.nan)

    return settle(jnp.minimum(lower, variance)), settle(jnp.maximum(upper, variance))


@register_pytree
@dataclass(frozen=True)
class Comparison:
    """How far an estimate is from a reference, with standard errors. See `compare`.

    Attributes:
        error: ||gbar - gref||, [cost/param].
        relative_error: ||gbar - gref|| / ||gref||.
        relative_error_se: Standard error of the relative error.
        cosine: gbar . gref / (||gbar|| ||gref||).
        cosine_se: Standard error of the cosine.
        reference_uncertainty: sqrt(tr Cov[gref]) / ||gref||, the relative error below which nothing can be
            told.
    """

    error: Float[Array, ""]
    relative_error: Float[Array, ""]
    relative_error_se: Float[Array, ""]
    cosine: Float[Array, ""]
    cosine_se: Float[Array, ""]
    reference_uncertainty: Float[Array, ""]


def compare(estimate: GradientEstimate, reference: GradientEstimate) -> Comparison:
    """Relative error and cosine against an independent reference, with delta-method standard errors.

    With unit vectors u, v, a along gbar - gref, gref, gbar, relative error r and cosine c,

        se(r)^2 = ( Var[u . g_i]/N + Var[(u + r v) . gref_j]/M ) / ||gref||^2
        se(c)^2 = Var[(v - c a) . g_i]/(N ||gbar||^2) + Var[(a - c v) . gref_j]/(M ||gref||^2)

    where the variances are those of the projected samples. First order in the noise: good where the quantity
    is several standard errors from its extreme (r = 0, |c| = 1), and pessimistic about r closer in, since the
    mean of a norm exceeds the norm of the mean. An interpolated estimate enters with its weight taken as
    given.

    Args:
        estimate: The estimate to judge.
        reference: An estimate from other samples.

    Returns:
        The comparison. A direction that does not exist (a mean or a difference of exactly zero) makes NaN of
        what needs it.
    """
    difference = estimate.mean - reference.mean
    error = jnp.linalg.norm(difference)
    size, reference_size = jnp.linalg.norm(estimate.mean), jnp.linalg.norm(reference.mean)
    along_error, along_estimate = difference / error, estimate.mean / size
    along_reference = reference.mean / reference_size
    relative = error / reference_size
    cosine = jnp.sum(along_estimate * along_reference)
    # The derivatives of r and c with respect to the two means.
    relative_slope = along_error / reference_size
    relative_slope_reference = (along_error + relative * along_reference) / reference_size
    cosine_slope = (along_reference - cosine * along_estimate) / size
    cosine_slope_reference = (along_estimate - cosine * along_reference) / reference_size

    def propagate(slope: Float[Array, " params"], slope_reference: Float[Array, " params"]) -> Float[Array, ""]:
        return jnp.sqrt(_variance_along(estimate, slope) + _variance_along(reference, slope_reference))

    return Comparison(
        error=error,
        relative_error=relative,
        relative_error_se=propagate(relative_slope, relative_slope_reference),
        cosine=cosine,
        cosine_se=propagate(cosine_slope, cosine_slope_reference),
        reference_uncertainty=jnp.linalg.norm(reference.standard_error) / reference_size,
    )


def norm_quantiles(estimate: GradientEstimate, probabilities: Sequence[float]) -> Float[Array, " probabilities"]:
    """Quantiles of ||g_i|| over the finite rows, which show the heavy tail that a variance hides.

    Args:
        estimate: An estimate with at least one finite row; without one the quantiles are NaN.
        probabilities: Each in [0, 1].

    Returns:
        The quantiles, linearly interpolated, [cost/param].

    Raises:
        ValueError: A probability is outside [0, 1].
    """
    if not all(0.0 <= probability <= 1.0 for probability in probabilities):
        raise ValueError(f"probabilities must lie in [0, 1]; got {list(probabilities)}; a median is 0.5")
    rows = estimate.per_sample
    norms = jnp.where(finite_rows(rows), jnp.linalg.norm(rows, axis=1), jnp.nan)
    return jnp.nanquantile(norms, jnp.asarray(probabilities, rows.dtype))


def _centre(
    rows: Float[Array, "samples params"], finite: Bool[Array, " samples"]
) -> tuple[Float[Array, " params"], Float[Array, "samples params"]]:
    """The mean of the finite rows, and the rows less it; refined once, so that equal rows centre to zero."""
    count = jnp.sum(finite).astype(rows.dtype)
    mean = jnp.sum(jnp.where(finite[:, None], rows, 0.0), axis=0) / count
    mean = mean + jnp.sum(jnp.where(finite[:, None], rows - mean[None, :], 0.0), axis=0) / count
    return mean, jnp.where(finite[:, None], rows - mean[None, :], 0.0)


def _variance_along(estimate: GradientEstimate, direction: Float[Array, " params"]) -> Float[Array, ""]:
    """Variance of the mean's component along a direction."""
    # A sum, since a matrix product of float32 may be rounded to fewer digits on an accelerator.
    component = jnp.sum(estimate.per_sample * direction[None, :], axis=1)
    return summarise(component[:, None]).standard_error[0] ** 2
