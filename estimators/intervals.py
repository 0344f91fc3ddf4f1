"""Confidence intervals for a variance."""

import jax.numpy as jnp
from jax.scipy.special import ndtri
from jaxtyping import Array, Float

from estimators.effective import effective_samples
from estimators.types import GradientEstimate


def variance_interval(estimate: GradientEstimate, confidence: float) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Jackknife confidence interval for the variance of one sample.

        S/(n-1) exp(-+ q t),   t^2 = (n-1)/n sum_i (l_i - lbar)^2,
        l_i = log( (S - n/(n-1) ||g_i - gbar||^2) / (n-2) ),   S = sum_i ||g_i - gbar||^2

    l_i is the log variance without sample i; q is the quantile of Student's t with n_eff - 1 degrees of freedom
    (`effective_samples`; at least 2), since t is itself an estimate. On the log scale the interval stays positive and
    heavy tails widen it upwards; it still undercovers if the fourth moment is infinite or mostly unseen
    (docs/coverage.md). For an interpolated estimate the g_i are its pairs, and S/(n-1) differs from the estimate's own
    variance by the batches' chance covariance; the interval is widened to contain that variance if necessary.

    Args:
        estimate: An estimate with n finite rows.
        confidence: Nominal coverage, in (0, 1); approached as n grows.

    Returns:
        Lower and upper end, [cost^2/param^2]. (0, 0) for zero variance, (0, inf) if one sample carries all of it, NaN
        for n < 3.

    Raises:
        ValueError: The confidence is outside (0, 1).
    """
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie strictly between 0 and 1; got {confidence}; 0.95 is customary")
    variance, found = estimate.variance, estimate.samples.deviations()
    count = estimate.samples.num_finite.astype(variance.dtype)
    total = found.total
    standard_error = jnp.sqrt(found.log_spread)  # the constant 1/(n-2) cancels
    freedom = jnp.maximum(effective_samples(estimate).count - 1.0, 2.0)
    half_width = student_quantile(0.5 + confidence / 2.0, freedom) * standard_error

    lower = total / (count - 1.0) * jnp.exp(-half_width)
    upper = jnp.where(jnp.isinf(half_width), jnp.inf, total / (count - 1.0) * jnp.exp(half_width))

    def settle(end: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.where(count > 2, jnp.where(variance == 0, 0.0, end), jnp.nan)

    return settle(jnp.minimum(lower, variance)), settle(jnp.maximum(upper, variance))


def student_quantile(probability: float, freedom: Float[Array, ""]) -> Float[Array, ""]:
    """Quantile of Student's t, within 2 % for probabilities up to 0.975 and at least 2 degrees of freedom.

    Further out it is too large: for 2 degrees by 7 % at 0.995 and 16 % at 0.999, for 5 by 0.8 and 1.5 %.

        t = sqrt(nu (exp(z^2 (nu - 5/6) / (nu - 2/3 + 1/(10 nu))^2) - 1)),   z the normal quantile

    Reference: Peizer and Pratt, "A normal approximation for binomial, F, beta, and other common, related tail
    probabilities", Journal of the American Statistical Association 63, 1968.
    """
    normal = ndtri(jnp.asarray(probability, freedom.dtype))
    shrunk = (freedom - 5.0 / 6.0) / (freedom - 2.0 / 3.0 + 0.1 / freedom) ** 2
    return jnp.sqrt(freedom * jnp.expm1(normal**2 * shrunk))
