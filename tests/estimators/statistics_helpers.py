"""Assertions about random quantities, with a stated z-score and a failure without power; and about batches."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from estimators import ORACLES, GradientEstimate, pull_back, truncated_first_order


def assert_mean_is(per_sample: ArrayLike, exact: ArrayLike, *, z: float = 4.0, resolution: float = 0.05) -> None:
    """Two-sided z-test of mean(per_sample) == exact, which also fails when it has no power.

    per_sample: (samples, params); exact: (params,). `resolution` is the smallest error, relative to
    ||exact||, that the test must be able to see: z standard errors have to fit inside it.
    """
    samples, target = np.asarray(per_sample, np.float64), np.asarray(exact, np.float64)
    assert samples.ndim == 2 and target.shape == samples.shape[1:], (samples.shape, target.shape)
    mean = samples.mean(0)
    standard_error = samples.std(0, ddof=1) / np.sqrt(len(samples))
    scale = np.linalg.norm(target) or 1.0
    assert np.all(z * standard_error <= resolution * scale), f"no power: {z} SE = {z * standard_error}"
    rounding = len(samples) * np.finfo(np.float64).eps * np.abs(samples).max(0)  # of a running sum
    allowed = z * standard_error + rounding
    assert np.all(np.abs(mean - target) <= allowed), f"off by {mean - target}; SE {standard_error}"


def assert_variance_is(
    estimate: GradientEstimate, exact_mean: ArrayLike, exact_variance: float, *, resolution: float = 0.05
) -> None:
    """z-test of E||g - E g||^2 == `exact_variance`; the estimate's variance must be NumPy's."""
    rows = np.asarray(estimate.per_sample, np.float64)
    squares = np.sum((rows - np.asarray(exact_mean)) ** 2, axis=1)
    assert_mean_is(squares[:, None], [exact_variance], resolution=resolution)
    np.testing.assert_allclose(estimate.variance, np.trace(np.atleast_2d(np.cov(rows.T))), rtol=1e-10)


def binomial_standard_error(probability: float, trials: int) -> float:
    return float(np.sqrt(probability * (1.0 - probability) / trials))


def assert_batches_agree(batches: Mapping[str, Any], horizon: int, rtol: float = 1e-9) -> None:
    """Values, scores and gradients are the same in whichever batch they are, and pairs have opposite noise."""

    def close(one: jax.Array, other: jax.Array) -> None:
        np.testing.assert_allclose(one, other, rtol=rtol, atol=1e-12 + rtol * np.abs(other).max())

    evaluation, pair, steps, step_pair, gradients, _, by_step, linearisation = (batches[name] for name in ORACLES)
    for value in (steps.value_to_go[:, 0], gradients.value, by_step.value, linearisation.steps.value_to_go[:, 0]):
        close(value, evaluation.value)
    close(steps.baseline_to_go[:, 0], evaluation.baseline)
    close(linearisation.steps.baseline_to_go, steps.baseline_to_go)
    close(pull_back(steps.noise_score, steps.policy_jacobian), evaluation.score)
    close(pull_back(by_step.noise_gradient, by_step.policy_jacobian), gradients.gradient)
    close(truncated_first_order(linearisation, horizon).per_sample, gradients.gradient)
    for (plus, minus), whole, score in ((pair, evaluation, "score"), (step_pair, steps, "noise_score")):
        jax.tree.map(close, plus, whole)
        assert not np.allclose(getattr(minus, score), getattr(plus, score))
