"""Statistics of per-sample gradients: mean, variance, and quantiles of the norms."""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from estimators.types import GradientEstimate


def finite_rows(per_sample: Float[Array, "samples params"]) -> Bool[Array, " samples"]:
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
    mean, centred = centre(per_sample, finite)
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


def centre(
    rows: Float[Array, "samples params"], finite: Bool[Array, " samples"]
) -> tuple[Float[Array, " params"], Float[Array, "samples params"]]:
    """The mean of the finite rows, and the rows less it; refined once, so that equal rows centre to zero."""
    count = jnp.sum(finite).astype(rows.dtype)
    mean = jnp.sum(jnp.where(finite[:, None], rows, 0.0), axis=0) / count
    mean = mean + jnp.sum(jnp.where(finite[:, None], rows - mean[None, :], 0.0), axis=0) / count
    return mean, jnp.where(finite[:, None], rows - mean[None, :], 0.0)
