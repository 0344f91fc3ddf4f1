"""Estimates from batches step by step: costs to go, weights of single steps, a test for jumps, backward recursions."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from estimators.batches import AlphaChoice, Evaluation, GradientEstimate, StepDifferentiation, StepEvaluation, pull_back
from estimators.choices import PLUG_IN, PUBLISHED_TOLERANCE
from estimators.interpolation import apply_choice, inverse_variance_alpha, weigh_batches
from estimators.samples import Rows, finite_rows
from estimators.statistics import summarise
from estimators.zeroth_first import find_baseline, zeroth_order

Controls = Float[Array, "samples steps controls"]
StepWeights = Float[Array, "steps controls"]


def cost_to_go(steps: StepEvaluation, baseline: str) -> GradientEstimate:
    """Zeroth-order batched gradient that credits a step's noise with the cost from that step on.

        g_i = sum_h D_theta pi(x_h^i)^T grad psi(w_h^i) (V_h^i - b_h^i)

    Same mean as with total costs, since earlier costs do not depend on a step's noise, and less variance.

    The baseline is applied step by step; a name that is not in `BASELINES` is a ValueError.

    Reference: Suh et al. 2022, appendix on the policy gradient.
    """
    return summarise(pull_back(control_scores(steps, baseline), steps.policy_jacobian))


def control_scores(steps: StepEvaluation, baseline: str) -> Controls:
    """grad psi(w_h^i) (V_h^i - b_h^i), a zeroth-order sample of dV/du_h, [cost/control]."""
    found = find_baseline(baseline)

    def advantage(value: Float[Array, " samples"], zero_noise: Float[Array, " samples"]) -> Float[Array, " samples"]:
        none = jnp.zeros((value.shape[0], 0), value.dtype)
        return value - found(Evaluation(value, none, zero_noise))

    advantages = jax.vmap(advantage, in_axes=1, out_axes=1)(steps.value_to_go, steps.baseline_to_go)
    return steps.noise_score * advantages[:, :, None]


def node_variance(samples: Float[Array, "samples ..."], finite: Bool[Array, " samples"]) -> Float[Array, "..."]:
    """Variance of each entry over the samples marked as finite; NaN for fewer than two."""
    mask = finite.reshape(-1, *(1,) * (samples.ndim - 1))
    count = jnp.sum(finite).astype(samples.dtype)
    mean = jnp.sum(jnp.where(mask, samples, 0.0), axis=0) / count
    squares = jnp.sum(jnp.where(mask, (samples - mean[None]) ** 2, 0.0), axis=0)
    return jnp.where(count > 1, squares / jnp.maximum(count - 1.0, 1.0), jnp.nan)


def stepwise_inverse_variance(
    zeroth: StepEvaluation, first: StepDifferentiation, baseline: str, weights: str = PLUG_IN
) -> GradientEstimate:
    """Inverse-variance weights for every step and control (IVW-H); the estimate's `alpha` holds their mean.

        g_i = sum_h D_theta pi^T [ alpha_h * dV^i/du_h + (1 - alpha_h) * grad psi(w_h^i) (V_h^i - b_h^i) ]

    where alpha_h of each control is the inverse-variance weight, over the batch, of the two quantities that it weights.
    The batches are independent and of the same size, and each is pulled back through its own states. Variance and
    standard errors treat the weights as fixed.

    Raises:
        ValueError: The batches differ in shape, or `baseline` or `weights` is not in `BASELINES` or `WEIGHTS`.

    Reference: Onoda, Parmas, Yaguchi, Matsuo, arXiv 2604.18161, ICLR 2026.
    """
    shapes = zeroth.noise_score.shape, first.noise_gradient.shape
    if shapes[0] != shapes[1]:
        raise ValueError(
            "the two batches must have the same shape (samples, steps, controls); "
            f"got {shapes[0]} zeroth-order and {shapes[1]} first-order"
        )

    def parts(zeroth: StepEvaluation, first: StepDifferentiation) -> tuple[Controls, Controls]:
        kept = jnp.isfinite(first.value)[:, None, None]
        return control_scores(zeroth, baseline), jnp.where(kept, first.noise_gradient, jnp.nan)

    def choose(zeroth: StepEvaluation, first: StepDifferentiation) -> StepWeights:
        variances = (node_variance(part, finite_rows(flat(part))) for part in parts(zeroth, first))
        return inverse_variance_alpha(*variances)

    def mix(alpha: StepWeights, zeroth: StepEvaluation, first: StepDifferentiation) -> GradientEstimate:
        lower, upper = (
            summarise(pull_back(jnp.where(weight == 0, 0.0, weight[None] * part), batch.policy_jacobian))
            for weight, part, batch in zip((1.0 - alpha, alpha), parts(zeroth, first), (zeroth, first), strict=True)
        )
        samples = Rows(lower.per_sample + upper.per_sample)
        return GradientEstimate(
            samples=samples,
            mean=lower.mean + upper.mean,
            variance=lower.variance + upper.variance,
            standard_error=jnp.hypot(lower.standard_error, upper.standard_error),
            num_finite=samples.num_finite,
            alpha=AlphaChoice(jnp.mean(alpha)),
        )

    return weigh_batches(choose, mix, (zeroth, first), weights)


def flat(samples: Controls) -> Float[Array, "samples entries"]:
    return samples.reshape(samples.shape[0], -1)


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
        evaluation: For f and the zeroth-order estimate.
        differentiation: Batch of the same number of independent samples.
        baseline: A name in `BASELINES`, for the zeroth-order estimate.
        sigma: Standard deviation of the Gaussian noise, [control].
        tolerance: c in [0, 1); 0.3 as published.
        weights: A name in `WEIGHTS`; if cross-fitted, the test also uses the other half.

    Raises:
        ValueError: The tolerance is outside [0, 1), or the batches differ in shape.

    Reference: Onoda, Parmas, Yaguchi, Matsuo, arXiv 2604.18161, ICLR 2026.
    """
    if not 0.0 <= tolerance < 1.0:
        raise ValueError(f"tolerance must lie in [0, 1); got {tolerance}")

    def parts(evaluation: Evaluation, differentiation: StepDifferentiation) -> tuple[GradientEstimate, ...]:
        first = summarise(pull_back(_noise_gradients(differentiation), differentiation.policy_jacobian))
        return zeroth_order(evaluation, baseline), first

    def choose(evaluation: Evaluation, differentiation: StepDifferentiation) -> AlphaChoice:
        zeroth, first = parts(evaluation, differentiation)
        over_noise = summarise(flat(_noise_gradients(differentiation)))
        value_variance = node_variance(evaluation.value, jnp.isfinite(evaluation.value))
        scale = jnp.asarray(sigma, over_noise.mean.dtype) ** 2
        expected = 2.0 * (1.0 - tolerance) * value_variance / scale - 2.0 * jnp.sum(over_noise.mean**2)
        continuous = over_noise.variance >= expected  # False if either is undefined
        alpha = jnp.where(continuous, inverse_variance_alpha(zeroth.variance, first.variance), 0.0)
        return AlphaChoice(alpha, variance_zeroth=zeroth.variance, variance_first=first.variance)

    def mix(choice: AlphaChoice, evaluation: Evaluation, differentiation: StepDifferentiation) -> GradientEstimate:
        return apply_choice(choice, *parts(evaluation, differentiation))

    return weigh_batches(choose, mix, (evaluation, differentiation), weights)


def _noise_gradients(differentiation: StepDifferentiation) -> Controls:
    """grad_w f of each sample; NaN if it or the sample's value is not finite."""
    gradients = differentiation.noise_gradient
    kept = jnp.isfinite(differentiation.value) & finite_rows(flat(gradients))
    return jnp.where(kept[:, None, None], gradients, jnp.nan)
