"""Step-by-step estimates: costs to go instead of total costs, and a weight for every step."""

from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from estimators.alpha import inverse_variance_alpha
from estimators.baselines import find_baseline
from estimators.catalogue import PLUG_IN
from estimators.cross_fitting import weigh_batches
from estimators.rows import Rows, finite_rows
from estimators.statistics import summarise
from estimators.types import AlphaChoice, Evaluation, GradientEstimate, StepDifferentiation, StepEvaluation, pull_back

Controls = Float[Array, "samples steps controls"]


def cost_to_go(steps: StepEvaluation, baseline: str) -> GradientEstimate:
    """Zeroth-order batched gradient that credits a step's noise with the cost from that step on.

        g_i = sum_h D_theta pi(x_h^i)^T grad psi(w_h^i) (V_h^i - b_h^i)

    Same mean as with total costs, since earlier costs do not depend on a step's noise, and less variance.

    Args:
        steps: Batch of stepwise evaluations, (samples, steps).
        baseline: A name in `BASELINES`, applied step by step.

    Raises:
        ValueError: No baseline has that name.

    Reference: Suh et al. 2022, appendix on the policy gradient.
    """
    return summarise(pull_back(control_scores(steps, baseline), steps.policy_jacobian))


def antithetic_cost_to_go(plus: StepEvaluation, minus: StepEvaluation, baseline: str) -> GradientEstimate:
    """`cost_to_go` over pairs of opposite noise; each pair is one sample."""
    above, below = (cost_to_go(steps, baseline).per_sample for steps in (plus, minus))
    return summarise((above + below) / 2.0)


def control_scores(steps: StepEvaluation, baseline: str) -> Float[Array, "samples steps controls"]:
    """grad psi(w_h^i) (V_h^i - b_h^i), a zeroth-order sample of dV/du_h, [cost/control].

    Raises:
        ValueError: No baseline has that name.
    """
    found = find_baseline(baseline)

    def advantage(value: Float[Array, " samples"], zero_noise: Float[Array, " samples"]) -> Float[Array, " samples"]:
        none = jnp.zeros((value.shape[0], 0), value.dtype)
        return value - found(Evaluation(value, none, zero_noise))

    advantages = jax.vmap(advantage, in_axes=1, out_axes=1)(steps.value_to_go, steps.baseline_to_go)
    return steps.noise_score * advantages[:, :, None]


def stepwise_inverse_variance(
    zeroth: StepEvaluation, first: StepDifferentiation, baseline: str, weights: str = PLUG_IN
) -> GradientEstimate:
    """Inverse-variance weights for every step and control (IVW-H).

        g_i = sum_h D_theta pi^T [ alpha_h * dV^i/du_h + (1 - alpha_h) * grad psi(w_h^i) (V_h^i - b_h^i) ]

    where alpha_h of each control is the inverse-variance weight, over the batch, of the two quantities that it weights.
    The batches are independent, and each is pulled back through its own states. Variance and standard errors treat the
    weights as fixed.

    Args:
        zeroth: Batch of stepwise evaluations, (samples, steps).
        first: Batch of differentiations from the same number of independent samples.
        baseline: A name in `BASELINES`, applied step by step.
        weights: A name in `WEIGHTS`, the source of alpha_h.

    Returns:
        The estimate; its `alpha` holds the mean weight.

    Raises:
        ValueError: The batches differ in shape, or no baseline has that name.

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

    def choose(zeroth: StepEvaluation, first: StepDifferentiation) -> Float[Array, "steps controls"]:
        return inverse_variance_alpha(*(_node_variances(part) for part in parts(zeroth, first)))

    def mix(
        alpha: Float[Array, "steps controls"], zeroth: StepEvaluation, first: StepDifferentiation
    ) -> GradientEstimate:
        lower, upper = (
            summarise(pull_back(jnp.where(weight == 0, 0.0, weight[None] * part), batch.policy_jacobian))
            for weight, part, batch in zip((1.0 - alpha, alpha), parts(zeroth, first), (zeroth, first), strict=True)
        )
        choice = AlphaChoice(jnp.mean(alpha), None, None, None, None)
        return replace(sum_independent(lower, upper), alpha=choice)

    return weigh_batches(choose, mix, (zeroth, first), weights)


def sum_independent(one: GradientEstimate, other: GradientEstimate) -> GradientEstimate:
    """Sum estimates from independent batches of the same size; row i of one is paired with row i of the other."""
    samples = Rows(one.per_sample + other.per_sample)
    return GradientEstimate(
        samples=samples,
        mean=one.mean + other.mean,
        variance=one.variance + other.variance,
        standard_error=jnp.hypot(one.standard_error, other.standard_error),
        num_finite=samples.num_finite,
    )


def _node_variances(samples: Float[Array, "samples steps controls"]) -> Float[Array, "steps controls"]:
    """Variance over the samples with only finite entries."""
    finite = finite_rows(samples.reshape(samples.shape[0], -1))
    return node_variance(samples, finite)


def node_variance(samples: Float[Array, "samples ..."], finite: Bool[Array, " samples"]) -> Float[Array, "..."]:
    """Variance of each entry over the samples marked as finite; NaN for fewer than two."""
    mask = finite.reshape(-1, *(1,) * (samples.ndim - 1))
    count = jnp.sum(finite).astype(samples.dtype)
    mean = jnp.sum(jnp.where(mask, samples, 0.0), axis=0) / count
    squares = jnp.sum(jnp.where(mask, (samples - mean[None]) ** 2, 0.0), axis=0)
    return jnp.where(count > 1, squares / jnp.maximum(count - 1.0, 1.0), jnp.nan)
