"""Draw the batches that estimators need from an objective, and estimate its gradient."""

from collections.abc import Iterable, Sequence
from typing import Any

import jax
from jaxtyping import Array, Float, Key

from estimators.batches import GradientEstimate, Objective
from estimators.choices import ORACLES
from estimators.estimator import Estimator
from estimators.registry import make_estimator


def draw(
    oracles: Iterable[str], objective: Objective, theta: Float[Array, " params"], key: Key[Array, ""], num_samples: int
) -> dict[str, Any]:
    """Draw batches by name in `ORACLES`; those of order 0 and those of order 1 use separate sets of keys.

    Args:
        theta: Parameters, [param].
        key: Random key; consumed.
        num_samples: Samples per batch, >= 1.

    Raises:
        ValueError: The objective lacks a method that an oracle calls.
    """
    return draw_at(oracles, objective, theta, sample_keys(key, num_samples))


def sample_keys(key: Key[Array, ""], num_samples: int) -> list[Key[Array, " samples"]]:
    """Split a key into the sample keys of each order, as `draw` does."""
    return [jax.random.split(order_key, num_samples) for order_key in jax.random.split(key)]


def draw_at(
    oracles: Iterable[str],
    objective: Objective,
    theta: Float[Array, "*samples params"],
    keys: Sequence[Key[Array, " samples"]],
) -> dict[str, Any]:
    """Draw with keys from `sample_keys`; theta may have one row per sample if the objective supports it."""
    batches = {}
    for name in oracles:
        oracle = ORACLES[name]
        method = getattr(objective, oracle.method, None)
        if method is None:
            raise ValueError(f"{type(objective).__name__} has no method {oracle.method} for {oracle.phrase}")
        batches[name] = method(theta, jax.random.clone(keys[oracle.order]))  # shared on purpose
    return batches


def estimate(
    estimator: str | Estimator,
    objective: Objective,
    theta: Float[Array, " params"],
    key: Key[Array, ""],
    num_samples: int,
) -> GradientEstimate:
    """Draw only the batches that an estimator needs, and estimate grad F(theta).

    The two orders use independent keys; for the same key, each order's samples are the same for every estimator.

    Args:
        estimator: Estimator object, or the name of one whose options are left at their defaults.
        theta: Parameters, [param].
        key: Random key; consumed.
        num_samples: Samples per batch, >= 1.

    Raises:
        ValueError: The name is unknown, an option or a method of the objective is missing, `num_samples` is below 1, or
            theta has the wrong length.
    """
    estimator = make_estimator(estimator)
    if num_samples < 1:
        raise ValueError(f"num_samples must be at least 1, and at least 2 for a variance; got {num_samples}")
    if theta.shape != (objective.num_params,):
        raise ValueError(f"theta must have shape ({objective.num_params},), the objective's; got {theta.shape}")
    return estimator(draw(estimator.needs, objective, theta, key, num_samples))
