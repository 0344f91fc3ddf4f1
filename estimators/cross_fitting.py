"""Interpolation weights, plug-in or cross-fitted."""

from collections.abc import Callable, Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array

from estimators.catalogue import CROSS_FITTED, PLUG_IN, WEIGHTS
from estimators.rows import Rows
from estimators.types import GradientEstimate

FEWEST_SAMPLES: Final = 4
"""Two in each half, the fewest for a variance."""


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

    Args:
        choose: Maps batches to weights.
        mix: Maps weights and batches to an estimate.
        batches: Batches whose arrays have the samples as first axis.
        weights: A name in `WEIGHTS`.

    Returns:
        The estimate. If cross-fitted, each row is weighted by the other half's weights, and `variance` is the mean of
        the within-half variances: n times the variance of the mean at given weights, as for one batch. This omits the
        covariance of the halves: the squared bias of plug-in weights from n/2 samples, half of which enters the
        variance of the mean. `alpha` is the mean of both choices.

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
    """Validate the name of weights and the number of samples for cross-fitting.

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
    """Average estimates from independent samples over all samples."""
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
