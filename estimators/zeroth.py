"""Zeroth-order estimates: from values and scores, without derivatives of the dynamics."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.baselines import find_baseline
from estimators.statistics import summarise
from estimators.types import Evaluation, GradientEstimate


def zeroth_order(evaluation: Evaluation, baseline: str) -> GradientEstimate:
    """Zeroth-order batched gradient (ZoBG), also known as REINFORCE or the score-function gradient.

        g_i = (f_i - b_i) s_i

    Unbiased for every f of polynomial growth, continuous or not. Its variance is at most B_V^2 B_pi^2 H m /
    (N sigma^2) for |f - b| <= B_V, ||D pi|| <= B_pi and m noise dimensions at each of H steps.

    Args:
        evaluation: Batch of evaluations: values, scores and zero-noise costs.
        baseline: A name in `BASELINES`.

    Raises:
        ValueError: No baseline has that name.

    Reference: Suh et al. 2022, def. of the ZoBG and lemma on its variance (which prints H n for the noise
    dimensions).
    """
    advantage = evaluation.value - find_baseline(baseline)(evaluation)
    return summarise(advantage[:, None] * evaluation.score)


def antithetic(plus: Evaluation, minus: Evaluation, baseline: str) -> GradientEstimate:
    """Zeroth-order batched gradient over pairs of opposite noise.

        g_i = ((f_i^+ - b_i^+) s_i^+ + (f_i^- - b_i^-) s_i^-) / 2

    A pair is one sample. Unbiased for symmetric noise. If the noise is added to theta itself, the two scores are
    opposite, any baseline shared by a pair cancels, and the part of f that is odd in the noise remains,
    ((f^+ - f^-) / 2) s^+: all of the signal without the variance of the even part.

    Args:
        plus: Batch of evaluations, one of each pair.
        minus: Batch with the same starts and the opposite noise.
        baseline: A name in `BASELINES`, applied within each half.

    Raises:
        ValueError: No baseline has that name.
    """
    above, below = (zeroth_order(batch, baseline).per_sample for batch in (plus, minus))
    return summarise((above + below) / 2.0)


def delta_control_variate(
    evaluation: Evaluation, gradient: Float[Array, " params"], sigma: float | Float[Array, ""]
) -> GradientEstimate:
    """Zeroth-order estimate with a linear model of f as control variate.

        g_i = g + (f_i - f_i(0) - sigma^2 s_i . g) s_i

    where f_i(0) is the zero-noise value. Unbiased for *any* g independent of the batch, provided that
    E[s s^T] = I / sigma^2, which holds if the noise is added to the parameters themselves (an open loop, one step) but
    not for a feedback policy. The closer g is to the gradient of f, the lower the variance: zero for linear f and its
    own gradient. A wrong g only costs variance, so references use this even where first-order gradients are biased.

    Args:
        evaluation: Open-loop batch.
        gradient: g, such as a first-order mean from other samples, [cost/param].
        sigma: Standard deviation of the noise, [param].
    """
    scale = jnp.asarray(sigma, evaluation.score.dtype)
    # A sum, since accelerators may compute float32 matrix products with fewer digits.
    linear = scale**2 * jnp.sum(evaluation.score * gradient[None, :], axis=1)
    remainder = evaluation.value - evaluation.baseline - linear
    return summarise(gradient[None, :] + remainder[:, None] * evaluation.score)
