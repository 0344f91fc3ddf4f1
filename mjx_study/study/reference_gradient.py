"""The gradient that estimators are measured against: unbiased for any contact model, with its own uncertainty.

Zeroth-order, because first-order gradients may be what is wrong; and with two devices against its variance that keep
it unbiased whatever the contact does:

- only the part of the cost that is odd in the noise is used (two rollouts per sample);
- a linear control variate w -> slope * w^T g is subtracted and its exact mean, slope * g, added back. Any vector g
  that is independent of the sample will do. Candidates are medians of first-order gradients, here and at a soft
  contact, since beyond some stiffness the local ones are noise; a pilot batch picks candidate and slope.
"""

from collections.abc import Sequence

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators import Evaluation, GradientEstimate, delta_control_variate


def reference_gradient(
    odd: Evaluation, pilot: Evaluation, candidates: Sequence[Float[Array, " params"]], sigma: float
) -> GradientEstimate:
    """An unbiased estimate of grad F from odd parts and the best of several control variates.

    Args:
        odd: odd parts of the cost, (f(w) - f(-w)) / 2, of an open loop; their batch is independent of all else here.
        pilot: another batch, which picks candidate and slope.
        candidates: vectors g to try, (params,); entries that are not finite disqualify one.
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
