"""Confidence bounds on the distance of a batch mean from its expectation."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from estimators.catalogue import MAX_DEVIATION, VARIANCE_PROXIES
from estimators.types import GradientEstimate


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
        estimate: Batch of N samples in d dimensions, zeroth-order in AoBG; nonfinite samples are left out.
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


def variance_upper_bound(
    estimate: GradientEstimate, radius: Float[Array, ""], failure_probability: float
) -> Float[Array, ""]:
    """Upper confidence bound on the variance of one sample, rigorous for every N >= 2.

    For disjoint pairs of samples y = ||g_i - g_j||^2 / 2 has mean E||g - E g||^2 and lies in [0, 2 R^2]. With p the
    mean of n = floor(N/2) of them over 2 R^2, the bound is 2 R^2 times the largest q >= p with

        n kl(p, q) <= log(1 / failure_probability),    kl(p, q) = p log(p/q) + (1 - p) log((1-p)/(1-q)).

    Args:
        estimate: The estimate; pairs with a nonfinite row are left out.
        radius: R >= ||g_i - E g|| always, [cost/param].
        failure_probability: In (0, 1).

    Returns:
        The bound, [cost^2/param^2]; 2 R^2 if there are no pairs.

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


def coverage_interval(covered: Bool[Array | np.ndarray, " trials"], confidence: float) -> tuple[float, float, float]:
    """Share of trials in which a bound held, with its Wilson score interval.

    Args:
        covered: Whether the bound held in each independent trial.
        confidence: Nominal coverage of the interval, in (0, 1).

    Returns:
        The share, and the lower and upper ends of the interval.

    Raises:
        ValueError: There are no trials, or the confidence is outside (0, 1).
    """
    if len(covered) == 0:
        raise ValueError("coverage needs at least one trial; got none")
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie strictly between 0 and 1; got {confidence}; 0.95 is customary")
    trials, share = len(covered), float(np.asarray(covered).mean())
    quantile = float(jax.scipy.special.ndtri(0.5 + confidence / 2.0))
    squared = quantile**2 / trials
    centre = (share + squared / 2) / (1 + squared)
    half_width = quantile / (1 + squared) * math.sqrt(share * (1 - share) / trials + squared / (4 * trials))
    return share, max(0.0, centre - half_width), min(1.0, centre + half_width)


def check_confidence_arguments(failure_probability: float, variance_proxy: str, radius: object) -> None:
    """Validate the arguments of `bernstein_epsilon`.

    Args:
        failure_probability: In (0, 1).
        variance_proxy: "variance", "second_moment" or "upper_bound".
        radius: "max_deviation", a number >= 0, or an array, which is not checked.

    Raises:
        ValueError: An argument is outside these ranges.
    """
    if not 0.0 < failure_probability < 1.0:
        raise ValueError(
            "failure_probability must lie strictly between 0 and 1; "
            f"got {failure_probability}; it is the probability that the bound fails, so choose it small"
        )
    if variance_proxy not in VARIANCE_PROXIES:
        raise ValueError(f"variance_proxy must be one of {', '.join(VARIANCE_PROXIES)}; got {variance_proxy!r}")
    if isinstance(radius, str) and radius != MAX_DEVIATION:
        raise ValueError(f"radius must be {MAX_DEVIATION!r} or a number; got {radius!r}")
    if variance_proxy == "upper_bound" and isinstance(radius, str):
        raise ValueError(f"variance_proxy 'upper_bound' requires radius to be a bound on ||g_i - E g||; got {radius!r}")
    if isinstance(radius, int | float) and not 0.0 <= radius < float("inf"):
        raise ValueError(
            f"radius must be finite and not negative; got {radius}; without a bound, pass {MAX_DEVIATION!r}"
        )
