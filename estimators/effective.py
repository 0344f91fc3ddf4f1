"""How many samples a batch's variance really rests on."""

from dataclasses import dataclass
from typing import Final

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.pytree import register_pytree
from estimators.types import GradientEstimate

ENOUGH_EFFECTIVE: Final = 3.0
"""Effective samples below which no error or bias should be believed; docs/coverage.md has what it was chosen by."""


@register_pytree
@dataclass(frozen=True)
class EffectiveSamples:
    """How evenly the samples of a batch share its variance. See `effective_samples`.

    Attributes:
        count: From 1, where one sample carries all of the variance, to n; 0 where there is no variance.
        top_share: Share of the variance that the largest deviation carries, in (0, 1]; NaN where there is none.
    """

    count: Float[Array, ""]
    top_share: Float[Array, ""]


def effective_samples(estimate: GradientEstimate) -> EffectiveSamples:
    """Effective number of samples behind the variance of a batch.

        n_eff = (sum_i q_i)^2 / sum_i q_i^2,   q_i = ||g_i - gbar||^2,   top_share = max_i q_i / sum_i q_i

    n_eff is n over the kurtosis of the deviations: about n / (1 + 2/d) for Gaussian samples in d dimensions, about k
    where k rare samples carry the gradient. It guards against rare events of which the batch holds a few. A batch
    that holds none can look perfectly well behaved: no statistic of the samples tells what they lack, and only the
    extreme case, samples that are all equal, is recognised, by a count of 0.

    Args:
        estimate: The estimate; rows that are not finite are left out, and deviations within rounding count as none.

    Returns:
        The two numbers; NaN for fewer than two finite rows.

    Reference: Kish, "Survey Sampling", 1965, sec. 11.7, with q_i as weights.
    """
    found = estimate.samples.deviations()
    count = jnp.where(found.varies, 1.0 / jnp.where(found.varies, found.concentration, 1.0), 0.0)
    undefined = estimate.num_finite < 2
    return EffectiveSamples(
        jnp.where(undefined, jnp.nan, count), jnp.where(undefined | ~found.varies, jnp.nan, found.top)
    )
