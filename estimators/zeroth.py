"""Zeroth-order estimates: from values and scores, never from a derivative of the dynamics."""

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

    A pair is one sample. Unbiased where the noise is symmetric. Where the noise is added to theta itself the two
    scores are opposite, any baseline that a pair shares cancels, and what is left is the part of f that is odd in the
    noise, ((f^+ - f^-) / 2) s^+, all of the signal without the even part's variance.

    Args:
        plus: Batch of evaluations, one of each pair.
        minus: The batch of the same starts and the opposite noise.
        baseline: A name in `BASELINES`, applied within each half.

    Raises:
        ValueError: No baseline has that name.
    """
    above, below = (zeroth_order(batch, baseline).per_sample for batch in (plus, minus))
    return summarise((above + below) / 2.0)


def delta_control_variate(
    evaluation: Evaluation, gradient: Float[Array, " params"], sigma: float | Float[Array, ""]
) -> GradientEstimate:
    """Zeroth-order estimate of what a linear model of f leaves over, added to the model's gradient.

        g_i = g + (f_i - f_i(0) - sigma^2 s_i . g) s_i

    With f_i(0) the zero-noise value. Unbiased for *any* g that does not depend on the batch, provided that
    E[s s^T] = I / sigma^2, which holds where the noise is added to the parameters themselves (an open loop,
    one step) and not for a feedback policy. The closer g is to the gradient of f, the less variance: for
    linear f and its own gradient, none. A wrong g costs variance only, so references are made this way even
    where first-order gradients are biased.

    Args:
        evaluation: The batch, open loop.
        gradient: g, such as a first-order mean from other samples, [cost/param].
        sigma: Standard deviation of the noise, [param].
    """
    scale = jnp.asarray(sigma, evaluation.score.dtype)
    # A sum, since a matrix product of float32 may be rounded to fewer digits on an accelerator.
    linear = scale**2 * jnp.sum(evaluation.score * gradient[None, :], axis=1)
    remainder = evaluation.value - evaluation.baseline - linear
    return summarise(gradient[None, :] + remainder[:, None] * evaluation.score)
