"""Zeroth-order estimates, from values and scores, with their baselines; first-order ones, from the samples' gradients.

A baseline b_i is subtracted from the values of zeroth-order samples. It leaves E[(f_i - b_i) s_i] unchanged if it does
not depend on the noise of sample i, because E[s_i] = 0. The batch mean does depend on it: E[(f_i - fbar) s_i] =
(1 - 1/N) grad F, a gradient shrunk towards zero. The mean of the *other* samples does not, hence `leave_one_out`.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.batches import Differentiation, Evaluation, GradientEstimate
from estimators.choices import unknown
from estimators.statistics import summarise


def none(evaluation: Evaluation) -> Float[Array, " samples"]:
    """b_i = 0."""
    return jnp.zeros_like(evaluation.value)


def zero_noise(evaluation: Evaluation) -> Float[Array, " samples"]:
    """b_i = V_1(x_1^i, 0, theta), the zero-noise rollout from the same start.

    Reference: Suh et al. 2022, sec. "Gradient estimators", paragraph "Baseline".
    """
    return evaluation.baseline


def leave_one_out(evaluation: Evaluation) -> Float[Array, " samples"]:
    """b_i = 1/(N-1) sum_{j != i} f_j over finite values; 0 if there are no others.

    Sharing values makes the samples dependent. Each stays unbiased, but the variance of their mean exceeds
    E[sigmahat^2]/N by ||grad F||^2/(N-1)^2.
    """
    finite = jnp.isfinite(evaluation.value)
    value = jnp.where(finite, evaluation.value, 0.0)
    num_others = jnp.sum(finite).astype(value.dtype) - finite.astype(value.dtype)
    return jnp.where(num_others > 0, (jnp.sum(value) - value) / jnp.maximum(num_others, 1.0), 0.0)


BASELINES: dict[str, Callable[[Evaluation], Float[Array, " samples"]]] = {
    "none": none,
    "zero_noise": zero_noise,
    "leave_one_out": leave_one_out,
}


def find_baseline(name: str) -> Callable[[Evaluation], Float[Array, " samples"]]:
    """Look up a baseline by name; an unknown one is a ValueError."""
    if name not in BASELINES:
        raise ValueError(unknown("baseline", name, BASELINES))
    return BASELINES[name]


def zeroth_order(evaluation: Evaluation, baseline: str) -> GradientEstimate:
    """Zeroth-order batched gradient (ZoBG), also known as REINFORCE or the score-function gradient.

        g_i = (f_i - b_i) s_i

    Unbiased for every f of polynomial growth, continuous or not. Its variance is at most B_V^2 B_pi^2 H m /
    (N sigma^2) for |f - b| <= B_V, ||D pi|| <= B_pi and m noise dimensions at each of H steps.

    A baseline that is not in `BASELINES` is a ValueError.

    Reference: Suh et al. 2022, def. of the ZoBG and lemma on its variance (which prints H n for the noise
    dimensions).
    """
    advantage = evaluation.value - find_baseline(baseline)(evaluation)
    return summarise(advantage[:, None] * evaluation.score)


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
    """First-order batched gradient with sample norms clipped at c = `max_norm` > 0, [cost/param].

        g_i = grad_theta f_i min(1, c / ||grad_theta f_i||)

    Biased as soon as any sample is clipped; the added bias is at most E max(0, ||grad f_i|| - c).

    Reference: Pascanu, Mikolov, Bengio, "On the difficulty of training recurrent neural networks", ICML 2013, where the
    mean is clipped.
    """
    rows = first_order(differentiation).per_sample
    largest = jnp.max(jnp.abs(rows), axis=1, keepdims=True)  # scaling by it keeps squares from overflowing
    scaled = rows / jnp.where(largest > 0, largest, 1.0)
    size = jnp.linalg.norm(scaled, axis=1, keepdims=True)
    bound = jnp.asarray(max_norm, rows.dtype)
    direction = scaled / jnp.where(largest > 0, size, 1.0)
    return summarise(jnp.where(largest * size > bound, bound * direction, rows))
