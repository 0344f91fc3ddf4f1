"""Weights chosen from the samples that they weigh, or from others."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array

from estimators.catalogue import CROSS_FITTED, PLUG_IN, WEIGHTS
from estimators.rows import Rows
from estimators.types import GradientEstimate

FEWEST_SAMPLES: Final = 4
"""Two in each half, for a variance."""


def weigh_batches(
    choose: Callable[..., Any], mix: Callable[..., GradientEstimate], batches: Sequence[Any], weights: str
) -> GradientEstimate:
    """An interpolated estimate whose weights come from its own samples or from the other half of them.

        plug-in:       mix(choose(b), b)
        cross-fitted:  (n_1 mix(choose(b_2), b_1) + n_2 mix(choose(b_1), b_2)) / n

    with b_1 and b_2 the first n_1 = floor(n/2) and the last n_2 samples of every batch. A plug-in weight depends on
    the samples that it weighs, which biases the mean by order 1/n even where both batches are unbiased. Cross-fitted
    weights are independent of them, so that the mean is as unbiased as the batches are; choosing from half of the
    samples costs variance. All that chooses comes from the other half, an accuracy bound's epsilon and B included; a
    baseline that looks at other samples looks at those of its own half.

    Args:
        choose: Of batches, the weights.
        mix: Of weights and batches, the estimate.
        batches: Every array has the samples first.
        weights: A name in `WEIGHTS`.

    Returns:
        The estimate. Cross-fitted, a row is weighed by the other half's weights, and `variance` is the mean of the
        variances within the halves: n times the variance of the mean at given weights, as for one batch. That leaves
        out the halves' covariance, the square of the bias that plug-in weights of n/2 samples would have had, and
        half of it in the mean. `alpha` is the mean of both choices.

    Raises:
        ValueError: No weights have that name, or there are too few samples for two halves.

    Reference: Chernozhukov et al., "Double/debiased machine learning for treatment and structural parameters",
    Econometrics Journal 21, 2018.
    """
    check_weights(weights)
    if weights == PLUG_IN:
        return mix(choose(*batches), *batches)
    samples = len(jax.tree.leaves(batches)[0])
    check_weights(weights, samples)
    first, second = (
        jax.tree.map(lambda leaf, part=part: leaf[part], tuple(batches))
        for part in (slice(samples // 2), slice(samples // 2, None))
    )
    halves = [mix(choose(*other), *half) for half, other in ((first, second), (second, first))]
    return _pooled(halves)


def check_weights(weights: str, samples: int | None = None) -> None:
    """Refuse a name that is none, and cross-fitted weights of too few samples.

    Raises:
        ValueError: No weights have that name, or there are too few samples for two halves.
    """
    if weights not in WEIGHTS:
        raise ValueError(f"weights must be one of {', '.join(WEIGHTS)}; got {weights!r}")
    if weights == CROSS_FITTED and samples is not None and samples < FEWEST_SAMPLES:
        raise ValueError(
            f"cross-fitted weights need at least {FEWEST_SAMPLES} samples, two in each half; got {samples}"
        )


def _pooled(parts: Sequence[GradientEstimate]) -> GradientEstimate:
    """The mean over all samples of estimates from independent ones."""
    rows = jnp.concatenate([part.per_sample for part in parts])
    shares = [len(part.per_sample) / len(rows) for part in parts]

    def average(*values: Array) -> Array:
        return jnp.asarray(sum(share * value for share, value in zip(shares, values, strict=True)))

    return GradientEstimate(
        samples=Rows(rows),
        mean=average(*(part.mean for part in parts)),
        variance=average(*(part.variance for part in parts)),
        standard_error=jnp.sqrt(
            sum((share * part.standard_error) ** 2 for share, part in zip(shares, parts, strict=True))
        ),
        num_finite=sum((part.num_finite for part in parts[1:]), parts[0].num_finite),
        alpha=jax.tree.map(average, *(part.alpha for part in parts)),
    )
