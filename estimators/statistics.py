"""Statistics of per-sample gradients: mean, variance and norm quantiles."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.batches import GradientEstimate
from estimators.merged_samples import Merged, Parts
from estimators.samples import Rows, centre, finite_rows


def summarise(per_sample: Float[Array, "samples params"]) -> GradientEstimate:
    """Compute mean, variance and standard error over the n finite rows g_i of `per_sample`, [cost/param].

        gbar = (1/n) sum_i g_i,   sigmahat^2 = 1/(n-1) sum_i ||g_i - gbar||^2

    Other rows are left out and counted. If there are any, the mean is conditional on samples that could be computed,
    not the expectation sought: look at `num_nonfinite` before the mean. Rows that are all equal have a variance of
    exactly zero. The mean is NaN for n = 0, the variance and standard error for n < 2.

    Reference: Suh et al. 2022, def. of empirical variance.
    """
    finite = finite_rows(per_sample)
    mean, centred = centre(per_sample, finite)
    num_finite = jnp.sum(finite)
    count = num_finite.astype(per_sample.dtype)
    spread = jnp.where(count > 1, jnp.sum(centred**2, axis=0) / jnp.maximum(count - 1.0, 1.0), jnp.nan)
    return GradientEstimate(
        samples=Rows(per_sample),
        mean=mean,
        variance=jnp.sum(spread),
        standard_error=jnp.sqrt(spread / count),
        num_finite=num_finite,
    )


def norm_quantiles(estimate: GradientEstimate, probabilities: Sequence[float]) -> Float[Array, " probabilities"]:
    """Quantiles of ||g_i|| over the finite rows, [cost/param]; they reveal heavy tails that a variance hides.

    They are interpolated linearly, and NaN without finite rows. A probability outside [0, 1] is a ValueError.
    """
    if not all(0.0 <= probability <= 1.0 for probability in probabilities):
        raise ValueError(f"probabilities must lie in [0, 1]; got {list(probabilities)}; a median is 0.5")
    return estimate.samples.norm_quantiles(probabilities)


def merged_estimates(parts: Parts, size: int) -> list[GradientEstimate]:
    """Build the estimates of one batch or two of `size` samples, nonfinite ones included, from the merged moments."""
    batches = 1 if len(parts) == 1 else 2
    estimates = []
    for index in range(batches):
        samples = Merged(parts, tuple(float(index == each) for each in range(batches)), size)
        count = float(samples.num_finite)
        spread = np.diag(samples.covariance) / (count - 1) if count > 1 else np.full(samples.shape[1], np.nan)
        mean = samples.mean if count > 0 else np.full(samples.shape[1], np.nan)
        estimates.append(
            GradientEstimate(
                samples=samples,
                mean=jnp.asarray(mean),
                variance=jnp.sum(jnp.asarray(spread)),
                standard_error=jnp.sqrt(jnp.asarray(spread) / count),
                num_finite=samples.num_finite,
            )
        )
    return estimates
