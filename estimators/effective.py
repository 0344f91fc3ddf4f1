"""Effective number of samples behind a batch's variance."""

from dataclasses import dataclass
from typing import Final

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.pytree import register_pytree
from estimators.types import GradientEstimate

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
    """Compute the effective number of samples behind the variance of a batch.

        n_eff = (sum_i q_i)^2 / sum_i q_i^2,   q_i = ||g_i - gbar||^2,   top_share = max_i q_i / sum_i q_i

    n_eff is n over the kurtosis of the deviations: about n / (1 + 2/d) for Gaussian samples in d dimensions, about k
    if k rare samples carry the gradient. It guards against rare events that the batch contains a few of. A batch that
    contains none can look perfectly well behaved, and no statistic of its samples shows it; only the extreme case of
    equal samples is recognised, by a count of 0.

    Args:
        estimate: The estimate; nonfinite rows are left out, and deviations within rounding count as zero.

    Returns:
        The count and the top share; NaN for fewer than two finite rows.

    Reference: Kish, "Survey Sampling", 1965, sec. 11.7, with q_i as weights.
    """
    found = estimate.samples.deviations()
    count = jnp.where(found.varies, 1.0 / jnp.where(found.varies, found.concentration, 1.0), 0.0)
    undefined = estimate.num_finite < 2
    return EffectiveSamples(
        jnp.where(undefined, jnp.nan, count), jnp.where(undefined | ~found.varies, jnp.nan, found.top)
    )
