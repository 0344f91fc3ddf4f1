"""First-order estimates: the mean of the samples' own gradients."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.statistics import summarise
from estimators.types import Differentiation, GradientEstimate


def first_order(differentiation: Differentiation) -> GradientEstimate:
    """First-order batched gradient (FoBG), also known as the pathwise or reparametrisation gradient.

        g_i = grad_theta f_i

    Unbiased if f is continuous in theta and locally Lipschitz with a constant of polynomial growth. Across a jump it
    misses the jump's contribution to grad F, and its variance need not show it. A sample with a nonfinite value counts
    as nonfinite even if its gradient is finite, so that both orders leave out the same rollouts.

    Reference: Suh et al. 2022, def. of the FoBG. Its unbiasedness (lemma in the main text) needs the
    polynomially Lipschitz condition of the appendix, ||f(z) - f(z')|| <= a (1 + ||z||^b + ||z'||^b) ||z -
    z'||, printed there without the last factor.
    """
    finite = jnp.isfinite(differentiation.value)
    return summarise(jnp.where(finite[:, None], differentiation.gradient, jnp.nan))


def clipped_first_order(differentiation: Differentiation, max_norm: float | Float[Array, ""]) -> GradientEstimate:
    """First-order batched gradient with clipped sample norms.

        g_i = grad_theta f_i min(1, c / ||grad_theta f_i||)

    Biased as soon as any sample is clipped; the added bias is at most E max(0, ||grad f_i|| - c).

    Args:
        differentiation: Batch of differentiations, with grad_theta f_i of every sample.
        max_norm: c > 0, [cost/param].

    Reference: Pascanu, Mikolov, Bengio, "On the difficulty of training recurrent neural networks", ICML 2013, where the
    mean is clipped.
    """
    rows = first_order(differentiation).per_sample
    largest = jnp.max(jnp.abs(rows), axis=1, keepdims=True)  # scaling by it keeps squares from overflowing
    scaled = rows / jnp.where(largest > 0, largest, 1.0)
    norm = largest * jnp.linalg.norm(scaled, axis=1, keepdims=True)
    bound = jnp.asarray(max_norm, rows.dtype)
    direction = scaled / jnp.where(largest > 0, jnp.linalg.norm(scaled, axis=1, keepdims=True), 1.0)
    return summarise(jnp.where(norm > bound, bound * direction, rows))
