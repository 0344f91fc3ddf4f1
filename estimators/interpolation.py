"""Interpolation between zeroth- and first-order estimates: its weight, and weights plug-in or cross-fitted."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from estimators.batches import AlphaChoice, GradientEstimate
from estimators.choices import CROSS_FITTED, PLUG_IN, WEIGHTS, unknown
from estimators.samples import Rows, weigh

FEWEST_SAMPLES: Final = 4  # two in each half, the fewest for a variance
Scalar = Float[Array, ""]


def inverse_variance_alpha(
    variance_zeroth: Float[Array, "*nodes"], variance_first: Float[Array, "*nodes"]
) -> Float[Array, "*nodes"]:
    """Return the inverse-variance weight alpha = sigmahat_0^2 / (sigmahat_0^2 + sigmahat_1^2), in [0, 1].

    It is 0 where the variances do not determine it (both zero, both infinite, or either one undefined): a first-order
    batch must earn its weight.

    The variances are >= 0, [cost^2/param^2], one of each for each weight.

    Reference: Suh et al. 2022, lemma on the closed form, gamma = infinity.
    """
    ratio = variance_first / jnp.where(variance_zeroth == 0, 1.0, variance_zeroth)  # a sum of both could overflow
    alpha = jnp.where(variance_zeroth == 0, 0.0, 1.0 / (1.0 + ratio))
    return jnp.where(jnp.isnan(alpha) | jnp.isnan(variance_first), 0.0, alpha)


def constrained_alpha(
    variance_zeroth: Scalar, variance_first: Scalar, discrepancy: Scalar, epsilon: float | Scalar, gamma: float | Scalar
) -> Scalar:
    """Return the minimum-variance weight, in [0, 1], whose error bound is at most gamma.

        min_alpha  alpha^2 sigmahat_1^2 + (1 - alpha)^2 sigmahat_0^2   s.t.  epsilon + alpha B <= gamma

    The solution is the smaller of the inverse-variance weight and (gamma - epsilon)/B. If epsilon > gamma, nothing is
    feasible and alpha = 0. B = 0 never binds. gamma = infinity gives inverse-variance weighting for any epsilon and B;
    for a finite gamma, an undefined epsilon or B gives alpha = 0.

    Args:
        variance_zeroth: sigmahat_0^2 >= 0, [cost^2/param^2].
        variance_first: sigmahat_1^2 >= 0, [cost^2/param^2].
        discrepancy: B = ||gbar_1 - gbar_0||, [cost/param].
        epsilon: Confidence radius of the zeroth-order mean, [cost/param].
        gamma: Largest acceptable error, [cost/param].

    Reference: Suh et al. 2022, eq. of the robust interpolation and lemma on its closed form. The stationarity
    condition in that proof must read 2 alpha sigmahat_1^2 - 2 (1 - alpha) sigmahat_0^2 + lambda B = 0
    (printed with a plus).
    """
    dtype = variance_zeroth.dtype
    epsilon, gamma = jnp.asarray(epsilon, dtype), jnp.asarray(gamma, dtype)
    unconstrained = inverse_variance_alpha(variance_zeroth, variance_first)
    touches = discrepancy == 0
    largest = jnp.where(touches, 1.0, (gamma - epsilon) / jnp.where(touches, 1.0, discrepancy))
    alpha = jnp.where(epsilon <= gamma, jnp.minimum(unconstrained, largest), 0.0)
    alpha = jnp.where(jnp.isnan(alpha), 0.0, alpha)
    return jnp.where(gamma == jnp.inf, unconstrained, alpha)


def interpolate(zeroth: GradientEstimate, first: GradientEstimate, alpha: float | Scalar) -> GradientEstimate:
    """Alpha-order batched gradient for a given weight of `first`, in [0, 1]; its `alpha` is None.

        gbar = alpha gbar_1 + (1 - alpha) gbar_0
        sigmahat^2 = alpha^2 sigmahat_1^2 + (1 - alpha)^2 sigmahat_0^2,  likewise for squared standard errors

    Assumes independent batches. Sample i pairs row i of one batch with row i of the other; by independence, the pairing
    is arbitrary. The empirical variance of the pairs differs from sigmahat^2 by the chance correlation of the batches.
    A batch of weight 0 is ignored, NaN included. For a fixed alpha, the bias is alpha times that of the first-order
    batch.

    Raises:
        ValueError: The batches differ in shape.

    Reference: Suh et al. 2022, def. of the AoBG and lemmas on its bias and variance (the last line of the
    latter swaps the two variances).
    """
    if zeroth.samples.shape != first.samples.shape:
        raise ValueError(
            "the two batches must have the same shape (samples, params); "
            f"got {zeroth.samples.shape} zeroth-order and {first.samples.shape} first-order; "
            "draw the same number of samples for both"
        )
    alpha = jnp.asarray(alpha, zeroth.samples.dtype)

    linear, squared = (1.0 - alpha, alpha), ((1.0 - alpha) ** 2, alpha**2)
    samples = zeroth.samples.mixed(linear, first.samples)
    return GradientEstimate(
        samples=samples,
        mean=weigh(linear, zeroth.mean, first.mean),
        variance=weigh(squared, zeroth.variance, first.variance),
        standard_error=jnp.sqrt(weigh(squared, zeroth.standard_error**2, first.standard_error**2)),
        num_finite=samples.num_finite,
    )


def apply_choice(choice: AlphaChoice, zeroth: GradientEstimate, first: GradientEstimate) -> GradientEstimate:
    """Interpolate with a chosen weight, and keep the choice; variance and standard errors treat it as fixed."""
    return replace(interpolate(zeroth, first, choice.alpha), alpha=choice)


def choose_alpha(
    zeroth: GradientEstimate,
    first: GradientEstimate,
    *,
    gamma: float | Scalar = math.inf,
    epsilon: float | Scalar | None = None,
) -> AlphaChoice:
    """Choose the weight of an alpha-order batched gradient (AoBG) with `constrained_alpha`, and record its inputs.

    Assumes independent batches of the same size. Applied to the samples it is computed from (`apply_choice`), the
    weight biases the mean at order 1/N, which `weigh_batches` avoids.

    Args:
        zeroth: Zeroth-order estimate, assumed unbiased.
        first: First-order estimate from the same number of independent samples.
        gamma: Largest acceptable error, [cost/param]; infinity for inverse-variance weighting.
        epsilon: Confidence radius of the zeroth-order mean, [cost/param]; see `bernstein_epsilon`. None if gamma is
            infinite.

    Reference: Suh et al. 2022, sec. "alpha-order gradient estimator".
    """
    discrepancy = jnp.linalg.norm(first.mean - zeroth.mean)
    radius = 0.0 if epsilon is None else epsilon
    return AlphaChoice(
        alpha=constrained_alpha(zeroth.variance, first.variance, discrepancy, radius, gamma),
        epsilon=None if epsilon is None else jnp.asarray(epsilon, zeroth.samples.dtype),
        discrepancy=discrepancy,
        variance_zeroth=zeroth.variance,
        variance_first=first.variance,
    )


def alpha_order(
    zeroth: GradientEstimate, first: GradientEstimate, *, gamma: float | Scalar, epsilon: float | Scalar
) -> GradientEstimate:
    """Alpha-order batched gradient (AoBG), weighted by the samples that it averages; arguments of `choose_alpha`."""
    return apply_choice(choose_alpha(zeroth, first, gamma=gamma, epsilon=epsilon), zeroth, first)


def weigh_batches(
    choose: Callable[..., Any], mix: Callable[..., GradientEstimate], batches: Sequence[Any], weights: str
) -> GradientEstimate:
    """Interpolate with weights from the samples themselves or from the other half of them.

        plug-in:       mix(choose(b), b)
        cross-fitted:  (n_1 mix(choose(b_2), b_1) + n_2 mix(choose(b_1), b_2)) / n

    where b_1 and b_2 are the first n_1 = floor(n/2) and the last n_2 samples of every batch. A plug-in weight depends
    on the samples it is applied to, which biases the mean at order 1/n even if both batches are unbiased. Cross-fitted
    weights are independent of them, so the mean is as unbiased as the batches; using half of the samples costs
    variance. Everything that enters the choice comes from the other half, including epsilon and B of an accuracy bound;
    a baseline over other samples uses those of its own half.

    Returns:
        The estimate. If cross-fitted, each row is weighted by the other half's weights, and `variance` is the mean of
        the within-half variances: n times the variance of the mean at given weights, as for one batch. This omits the
        covariance of the halves: the squared bias of plug-in weights from n/2 samples, half of which enters the
        variance of the mean. `alpha` is the mean of both choices.

    Raises:
        ValueError: No weights in `WEIGHTS` have that name, or there are too few samples for two halves.

    Reference: Chernozhukov et al., "Double/debiased machine learning for treatment and structural parameters",
    Econometrics Journal 21, 2018.
    """
    samples = len(jax.tree.leaves(batches)[0])
    check_weights(weights, samples)
    if weights == PLUG_IN:
        return mix(choose(*batches), *batches)
    first, second = (
        jax.tree.map(lambda leaf, part=part: leaf[part], tuple(batches))
        for part in (slice(samples // 2), slice(samples // 2, None))
    )
    return _pooled(mix(choose(*second), *first), mix(choose(*first), *second))


def check_weights(weights: str, samples: int | None = None) -> None:
    """Validate the name of weights and, if given, the number of samples for cross-fitting."""
    if weights not in WEIGHTS:
        raise ValueError(unknown("weights", weights, WEIGHTS))
    if weights == CROSS_FITTED and samples is not None and samples < FEWEST_SAMPLES:
        raise ValueError(
            f"cross-fitted weights need at least {FEWEST_SAMPLES} samples, two in each half; got {samples}"
        )


def _pooled(*parts: GradientEstimate) -> GradientEstimate:
    """Average estimates from independent samples over all samples."""
    rows = jnp.concatenate([part.per_sample for part in parts])
    shares = [len(part.per_sample) / len(rows) for part in parts]

    def average(*values: Array) -> Array:
        return jnp.asarray(sum(share * value for share, value in zip(shares, values, strict=True)))

    mean, variance, alpha = jax.tree.map(average, *((part.mean, part.variance, part.alpha) for part in parts))
    squares = sum((share * part.standard_error) ** 2 for share, part in zip(shares, parts, strict=True))
    num_finite = jnp.asarray(sum(part.num_finite for part in parts))
    return GradientEstimate(Rows(rows), mean, variance, jnp.sqrt(squares), num_finite, alpha)
