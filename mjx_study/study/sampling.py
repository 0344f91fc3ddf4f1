"""The samples of a cell: keys, batches of every oracle over seeds, and the residuals of their solves."""

import time
from collections.abc import Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from estimators import ORACLES, Linearisation

LARGEST_BATCH: Final = 20_000
"""Samples that are drawn at once; more seeds than fit are drawn in turn."""
UNCONVERGED: Final = {"float64": 1e-6, "float32": 1e-3}
"""Relative solver residual above which a sample is reported as unconverged."""


def cell_keys(seed: int, seeds: int) -> dict[str, Any]:
    """Independent keys, the same in every cell: of each seed's batches, of the reference and of the tests."""
    zeroth, first, odd, candidate, test = jax.random.split(jax.random.key(seed), 5)
    by_order = [jax.random.split(stream, seeds) for stream in (zeroth, first)]
    return {"order": by_order, "reference": (odd, candidate), "test": test}


def draw_batches(
    objective: Any, theta: Array, keys: dict[str, Any], oracles: Sequence[str], samples: int, seeds: slice
) -> tuple[dict[str, Any], dict[str, float], dict[str, np.ndarray]]:
    """Batches of every oracle with an axis of seeds.

    Returns:
        Batches, seconds that each took, and the residual of every rollout of each; all by oracle.
    """
    together = max(1, LARGEST_BATCH // samples)
    drawn, seconds, residuals = {}, {}, {}
    for name in oracles:
        streams: Key[Array, " seeds"] = keys["order"][ORACLES[name].order][seeds]
        parts, seconds[name] = [], 0.0
        for start in range(0, len(streams), together):
            some = jax.random.clone(streams[start : start + together])
            flat = jax.vmap(lambda key: jax.random.split(key, samples))(some).reshape(-1)
            begun = time.perf_counter()
            batch = jax.block_until_ready(getattr(objective, ORACLES[name].method)(theta, flat))
            seconds[name] += time.perf_counter() - begun
            residuals[name] = np.concatenate([residuals.get(name, np.zeros(0)), residuals_of(batch)])
            parts.append(jax.tree.map(lambda leaf: leaf.reshape(-1, samples, *leaf.shape[1:]), batch))
        drawn[name] = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts)
    return drawn, seconds, residuals


def residuals_of(batch: Any) -> Float[np.ndarray, " rollouts"]:
    """The solver's residual of every rollout of a batch, whatever its kind."""
    parts = batch if isinstance(batch, tuple) else (batch,)
    steps = [part.steps if isinstance(part, Linearisation) else part for part in parts]
    return np.concatenate([np.asarray(part.residual) for part in steps])


def unconverged(residuals: np.ndarray, precision: str) -> int:
    """How many residuals are too large, or not finite."""
    return int(np.sum(~(residuals <= UNCONVERGED[precision])))
