"""Gradient estimates in a cell: every estimator on every seed's batches, against a reference gradient.

The estimators of a seed share its batches: those of values and those of derivatives, drawn from independent keys;
interpolated estimates combine the two. The same keys are used in every cell, so differences between contact models are
not sampling noise.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import estimators
from estimators import ORACLES, Estimator, Evaluation, GradientEstimate
from mjx_study.objective import MjxObjective, Simulator
from mjx_study.reference import Reference
from mjx_study.runtime import precision
from mjx_study.study.memory import BIAS_DRAWS
from mjx_study.study.plan import StudyCell, StudyPlan, estimators_of, oracles_of, seeds_together
from mjx_study.study.reference_gradient import reference_gradient
from mjx_study.study.sampling import Objectives, cell_keys, draw_batches, unconverged
from mjx_study.study.variables import BATCH, GRADIENTS, ONSETS
from mjx_study.tasks.contact_grid import contact_grid
from mjx_study.tasks.task import Task

CANDIDATES: Final = 100
"""First-order samples whose median is a candidate for the reference's control variate."""
MOST_KEPT: Final = 1_000_000
"""Most numbers in a cell's mean gradients; larger ones are not kept."""


def compute_gradients(plan: StudyPlan) -> Callable[[StudyCell], dict[str, np.ndarray]]:
    """A function that computes cells and keeps compiled programs between them."""
    config, oracles, objectives = plan.config, oracles_of(plan.config), Objectives(plan)
    warm: set[Any] = {None}
    soft: dict[tuple[int, float], Array | None] = {}

    def compute(cell: StudyCell) -> dict[str, np.ndarray]:
        objective, task = objectives(cell), plan.groups[cell.group].task
        theta = task.theta
        # so that no cell's time holds a compilation
        if (program := plan.program_of(cell)) not in warm:
            for name in dict.fromkeys([*oracles, "differentiation"]):  # the reference's control variate needs it
                getattr(objective, ORACLES[name].method)(theta, jax.random.split(jax.random.key(0), 1))
            warm.add(program)
        keys = cell_keys(config.seed, config.batches)
        odd, candidate = (
            jax.random.split(stream, size)
            for stream, size in zip(keys["reference"], (config.reference_samples or 0, CANDIDATES), strict=True)
        )
        softened = cell.group, cell.sigma
        if softened not in soft and not cell.model.analytic:
            soft[softened] = soft_gradient(objectives.simulator(cell.group), cell.sigma, candidate)
        tests, chosen = jax.random.split(keys["test"], config.batches), estimators_of(plan, cell)
        together = seeds_together(plan, cell)
        reference, parts, spent, residuals, events = None, [], [], [], []
        for start in range(0, config.batches, together):
            some = slice(start, start + together)
            drawn, seconds, residual = draw_batches(objective, theta, keys, oracles, cell.samples, some)
            if reference is None:
                pilot = jax.tree.map(lambda leaf: leaf[0], drawn["evaluation"])
                reference = reference_of(task, objective, odd, candidate, pilot, soft.get(softened))
            numbers = _seed_numbers(drawn, reference, tests[some], chosen, config.confidence)
            parts.append(jax.device_get(numbers))
            spent.append(seconds)
            residuals.append(residual)
            events.append({name: _events(batch) for name, batch in drawn.items()})
        assert reference is not None
        numbers = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
        arrays = _of_seeds(numbers, config.batches) | _bias(numbers, reference)
        arrays |= _of_batches(chosen, spent, residuals, events, cell.samples * config.batches)
        if arrays["gradient"].size > MOST_KEPT:
            del arrays["gradient"]
        else:
            arrays["reference"] = np.asarray(reference.mean)
        return {name: np.asarray(array, float) for name, array in arrays.items()}

    return compute


def _events(batch: Any) -> np.ndarray | None:
    """Onsets of contact in each rollout of a batch, as in `OnsetCounts`; None where none are looked for."""
    events = getattr(batch, "events", None)
    return None if events is None else np.asarray(events).reshape(-1, 5)


def _of_batches(
    chosen: Sequence[Estimator],
    seconds: Sequence[dict[str, float]],
    residuals: Sequence[dict[str, np.ndarray]],
    events: Sequence[dict[str, np.ndarray | None]],
    samples: int,
) -> dict[str, np.ndarray]:
    """Times, residuals and onset counts of each estimator's batches."""
    arrays: dict[str, list[Any]] = {"seconds_per_sample": [], "residual": [], "unconverged": [], "events": []}
    for estimator in chosen:
        needs = estimator.needs
        arrays["seconds_per_sample"].append(sum(each[oracle] for each in seconds for oracle in needs) / samples)
        all_of = np.concatenate([each[oracle] for each in residuals for oracle in needs])
        arrays["residual"].append(np.max(np.where(np.isfinite(all_of), all_of, np.inf), initial=0.0))
        arrays["unconverged"].append(unconverged(all_of, precision()))
        found = [met for each in events for oracle in needs if (met := each[oracle]) is not None]
        arrays["events"].append(onset_numbers(np.concatenate(found)) if found else np.full(len(ONSETS), np.nan))
    numbers = np.stack(arrays.pop("events"), axis=-1)
    if np.any(np.isfinite(numbers)):
        arrays |= dict(zip(ONSETS, numbers, strict=True))
    return {name: np.array(values) for name, values in arrays.items()}


def onset_numbers(events: np.ndarray) -> np.ndarray:
    """`ONSETS` of rollouts."""
    *counts, strength, first = events[events[:, 0] > 0].T
    counts, some = [np.sum(each) for each in counts], len(first) > 0
    return np.array([*counts, np.sqrt(np.mean(strength**2)) if some else np.nan, np.std(first) if some else np.nan])


def _of_seeds(numbers: Sequence[dict[str, Any]], seeds: int) -> dict[str, np.ndarray]:
    """Numbers by seed and estimator, NaN for what an estimator does not have; and those of the reference."""
    arrays = {
        name: np.stack([np.full(seeds, np.nan) if row[name] is None else row[name] for row in numbers], axis=1)
        for name, variable in GRADIENTS.items()
        if variable.dims == BATCH
    }
    first = numbers[0]  # every estimator's row has the reference's numbers, every seed the same
    shared = ("reference_norm", "reference_uncertainty", "reference_effective_samples")
    arrays["gradient"] = np.stack([row["gradient"] for row in numbers], axis=1)
    return arrays | {name: np.asarray(first[name][0]) for name in shared}


def _bias(numbers: Sequence[dict[str, Any]], reference: GradientEstimate) -> dict[str, np.ndarray]:
    """Each estimator's bias over the norm of the reference, from the means of its seeds."""
    means = [jnp.asarray(row["gradient"]) for row in numbers]
    square = float(jnp.sum(reference.mean**2))
    squared, errors = zip(*(estimators.squared_bias_of_means(each, reference) for each in means), strict=True)
    gaps = [jnp.linalg.norm(jnp.mean(each, axis=0) - reference.mean) for each in means]
    return {
        "squared_bias": np.array(squared, float) / square,
        "squared_bias_se": np.array(errors, float) / square,
        "pooled_error": np.array(gaps, float) / square**0.5,
    }


def soft_gradient(simulator: Simulator, sigma: float, keys: Key[Array, " samples"]) -> Float[Array, " params"] | None:
    """The median first-order gradient under the softest contact that the task sweeps, whatever is compared.

    A candidate for the reference's control variate at every contact model: beyond some stiffness first-order gradients
    are noise, and this one still points where most of the gradient does. None where the reference takes none, or where
    the task has no contact.
    """
    task = simulator.task
    if task.contact_pair is None or not takes_candidates(task):
        return None
    (cell,), _ = contact_grid(task, ("penalty",), (min(task.defaults.stiffnesses),))
    objective = simulator.objective(cell.contact, sigma)
    return jnp.median(objective.differentiate(task.theta, jax.random.clone(keys)).gradient, axis=0)


def reference_of(
    task: Task,
    objective: MjxObjective | Reference,
    odd_keys: Key[Array, " pairs"],
    candidate_keys: Key[Array, " samples"],
    pilot: Evaluation,
    soft: Float[Array, " params"] | None,
) -> GradientEstimate:
    """The reference gradient of a contact model; it does not depend on which others there are.

    Args:
        objective: the task under that contact model, or its analytic system.
        odd_keys: keys of the pairs of rollouts.
        candidate_keys: keys of the first-order samples whose median is a candidate for the control variate.
        pilot: a batch from other keys, which picks among the candidates.
        soft: another candidate, see `soft_gradient`.
    """
    if not isinstance(objective, MjxObjective) or not takes_candidates(task):
        plus, minus = objective.evaluate_pair(task.theta, odd_keys)
        return _antithetic(plus, minus, "zero_noise")
    own = jnp.median(objective.differentiate(task.theta, candidate_keys).gradient, axis=0)
    candidates = jnp.stack([own, jnp.zeros_like(own) if soft is None else soft])
    return _reference_gradient(objective.evaluate_odd(task.theta, odd_keys), pilot, candidates, objective.sigma)


def takes_candidates(task: Task) -> bool:
    """Whether the reference is of odd parts and a control variate."""
    return task.policy.additive and task.noise == "gaussian"


_antithetic = jax.jit(estimators.antithetic, static_argnames="baseline")


@partial(jax.jit, static_argnames="sigma")
def _reference_gradient(
    odd: Evaluation, pilot: Evaluation, candidates: Float[Array, "candidates params"], sigma: float
):
    return reference_gradient(odd, pilot, list(candidates), sigma)


@partial(jax.jit, static_argnames=("chosen", "confidence"))
def _seed_numbers(drawn, reference: GradientEstimate, keys: Key[Array, " seeds"], chosen, confidence: float):
    """The numbers of every estimator, with an axis of seeds."""
    return jax.vmap(lambda batches, key: estimate_numbers(batches, reference, key, chosen, confidence))(drawn, keys)


def estimate_numbers(batches, reference, key, chosen, confidence):
    """The numbers of each estimator that are functions of the batches and the reference gradient alone."""
    result = []
    reference_effective = estimators.effective_samples(reference).count
    for estimator in chosen:
        estimate = estimator(batches)
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
