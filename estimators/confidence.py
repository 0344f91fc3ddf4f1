"""How far a batch mean may be from its expectation."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.statistics import finite_rows
from estimators.types import GradientEstimate

VARIANCE_PROXIES = ("variance", "second_moment")
MAX_DEVIATION = "max_deviation"


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
    R >= ||g_i - E g|| always. Neither can be read off the samples: both variance proxies are estimates of s2,
    and "max_deviation", R = max_i ||g_i - gbar||, is a plug-in and no bound (Gaussian scores have none). Pass
    R as a number where one is known. The code published with the paper puts delta = 0.95 into the logarithm
    in place of a probability of failure, and a constant for R in each example.

    Args:
        estimate: The zeroth-order estimate.
        failure_probability: In (0, 1).
        variance_proxy: "variance", s2 = sigmahat^2, or "second_moment", s2 = (1/N) sum_i ||g_i||^2, which is
            no smaller than (1 - 1/N) sigmahat^2.
        radius: "max_deviation", or R >= 0, [cost/param].

    Returns:
        epsilon, [cost/param]. NaN where s2 is undefined.

    Raises:
        ValueError: An argument is outside these ranges.

    Reference: Suh et al. 2022, appendix "Empirical Bernstein confidence", whose right-hand side must be
    delta, the probability of failure (printed 1 - delta), and whose second moment must be a mean (printed as
    a sum).
    """
    check_confidence_arguments(failure_probability, variance_proxy, radius)
    dtype = estimate.per_sample.dtype
    finite = finite_rows(estimate.per_sample)
    count = estimate.num_finite.astype(dtype)
    if variance_proxy == "variance":
        variance = estimate.variance
    else:
        kept = jnp.where(finite[:, None], estimate.per_sample, 0.0)
        variance = jnp.sum(kept**2) / count
    if isinstance(radius, str):
        deviation = jnp.linalg.norm(estimate.per_sample - estimate.mean[None, :], axis=1)
        bound = jnp.max(jnp.where(finite, deviation, 0.0))
    else:
        bound = jnp.asarray(radius, dtype)
    logarithm = jnp.log(jnp.asarray((estimate.mean.shape[0] + 1) / failure_probability, dtype))
    return jnp.sqrt(2.0 * variance * logarithm / count) + 2.0 * bound * logarithm / (3.0 * count)


def check_confidence_arguments(failure_probability: float, variance_proxy: str, radius: object) -> None:
    """Refuse what `bernstein_epsilon` cannot use.

    Args:
        failure_probability: In (0, 1).
        variance_proxy: "variance" or "second_moment".
        radius: "max_deviation", a number >= 0, or an array, which is taken as it is.

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
    if isinstance(radius, int | float) and not 0.0 <= radius < float("inf"):
        raise ValueError(
            f"radius must be finite and not negative; got {radius}; without a bound, pass {MAX_DEVIATION!r}"
        )
