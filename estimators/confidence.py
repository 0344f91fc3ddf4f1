"""Confidence bounds on means, intervals for variances and shares, and the effective number of samples behind them."""

import math
from dataclasses import dataclass
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtri
from jaxtyping import Array, Bool, Float

from estimators.batches import GradientEstimate
from estimators.choices import MAX_DEVIATION, VARIANCE_PROXIES, unknown
from estimators.pytree import register_pytree

ENOUGH_EFFECTIVE: Final = 3.0
"""Effective samples below which errors and biases should not be trusted; docs/coverage.md explains the choice."""


@register_pytree
@dataclass(frozen=True)
class EffectiveSamples:
    """Number of samples that carry the variance of a batch, and the largest share. See `effective_samples`.

    Attributes:
        count: From 1, where one sample carries all of the variance, to n; 0 if the variance is zero.
        top_share: Share of the variance due to the largest deviation, in (0, 1]; NaN if the variance is zero.
    """

    count: Float[Array, ""]
    top_share: Float[Array, ""]


def effective_samples(estimate: GradientEstimate) -> EffectiveSamples:
    """Compute the effective number of samples behind the variance of a batch; NaN for fewer than two finite rows.

        n_eff = (sum_i q_i)^2 / sum_i q_i^2,   q_i = ||g_i - gbar||^2,   top_share = max_i q_i / sum_i q_i

    n_eff is n over the kurtosis of the deviations: about n / (1 + 2/d) for Gaussian samples in d dimensions, about k
    if k rare samples carry the gradient. Nonfinite rows are left out, and deviations within rounding count as zero.
    It guards against rare events that the batch contains a few of. A batch that contains none can look perfectly well
    behaved, and no statistic of its samples shows it; only the extreme case of equal samples is recognised, by a count
    of 0.

    Reference: Kish, "Survey Sampling", 1965, sec. 11.7, with q_i as weights.
    """
    found = estimate.samples.deviations()
    count = jnp.where(found.varies, 1.0 / jnp.where(found.varies, found.concentration, 1.0), 0.0)
    undefined = estimate.num_finite < 2
    return EffectiveSamples(
        jnp.where(undefined, jnp.nan, count), jnp.where(undefined | ~found.varies, jnp.nan, found.top)
    )


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
        confidence: Nominal coverage, approached as n grows; a ValueError outside (0, 1).

    Returns:
        Lower and upper end, [cost^2/param^2]. (0, 0) for zero variance, (0, inf) if one sample carries all of it, NaN
        for n < 3 finite rows.
    """
    _check_confidence(confidence)
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


def _check_confidence(confidence: float) -> None:
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie strictly between 0 and 1; got {confidence}; 0.95 is customary")


def student_quantile(probability: float, freedom: Float[Array, ""]) -> Float[Array, ""]:
    """Quantile of Student's t, within 2.2 % for probabilities up to 0.975 and at least 2 degrees of freedom.

    Further out it is too large: for 2 degrees by 7 % at 0.995 and 16 % at 0.999, for 5 by 0.8 and 1.5 %.

        t = sqrt(nu (exp(z^2 (nu - 5/6) / (nu - 2/3 + 1/(10 nu))^2) - 1)),   z the normal quantile

    Reference: Peizer and Pratt, "A normal approximation for binomial, F, beta, and other common, related tail
    probabilities", Journal of the American Statistical Association 63, 1968.
    """
    normal = ndtri(jnp.asarray(probability, freedom.dtype))
    shrunk = (freedom - 5.0 / 6.0) / (freedom - 2.0 / 3.0 + 0.1 / freedom) ** 2
    return jnp.sqrt(freedom * jnp.expm1(normal**2 * shrunk))


def coverage_interval(covered: Bool[Array | np.ndarray, " trials"], confidence: float) -> tuple[float, float, float]:
    """Share of independent trials in which a bound held, and the lower and upper ends of its Wilson score interval.

    Raises:
        ValueError: There are no trials, or the confidence, the nominal coverage of the interval, is outside (0, 1).
    """
    if len(covered) == 0:
        raise ValueError("coverage needs at least one trial; got none")
    _check_confidence(confidence)
    trials, share = len(covered), float(np.asarray(covered).mean())
    quantile = float(ndtri(0.5 + confidence / 2.0))
    squared = quantile**2 / trials
    centre = (share + squared / 2) / (1 + squared)
    half_width = quantile / (1 + squared) * math.sqrt(share * (1 - share) / trials + squared / (4 * trials))
    return share, max(0.0, centre - half_width), min(1.0, centre + half_width)


def bernstein_epsilon(
    estimate: GradientEstimate,
    *,
    failure_probability: float,
    variance_proxy: str,
    radius: str | float | Float[Array, ""],
) -> Float[Array, ""]:
    """Bernstein confidence radius of the mean of N finite samples in d dimensions.

        epsilon = sqrt(2 s2 L / N) + 2 R L / (3 N),   L = log((d + 1) / failure_probability)

    ||gbar - E g|| <= epsilon with probability at least 1 - failure_probability, if s2 >= E||g_i - E g||^2 and
    R >= ||g_i - E g|| always (vector Bernstein inequality). Neither is known from samples: "variance" and
    "second_moment" estimate s2, and "max_deviation", R = max_i ||g_i - gbar||, is a plug-in, not a bound (Gaussian
    scores have none). For a known bound R, "upper_bound" is rigorous for every N: half of the failure probability goes
    to s2 = `variance_upper_bound`, half to the inequality. The code published with the paper uses delta = 0.95 in the
    logarithm instead of a failure probability, and a constant R in each example.

    Args:
        estimate: Zeroth-order in AoBG.
        failure_probability: In (0, 1).
        variance_proxy: "variance", s2 = sigmahat^2; "second_moment", s2 = (1/N) sum_i ||g_i||^2, which is
            no smaller than (1 - 1/N) sigmahat^2; or "upper_bound", which needs R as a number.
        radius: "max_deviation", or R >= 0, [cost/param].

    Returns:
        epsilon, [cost/param]. NaN where s2 is undefined.

    Raises:
        ValueError: An argument is outside these ranges.

    Reference: Suh et al. 2022, appendix "Empirical Bernstein confidence", whose right-hand side must be
    delta, the probability of failure (printed 1 - delta), and whose second moment must be a mean (printed as
    a sum). The inequality: Tropp, "An introduction to matrix concentration inequalities", 2015, theorem 1.6.2, for
    a matrix of one column.
    """
    check_confidence_arguments(failure_probability, variance_proxy, radius)
    dtype = estimate.samples.dtype
    count = estimate.num_finite.astype(dtype)
    if variance_proxy == "variance":
        variance = estimate.variance
    elif variance_proxy == "upper_bound":
        failure_probability = failure_probability / 2
        variance = variance_upper_bound(estimate, jnp.asarray(radius, dtype), failure_probability)
    else:
        variance = estimate.samples.second_moment()
    if isinstance(radius, str):
        bound = estimate.samples.largest_deviation(estimate.mean)
    else:
        bound = jnp.asarray(radius, dtype)
    logarithm = jnp.log(jnp.asarray((estimate.mean.shape[0] + 1) / failure_probability, dtype))
    return jnp.sqrt(2.0 * variance * logarithm / count) + 2.0 * bound * logarithm / (3.0 * count)


def check_confidence_arguments(failure_probability: float, variance_proxy: str, radius: object) -> None:
    """Validate the arguments of `bernstein_epsilon`; a radius that is an array is not checked."""
    if not 0.0 < failure_probability < 1.0:
        raise ValueError(
            "failure_probability must lie strictly between 0 and 1; "
            f"got {failure_probability}; it is the probability that the bound fails, so choose it small"
        )
    if variance_proxy not in VARIANCE_PROXIES:
        raise ValueError(unknown("variance proxy", variance_proxy, VARIANCE_PROXIES))
    if isinstance(radius, str) and radius != MAX_DEVIATION:
        raise ValueError(f"radius must be {MAX_DEVIATION!r} or a number; got {radius!r}")
    if variance_proxy == "upper_bound" and isinstance(radius, str):
        raise ValueError(f"variance_proxy 'upper_bound' requires a `radius`: a bound on ||g_i - E g||; got {radius!r}")
    if isinstance(radius, int | float) and not 0.0 <= radius < float("inf"):
        raise ValueError(
            f"radius must be finite and not negative; got {radius}; without a bound, pass {MAX_DEVIATION!r}"
        )


def variance_upper_bound(
    estimate: GradientEstimate, radius: Float[Array, ""], failure_probability: float
) -> Float[Array, ""]:
    """Upper confidence bound on the variance of one sample, [cost^2/param^2], rigorous for every N >= 2.

    For disjoint pairs of samples y = ||g_i - g_j||^2 / 2 has mean E||g - E g||^2 and lies in [0, 2 R^2]. With p the
    mean of n = floor(N/2) of them over 2 R^2, the bound is 2 R^2 times the largest q >= p with

        n kl(p, q) <= log(1 / failure_probability),    kl(p, q) = p log(p/q) + (1 - p) log((1-p)/(1-q)).

    Pairs with a nonfinite row are left out; without any pair, the bound is 2 R^2.

    Args:
        estimate: The estimate; pairs with a nonfinite row are left out.
        radius: R >= ||g_i - E g|| always, [cost/param].
        failure_probability: In (0, 1).

    Reference: Hoeffding, "Probability inequalities for sums of bounded random variables", 1963, theorem 1.
    """
    most = 2.0 * radius**2
    halves, pairs = estimate.samples.pair_variance()
    share = jnp.clip(halves / jnp.maximum(pairs, 1.0) / jnp.where(most > 0, most, 1.0), 0.0, 1.0)
    budget = math.log(1.0 / failure_probability)

    def divergence(q: Float[Array, ""]) -> Float[Array, ""]:
        return jax.scipy.special.rel_entr(share, q) + jax.scipy.special.rel_entr(1.0 - share, 1.0 - q)

    def halve(_, bracket: tuple[Float[Array, ""], Float[Array, ""]]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        low, high = bracket
        middle = (low + high) / 2.0
        inside = pairs * divergence(middle) <= budget
        return jnp.where(inside, middle, low), jnp.where(inside, high, middle)

    _, upper = jax.lax.fori_loop(0, 60, halve, (share, jnp.ones_like(share)))
    return most * upper
