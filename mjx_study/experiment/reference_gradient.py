"""The reference gradient of estimators: unbiased for any contact model, with its own uncertainty.

It is of zeroth order, since first-order gradients may be wrong, and uses two variance reductions that keep it unbiased
under any contact:

- only the part of the cost that is odd in the noise is used (two rollouts per sample);
- a linear control variate w -> slope * w^T g is subtracted and its exact mean, slope * g, added back. Any vector g
  independent of the sample is valid. Candidates are medians of first-order gradients, here and under a soft contact,
  since beyond some stiffness the local ones are noise; a pilot batch selects candidate and slope.
"""

from collections.abc import Callable, Iterable
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import estimators
from estimators import Evaluation, GradientEstimate, delta_control_variate
from mjx_study.experiment.memory import padded_size
from mjx_study.objective import MjxObjective, Simulator
from mjx_study.reference import ReferenceObjective
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

CANDIDATES: Final = 100
"""Number of first-order samples whose median is a candidate for the control variate."""


TARGET: Final = 0.05
"""Relative uncertainty with which a reference tells a notable bias from none."""
MOST_PARTS: Final = 32  # maximum number of references that are averaged to reach it
MOST_STEPS: Final = {True: 2_000_000, False: 100_000}
"""Maximum number of simulated steps for that, about ten seconds of a core, for models whose step is a graph and for
others; not a time, so that numbers are the same on any machine."""


def estimate_reference(
    odd: Evaluation, pilot: Evaluation, candidates: Iterable[Float[Array, " params"]], sigma: float
) -> GradientEstimate:
    """Return an unbiased estimate of grad F from odd parts and the best of several control variates.

    Args:
        odd: odd parts of the open-loop cost, (f(w) - f(-w)) / 2; their batch is independent of the other arguments.
        pilot: another batch, which selects candidate and slope.
        candidates: vectors g to try, (params,); those with nonfinite entries are disqualified.
    """
    signal = pilot.value - pilot.baseline
    signal = jnp.where(jnp.isfinite(signal), signal, 0.0)
    best, explained = jnp.zeros(pilot.score.shape[1], pilot.score.dtype), jnp.zeros((), signal.dtype)
    for candidate in candidates:
        linear = sigma**2 * (pilot.score @ candidate)
        power, overlap = jnp.sum(linear**2), jnp.sum(linear * signal)
        usable = jnp.all(jnp.isfinite(candidate)) & jnp.isfinite(power) & (power > 0)
        slope = jnp.where(usable, overlap / jnp.where(usable, power, 1.0), 0.0)
        gain = jnp.where(usable, slope * overlap, -1.0)
        best = jnp.where(gain > explained, jnp.where(usable, slope * candidate, 0.0), best)
        explained = jnp.maximum(explained, gain)
    return delta_control_variate(odd, best, sigma)


def soft_gradient(simulator: Simulator, sigma: float, keys: Key[Array, " samples"]) -> Float[Array, " params"] | None:
    """Return the median first-order gradient under the softest contact of the task's sweep, whatever is compared.

    It is a candidate for the reference's control variate under every contact model: beyond some stiffness first-order
    gradients are noise, while this one still points roughly along the gradient. None if the reference uses no
    candidates or the task has no contact.
    """
    task = simulator.task
    if task.contact_pair is None or not takes_candidates(task):
        return None
    (cell,), _ = family_grid(task, ("penalty",), (min(task.defaults.stiffnesses),))
    objective = simulator.objective(cell.contact, sigma)
    return jnp.median(objective.differentiate(task.theta, jax.random.clone(keys)).gradient, axis=0)


def candidates_of(
    task: Task,
    objective: MjxObjective | ReferenceObjective,
    keys: Key[Array, " samples"],
    soft: Float[Array, " params"] | None,
) -> Float[Array, "candidates params"] | None:
    """Candidates for the reference's control variate: the median of first-order samples, and `soft_gradient`; None if
    the reference takes none."""
    if not isinstance(objective, MjxObjective) or not takes_candidates(task):
        return None
    own = jnp.median(objective.differentiate(task.theta, keys).gradient, axis=0)
    return jnp.stack([own, jnp.zeros_like(own) if soft is None else soft])


def reference_of(
    task: Task,
    objective: MjxObjective | ReferenceObjective,
    keys: Key[Array, " pairs"],
    pilot: Evaluation,
    candidates: Float[Array, "candidates params"] | None,
) -> GradientEstimate:
    """Return the reference gradient of a contact model, independent of which others are compared.

    The pilot batch selects among the candidates, see `candidates_of`; neither shares keys with the other or the pairs.
    """
    if candidates is None or not isinstance(objective, MjxObjective):
        return _antithetic(objective.evaluate_pair(task.theta, keys))
    padding = padded_size(len(pilot.value)) - len(pilot.value)
    pilot = jax.tree.map(lambda leaf: np.pad(leaf, [(0, padding)] + [(0, 0)] * (leaf.ndim - 1)), pilot)
    return _reference_gradient(objective.evaluate_odd(task.theta, keys), pilot, candidates, objective.sigma)


def most_parts(task: Task, pairs: int) -> int:
    """Number of references of so many pairs that `averaged` may take for a task."""
    return max(1, min(MOST_PARTS, MOST_STEPS[task.scene.uses_graph] // (2 * pairs * task.horizon)))


def averaged(draw_part: Callable[[int], GradientEstimate], most: int) -> tuple[GradientEstimate, int]:
    """Average independent references, drawn by index, until the uncertainty is at most `TARGET` or all are used.

    Returns the reference, whose rows are means over rows of its parts, so that compiled statistics serve any number,
    and the number of parts.
    """
    estimate = draw_part(0)
    rows = np.asarray(estimate.per_sample)
    total, count, used = np.zeros_like(rows), np.zeros((len(rows), 1), rows.dtype), 0
    while used == 0 or (used < most and not uncertainty(estimate) <= TARGET):
        for index in range(used, max(1, min(2 * used, most))):
            rows = rows if index == 0 else np.asarray(draw_part(index).per_sample)
            finite = np.all(np.isfinite(rows), axis=1, keepdims=True)
            total, count = total + np.where(finite, rows, 0), count + finite
        used = max(1, min(2 * used, most))
        if used > 1:
            with np.errstate(invalid="ignore"):
                estimate = _summarise(total / count)
    return estimate, used


def uncertainty(reference: GradientEstimate) -> float:
    """Standard error of a reference relative to its norm; NaN if it is 0 or no sample is finite."""
    with np.errstate(all="ignore"):
        error = np.sqrt(np.asarray(reference.variance) / np.asarray(reference.num_finite))
        return float(error / np.linalg.norm(np.asarray(reference.mean)))


_summarise = jax.jit(estimators.summarise)


def takes_candidates(task: Task) -> bool:
    """Whether the reference is made from odd parts and a control variate."""
    return task.policy.additive and task.noise == "gaussian"


_antithetic = jax.jit(estimators.Antithetic().combine)
_reference_gradient = jax.jit(estimate_reference, static_argnames="sigma")
