"""Inverse-variance weighting gated by a test for discontinuities."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.alpha import interpolate, inverse_variance_alpha
from estimators.catalogue import PLUG_IN, PUBLISHED_TOLERANCE
from estimators.cross_fitting import weigh_batches
from estimators.rows import finite_rows
from estimators.statistics import summarise
from estimators.stepwise import node_variance
from estimators.types import AlphaChoice, Evaluation, GradientEstimate, StepDifferentiation, pull_back
from estimators.zeroth import zeroth_order


def discontinuity_gated(
    evaluation: Evaluation,
    differentiation: StepDifferentiation,
    baseline: str,
    sigma: float | Float[Array, ""],
    tolerance: float = PUBLISHED_TOLERANCE,
    weights: str = PLUG_IN,
) -> GradientEstimate:
    """Discontinuity detection by composite gradients (DDCG).

        alpha = alpha_inf   if   tr Cov[grad_w f] >= 2 (1 - c) Var[f] / sigma^2 - 2 ||E grad_w f||^2,   else 0

    where alpha_inf is the inverse-variance weight. For quadratic f and Gaussian noise, both sides are equal at c = 0; a
    jump adds to Var[f] but not to the derivatives and so increases the right side. There is no accuracy gamma and no
    radius to choose, and no guarantee if the test is wrong.

    Args:
        evaluation: Batch of evaluations, for f and the zeroth-order estimate.
        differentiation: Batch of differentiations from the same number of independent samples.
        baseline: A name in `BASELINES`, for the zeroth-order estimate.
        sigma: Standard deviation of the Gaussian noise, [control].
        tolerance: c in [0, 1); 0.3 as published.
        weights: A name in `WEIGHTS`; if cross-fitted, the test also uses the other half.

    Returns:
        The estimate, with its `alpha`.

    Raises:
        ValueError: The tolerance is outside [0, 1), or the batches differ in shape.

    Reference: Onoda, Parmas, Yaguchi, Matsuo, arXiv 2604.18161, ICLR 2026.
    """
    if not 0.0 <= tolerance < 1.0:
        raise ValueError(f"the tolerance of the discontinuity test must lie in [0, 1); got {tolerance}")

    def choose(evaluation: Evaluation, differentiation: StepDifferentiation) -> AlphaChoice:
        zeroth, first = zeroth_order(evaluation, baseline), _first_order(differentiation)
        over_noise = summarise(_noise_gradients(differentiation))
        value_variance = node_variance(evaluation.value, jnp.isfinite(evaluation.value))
        scale = jnp.asarray(sigma, over_noise.mean.dtype) ** 2
        expected = 2.0 * (1.0 - tolerance) * value_variance / scale - 2.0 * jnp.sum(over_noise.mean**2)
        continuous = over_noise.variance >= expected  # False if either is undefined
        alpha = jnp.where(continuous, inverse_variance_alpha(zeroth.variance, first.variance), 0.0)
        return AlphaChoice(alpha, None, None, zeroth.variance, first.variance)

    def mix(choice: AlphaChoice, evaluation: Evaluation, differentiation: StepDifferentiation) -> GradientEstimate:
        mixed = interpolate(zeroth_order(evaluation, baseline), _first_order(differentiation), choice.alpha)
        return replace(mixed, alpha=choice)

    return weigh_batches(choose, mix, (evaluation, differentiation), weights)


def _noise_gradients(differentiation: StepDifferentiation) -> Float[Array, "samples noise"]:
    """grad_w f of each sample; NaN if it or the sample's value is not finite."""
    gradients = differentiation.noise_gradient.reshape(differentiation.value.shape[0], -1)
    kept = jnp.isfinite(differentiation.value) & finite_rows(gradients)
    return jnp.where(kept[:, None], gradients, jnp.nan)


def _first_order(differentiation: StepDifferentiation) -> GradientEstimate:
    gradients = _noise_gradients(differentiation).reshape(differentiation.noise_gradient.shape)
    return summarise(pull_back(gradients, differentiation.policy_jacobian))
