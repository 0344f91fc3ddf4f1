"""Sample a cell: keys, batches of every oracle over seeds, and solver residuals."""

import time
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from estimators import ORACLES, Linearisation
from mjx_study.experiment.memory import LARGEST_BATCH, PADDED, padded_seeds, padded_size
from mjx_study.experiment.study import StudyCell, StudyPlan
from mjx_study.objective import MjxObjective, Simulator
from mjx_study.reference import ReferenceObjective
from mjx_study.tasks.task import Task


class Objectives:
    """The objective of each cell of a plan; all contact models and noises of a group share compiled programs."""

    def __init__(self, plan: StudyPlan):
        self._plan, self._compiled = plan, {}

    def simulator(self, group: int) -> Simulator:
        if group not in self._compiled:
            self._compiled[group] = Simulator(self._plan.groups[group].task, chunk_size=self._plan.chunk_size)
        return self._compiled[group]

    def __call__(self, cell: StudyCell) -> MjxObjective | ReferenceObjective:
        if cell.model.analytic:
            return self._plan.groups[cell.group].task.replace(sigma=cell.sigma).analytic(cell.model.stiffness_or_zero)
        return self.simulator(cell.group).objective(cell.model.contact, cell.sigma)


def cell_keys(seed: int, seeds: int) -> dict[str, Any]:
    """Independent keys for each seed's batches and tests, and for the reference; the same in every cell."""
    of_seeds, (odd, candidate) = jax.device_get(_cell_keys(seed, padded_seeds(seeds)))
    zeroth, first, tests = (jax.random.wrap_key_data(data[:seeds]) for data in of_seeds)
    reference = tuple(map(jax.random.wrap_key_data, (odd, candidate)))
    return {"order": [zeroth, first], "reference": reference, "tests": tests}


@partial(jax.jit, static_argnums=1)
def _cell_keys(seed: Int[Array, ""] | int, seeds: int) -> Any:
    """Data of the keys; those of more seeds begin with those of fewer."""
    zeroth, first, odd, candidate, test = jax.random.split(jax.random.key(seed), 5)
    of_seeds = [jax.random.key_data(jax.random.split(stream, seeds)) for stream in (zeroth, first, test)]
    return of_seeds, [jax.random.key_data(key) for key in (odd, candidate)]


def rows_of_keys(keys: Key[Array, "*rows"], rows: Any) -> Any:
    """Some of an array of keys, indexed on the host, where no program is compiled for each size."""
    data: Any = np.asarray(jax.random.key_data(keys))
    return jax.random.wrap_key_data(data[rows])


@partial(jax.jit, static_argnums=2)
def sample_keys(key: Key[Array, ""], first: int | Int[Array, ""], count: int) -> Key[Array, " count"]:
    """Keys of consecutive samples of a batch, each a function of its index alone."""
    indices = jnp.asarray(first, jnp.uint32) + jnp.arange(count, dtype=jnp.uint32)
    return jax.vmap(lambda index: jax.random.fold_in(key, index))(indices)


def _keys_of_seeds(streams: Key[Array, " seeds"], first: int, count: int) -> Key[Array, " samples"]:
    """Keys of consecutive samples of several seeds, one seed after the other, in a program for any small numbers."""
    seeds, padded = len(streams), padded_size(count)
    rows = np.minimum(np.arange(padded_seeds(seeds) if padded <= PADDED[-1] else seeds), seeds - 1)
    data: Any = np.asarray(jax.random.key_data(_sample_keys_of(rows_of_keys(streams, rows), first, padded)))
    return jax.random.wrap_key_data(data[:seeds, :count].reshape(-1, data.shape[-1]))


_sample_keys_of = jax.jit(jax.vmap(sample_keys, (0, None, None)), static_argnums=2)


def draw_batches(
    objective: Any,
    theta: Array,
    keys: dict[str, Any],
    oracles: Sequence[str],
    samples: int,
    seeds: slice,
    first: int = 0,
    *,
    device: AbstractContextManager[Any] = nullcontext(),  # noqa: B008, it has no state
) -> tuple[dict[str, Any], dict[str, float], dict[str, np.ndarray]]:
    """Draw batches of every oracle, with a leading axis of seeds.

    Args:
        samples, first: number of samples per batch, and index of the first one if the batch is part of a larger one.
        device: context held during each timed call.

    Returns:
        By oracle: the batch, on CPUs as NumPy arrays; its computing time [s]; and each rollout's solver residual.
    """
    together, on_host = max(1, LARGEST_BATCH[jax.default_backend()] // samples), jax.default_backend() == "cpu"
    drawn, seconds, residuals = {}, {}, {}
    for name in oracles:
        streams: Key[Array, " seeds"] = rows_of_keys(keys["order"][ORACLES[name].order], seeds)
        parts, seconds[name] = [], 0.0
        for start in range(0, len(streams), together):
            flat = _keys_of_seeds(rows_of_keys(streams, slice(start, start + together)), first, samples)
            with device:
                begun = time.perf_counter()
                batch = jax.block_until_ready(getattr(objective, ORACLES[name].method)(theta, flat))
                seconds[name] += time.perf_counter() - begun
            residuals[name] = np.concatenate([residuals.get(name, np.zeros(0)), residuals_of(batch)])
            batch = jax.device_get(batch) if on_host else batch
            parts.append(jax.tree.map(lambda leaf: leaf.reshape(len(leaf) // samples, samples, *leaf.shape[1:]), batch))
        drawn[name] = jax.tree.map(lambda *leaves: (np if on_host else jnp).concatenate(leaves), *parts)
    return drawn, seconds, residuals


def rollouts_of(oracles: Iterable[str], samples: int, task: Task) -> Int[np.ndarray, "2"]:
    """Number of rollouts in a batch of each oracle, baselines included, and how many of them are differentiated."""
    baselines, found = samples if task.random_start else min(samples, 1), np.zeros(2, int)
    for name in oracles:
        oracle = ORACLES[name]
        found += [samples * oracle.rollouts + oracle.baseline * baselines, samples * oracle.order]
    return found


def residuals_of(batch: Any) -> Float[np.ndarray, " rollouts"]:
    """Each rollout's solver residual in a batch of any kind; empty for an analytic system."""
    parts = batch if isinstance(batch, tuple) else (batch,)
    steps = [part.steps if isinstance(part, Linearisation) else part for part in parts]
    return np.concatenate([np.zeros(0) if part.residual is None else np.asarray(part.residual) for part in steps])
