"""First-order estimates: the mean of the samples' own gradients."""

import jax.numpy as jnp

from estimators.statistics import summarise
from estimators.types import Differentiation, GradientEstimate


def first_order(differentiation: Differentiation) -> GradientEstimate:
    """First-order batched gradient (FoBG), also known as the pathwise or reparametrisation gradient.

        g_i = grad_theta f_i

    Unbiased where f is continuous in theta and locally Lipschitz, with a Lipschitz constant of polynomial
    growth. Across a jump it misses the jump's share of grad F, and its variance need not show it. A sample
    whose value is not finite counts as not finite even where its gradient is: both orders then leave out the
    same rollouts.

    Args:
        differentiation: The batch.

    Returns:
        The estimate, one row per sample.

    Reference: Suh et al. 2022, def. of the FoBG. Its unbiasedness (lemma in the main text) needs the
    polynomially Lipschitz condition of the appendix, ||f(z) - f(z')|| <= a (1 + ||z||^b + ||z'||^b) ||z -
    z'||, printed there without the last factor.
    """
    finite = jnp.isfinite(differentiation.value)
    return summarise(jnp.where(finite[:, None], differentiation.gradient, jnp.nan))
