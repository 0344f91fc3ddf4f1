"""Numbers of gradient estimates: those of each seed in one compiled program, and those over seeds."""

from collections.abc import Sequence
from functools import cache, partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

import estimators
from estimators import Batches, Estimator, GradientEstimate
from mjx_study.compiled import Compiled
from mjx_study.experiment.memory import BIAS_DRAWS
from mjx_study.experiment.tally import Tally, numbers_of, together
from mjx_study.results.variables import BATCH, GRADIENTS, ONSETS

MOST_KEPT: Final = 1_000_000
"""Maximum size of a cell's array of mean gradients; larger ones are not kept."""


def cell_numbers(
    numbers: Sequence[dict[str, Any]],
    reference: GradientEstimate,
    chosen: Sequence[Estimator],
    tallies: Sequence[dict[str, Tally]],
    samples: int,
) -> dict[str, np.ndarray]:
    """Assemble a cell's numbers from those of `estimate_numbers`, with a leading axis of seeds, the diagnostics of each
    seed's or group of seeds' batches, by oracle, and the number of samples of all seeds."""
    arrays = _of_seeds(numbers) | _bias(numbers, reference) | _of_batches(chosen, tallies, samples)
    if arrays["gradient"].size > MOST_KEPT:
        del arrays["gradient"]
    else:
        arrays["reference"] = np.asarray(reference.mean)
    return {name: np.asarray(array, float) for name, array in arrays.items()}


@cache
def seed_numbers(chosen: tuple[Estimator, ...], confidence: float) -> Compiled:
    """Compiled statistics of all estimators, batched over seeds: a function of batches, which may be padded, their
    number of samples, reference and keys."""

    def numbers(batches, samples, reference, key):
        estimates = [estimate_of(estimator, batches, samples) for estimator in chosen]
        found = estimate_numbers(estimates, reference, key, confidence)
        padding = len(batches["evaluation"].value) - samples
        return [row | {"nonfinite": row["nonfinite"] - padding} for row in found]

    return Compiled(jax.vmap(numbers, (0, None, None, 0)), "numbers of seeds", chosen, confidence)


def estimate_of(estimator: Estimator, batches: Batches, samples: Any) -> GradientEstimate:
    """The estimate from the first samples of batches, the others being padding if the estimator is mergeable."""
    if not estimator.mergeable:
        return estimator(batches)
    parts = [part.per_sample for part in estimator.parts(*estimator.pick(batches))]
    real = jnp.arange(len(parts[0]))[:, None] < samples
    return estimator.join(*(estimators.summarise(jnp.where(real, part, jnp.nan)) for part in parts))


def padded(leaf: Any, size: int) -> Any:
    """Batches of several seeds with copies of their last sample, up to a size."""
    samples = leaf.shape[1]
    return leaf if samples == size else np.asarray(leaf)[:, np.minimum(np.arange(size), samples - 1)]


@partial(jax.jit, static_argnames="chosen")
def samples_of_parts(batches: Batches, chosen: tuple[Estimator, ...]) -> list[list[Array]]:
    return [[part.per_sample for part in each.parts(*each.pick(batches))] for each in chosen]


def estimate_numbers(
    estimates: Sequence[GradientEstimate], reference: GradientEstimate, key: Key[Array, ""], confidence: float
) -> list[dict[str, Any]]:
    """Compute the numbers of each estimate that depend only on its samples and the reference gradient."""
    result = []
    reference_effective = estimators.effective_samples(reference).count
    for estimate in estimates:
        lower, upper = estimators.variance_interval(estimate, confidence)
        median, high, most = estimators.norm_quantiles(estimate, (0.5, 0.9, 1.0))
        effective = estimators.effective_samples(estimate)
        test = estimators.bias_test(estimate, reference, jax.random.clone(key), num_draws=BIAS_DRAWS)
        result.append(
            {
                "gradient": estimate.mean,
                "gradient_norm": jnp.linalg.norm(estimate.mean),
                "variance": estimate.variance,
                "variance_lower": lower,
                "variance_upper": upper,
                "norm_median": median,
                "norm_90": high,
                "norm_max": most,
                "effective_samples": effective.count,
                "top_share": effective.top_share,
                "reference_norm": jnp.linalg.norm(reference.mean),
                "reference_effective_samples": reference_effective,
                **{name: getattr(estimate.alpha, name, None) for name in ("alpha", "epsilon", "discrepancy")},
                "bias_p_value": test.p_value,
                "nonfinite": estimate.num_nonfinite,
            }
            | {name: value for name, value in vars(estimators.compare(estimate, reference)).items() if name != "error"}
        )
    return result


def _of_batches(
    chosen: Sequence[Estimator], tallies: Sequence[dict[str, Tally]], samples: int
) -> dict[str, np.ndarray]:
    """Times, residuals and onset counts of each estimator's batches."""
    merged = [together(each[oracle] for each in tallies for oracle in estimator.needs) for estimator in chosen]
    arrays = {
        "seconds_per_sample": np.array([each.seconds / samples for each in merged]),
        "residual": np.array([each.residual for each in merged]),
        "unconverged": np.array([each.unconverged for each in merged]),
    }
    numbers = np.stack([numbers_of(each.onsets) for each in merged], axis=-1)
    if np.any(np.isfinite(numbers)):
        arrays |= dict(zip(ONSETS, numbers, strict=True))
    return arrays


def _of_seeds(numbers: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Numbers by seed and estimator, NaN where not applicable, and those of the reference."""
    seeds = len(numbers[0]["gradient"])
    arrays = {
        name: np.stack([np.full(seeds, np.nan) if row[name] is None else row[name] for row in numbers], axis=1)
        for name, variable in GRADIENTS.items()
        if variable.dims == BATCH
    }
    first = numbers[0]  # the reference's numbers are the same for every estimator and seed
    arrays["gradient"] = np.stack([row["gradient"] for row in numbers], axis=1)
    return arrays | {
        name: np.asarray(first[name][0]) for name in first if name in GRADIENTS and not GRADIENTS[name].dims
    }


def _bias(numbers: Sequence[dict[str, Any]], reference: GradientEstimate) -> dict[str, np.ndarray]:
    """Each estimator's bias relative to the norm of the reference, from the means of its seeds; nothing is compiled for
    their number."""
    means, reference = np.stack([row["gradient"] for row in numbers]), jax.device_get(reference)
    square = np.sum(reference.mean**2)
    with np.errstate(all="ignore"):
        squared, errors = zip(*(estimators.squared_bias_of_means(each, reference) for each in means), strict=True)
        gaps = np.linalg.norm(np.mean(means, axis=1) - reference.mean, axis=-1)
        return {
            "squared_bias": np.stack(squared) / square,
            "squared_bias_se": np.stack(errors) / square,
            "pooled_error": gaps / np.sqrt(square),
        }
