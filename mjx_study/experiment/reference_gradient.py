"""The reference gradient of estimators: unbiased for any contact model, with its own uncertainty.

It is of zeroth order, since first-order gradients may be wrong, and uses two variance reductions that keep it unbiased
under any contact:

- only the part of the cost that is odd in the noise is used (two rollouts per sample);
- a linear control variate w -> slope * w^T g is subtracted and its exact mean, slope * g, added back. Any vector g
  independent of the sample is valid. Candidates are medians of first-order gradients, here and under a soft contact,
  since beyond some stiffness the local ones are noise; a pilot batch selects candidate and slope.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators import Evaluation, GradientEstimate, delta_control_variate


def estimate_reference(
    odd: Evaluation, pilot: Evaluation, candidates: Sequence[Float[Array, " params"]], sigma: float
) -> GradientEstimate:
    """Return an unbiased estimate of grad F from odd parts and the best of several control variates.

    Args:
        odd: odd parts of the open-loop cost, (f(w) - f(-w)) / 2; their batch is independent of the other arguments.
        pilot: another batch, which selects candidate and slope.
        candidates: vectors g to try, (params,); those with nonfinite entries are disqualified.
    """
    signal = pilot.value - pilot.baseline
    signal = jnp.where(jnp.isfinite(signal), signal, 0.0)
    best, explained = jnp.zeros(pilot.score.shape[1], pilot.score.dtype), jnp.zeros((), signal.dtype)
    for candidate in candidates:
        linear = sigma**2 * (pilot.score @ candidate)
        power, overlap = jnp.sum(linear**2), jnp.sum(linear * signal)
        usable = jnp.all(jnp.isfinite(candidate)) & jnp.isfinite(power) & (power > 0)
        slope = jnp.where(usable, overlap / jnp.where(usable, power, 1.0), 0.0)
        gain = jnp.where(usable, slope * overlap, -1.0)
        best = jnp.where(gain > explained, jnp.where(usable, slope * candidate, 0.0), best)
        explained = jnp.maximum(explained, gain)
    return delta_control_variate(odd, best, sigma)
