"""Gradient estimates in a cell: every estimator on every seed's batches, compared with a reference gradient.

The estimators of a seed share its batches of values and of derivatives, drawn with independent keys; interpolated
estimates combine both. All cells use the same keys, so differences between contact models are not sampling noise.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from threading import Lock
from typing import Any, Final, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

import estimators
from estimators import ORACLES, Batches, Estimator, Evaluation, GradientEstimate
from estimators.merged_samples import MAX_THINNED, moments_of
from estimators.statistics import merged_estimates
from mjx_study.compiled import Compiled, type_of
from mjx_study.experiment.blocks import REFERENCE, Arrays, Blocks, pack
from mjx_study.experiment.checkpoint import Checkpoint
from mjx_study.experiment.memory import BIAS_DRAWS, LARGEST_BLOCK, padded_size
from mjx_study.experiment.plan import (
    StudyCell,
    StudyPlan,
    block_of,
    blocks_of,
    estimators_of,
    oracles_of,
    padded_samples,
    seeds_together,
)
from mjx_study.experiment.reference_gradient import estimate_reference
from mjx_study.experiment.sampling import Objectives, cell_keys, draw_batches, sample_keys
from mjx_study.experiment.tally import Tally, numbers_of, together
from mjx_study.objective import BlankObjective, MjxObjective, Simulator
from mjx_study.reference import Reference
from mjx_study.results.variables import BATCH, GRADIENTS, ONSETS
from mjx_study.runtime import traces_folder
from mjx_study.stopwatch import unheard
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

Result = TypeVar("Result")
CANDIDATES: Final = 100
"""Number of first-order samples whose median is a candidate for the reference's control variate."""
PILOT: Final = LARGEST_BLOCK
"""Maximum number of samples of the first batch used to select among the candidates."""
MOST_KEPT: Final = 1_000_000
"""Maximum size of a cell's array of mean gradients; larger ones are not kept."""


def compute_gradients(plan: StudyPlan) -> "Gradients":
    """Return the computation of a plan's cells, whole or in blocks, which keeps compiled programs."""
    return Gradients(plan)


class Gradients:
    """Computes the cells of a plan."""

    def __init__(self, plan: StudyPlan):
        self._plan, self._config, self._objectives = plan, plan.config, Objectives(plan)
        self._warm: set[Any] = {None}
        self._soft: dict[tuple[int, float], Array | None] = {}
        self._pool, self._compiling = ThreadPoolExecutor(1), done(None)
        self._device, self._statistics = Lock(), ThreadPoolExecutor(1)

    @property
    def _keys(self) -> dict[str, Any]:
        return cell_keys(self._config.seed, self._config.batches)

    @property
    def _reference_keys(self) -> tuple[Key[Array, " pairs"], Key[Array, " samples"]]:
        odd, candidate = self._keys["reference"]
        pairs = self._config.settings.reference_samples
        return jax.random.split(odd, pairs), jax.random.split(candidate, CANDIDATES)

    def __call__(self, cell: StudyCell, part: Checkpoint = Checkpoint()) -> Arrays:  # noqa: B008, it is empty
        """Compute a cell's numbers, see `begin`."""
        return self.begin(cell, part).result()

    def begin(self, cell: StudyCell, part: Checkpoint) -> Future[Arrays]:
        """Sample a cell, in whole batches or in blocks, skipping blocks in the checkpoint.

        Returns:
            The cell's numbers: complete on CPUs; on accelerators the statistics may still be running.
        """
        if blocks_of(self._plan, cell) == 1:
            return self._whole(cell)
        blocks = self.restored(cell, part)
        for task in blocks.missing:
            part.report(task, blocks.tasks, f"{self._plan.label(cell)}, in blocks")
            blocks.add(task, self.block(cell, task))
            part.save(blocks.arrays())
        return done(self.merged(cell, blocks))

    def restored(self, cell: StudyCell, part: Checkpoint) -> Blocks:
        """Blocks of a cell, with the finished ones of its checkpoint; StudyError if that does not fit."""
        with part.restored():
            blocks = self.begun(cell, part.kept)
            chosen = estimators_of(self._plan, cell)
            size = self._plan.groups[cell.group].task.policy.num_params
            blocks.check([str(index) for index in range(len(chosen))], estimators.oracles_of(chosen), size)
        return blocks

    def begun(self, cell: StudyCell, kept: Mapping[str, np.ndarray]) -> Blocks:
        """Blocks of a cell, with the finished ones of a checkpoint."""
        return Blocks(self._config.batches, blocks_of(self._plan, cell), kept)

    def block(self, cell: StudyCell, task: int) -> Arrays:
        """Compute one of the tasks of `Blocks`: the reference's samples, or the summary of a block."""
        objective, task_of = self._objective(cell), self._plan.groups[cell.group].task
        if task == REFERENCE:
            keys = sample_keys(self._keys["order"][0][0], 0, min(cell.samples, PILOT))
            pilot = objective.evaluate(task_of.theta, keys)
            return {"reference": np.asarray(self._reference(cell, objective, pilot).per_sample)}
        chosen, size = estimators_of(self._plan, cell), block_of(self._plan, cell)
        seed, place = self.begun(cell, {}).place(task)
        first, every = place * size, math.ceil(cell.samples / MAX_THINNED)
        count, oracles = min(size, cell.samples - first), estimators.oracles_of(chosen)
        some = slice(seed, seed + 1)
        drawn, seconds, residuals = draw_batches(
            objective, task_of.theta, self._keys, oracles, count, some, first, device=self._device
        )
        batches = jax.tree.map(lambda leaf: leaf[0], drawn)
        summary: dict[str, Any] = {name: Tally.of(drawn[name], seconds[name], residuals[name]) for name in oracles}
        for index, rows in enumerate(jax.device_get(_rows_of_parts(batches, chosen))):
            summary |= {f"{index}.{part}": each for part, each in enumerate(moments_of(rows, first, every))}
        return pack(summary)

    def merged(self, cell: StudyCell, blocks: Blocks) -> Arrays:
        """Compute a cell's numbers from its blocks, all of which must be finished."""
        chosen, reference = estimators_of(self._plan, cell), estimators.summarise(jnp.asarray(blocks.reference))
        tests, parts, tallies = jax.random.split(self._keys["test"], blocks.seeds), [], []
        for seed in range(blocks.seeds):
            summary = blocks.whole(seed)
            estimates = []
            for index, estimator in enumerate(chosen):
                found = [each for name, each in summary.items() if name.startswith(f"{index}.")]
                estimates.append(estimator.join(*merged_estimates(tuple(found), cell.samples)))
            parts.append(jax.device_get(estimate_numbers(estimates, reference, tests[seed], self._config.confidence)))
            tallies.append({name: each for name, each in summary.items() if name in estimators.ORACLES})
        return self._numbers(cell, jax.tree.map(lambda *leaves: np.stack(leaves), *parts), reference, tallies)

    def _whole(self, cell: StudyCell) -> Future[Arrays]:
        config, oracles, keys = self._config, oracles_of(self._config), self._keys
        objective, theta = self._objective(cell), self._plan.groups[cell.group].task.theta
        tests, chosen = jax.random.split(keys["test"], config.batches), estimators_of(self._plan, cell)
        together, padded = seeds_together(self._plan, cell), partial(_padded, size=padded_samples(self._plan, cell))
        reference: GradientEstimate | None = None
        parts: list[Future[Any]] = []

        def statistics(drawn: Any, seconds: Any, residuals: Any, keys: Any, compiled: Future[None]) -> Any:
            compiled.result()
            arguments = jax.tree.map(padded, drawn), np.asarray(cell.samples), reference, keys
            with self._device:
                numbers = jax.block_until_ready(_seed_numbers(chosen, config.confidence)(*arguments))
            tallies = {name: Tally.of(drawn[name], seconds[name], residuals[name]) for name in oracles}
            return jax.device_get(numbers), tallies

        def all_numbers() -> Arrays:
            assert reference is not None
            numbers, tallies = zip(*(part.result() for part in parts), strict=True)
            joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *numbers)
            return self._numbers(cell, joined, reference, tallies)

        for start in range(0, config.batches, together):
            some = slice(start, start + together)
            drawn = draw_batches(objective, theta, keys, oracles, cell.samples, some, device=self._device)
            if reference is None:
                pilot = jax.tree.map(lambda leaf: leaf[0, :PILOT], drawn[0]["evaluation"])
                with self._device:
                    reference = self._reference(cell, objective, pilot)
            if parts:
                parts[-1].result()  # keep at most two groups of seeds in memory
            parts.append(self._beside(partial(statistics, *drawn, tests[some], self._compiling)))
        return self._beside(all_numbers)

    def _beside(self, call: Callable[[], Result]) -> Future[Result]:
        """Call in order; on accelerators in a thread, while the next batches are sampled."""
        if jax.default_backend() == "cpu":
            return done(call())
        return self._statistics.submit(unheard(call))

    def _objective(self, cell: StudyCell) -> MjxObjective | Reference:
        """The objective of a cell, with its programs compiled, so that measured times exclude compilation."""
        objective, theta = self._objectives(cell), self._plan.groups[cell.group].task.theta
        if (program := self._plan.program_of(cell)) not in self._warm:
            self._compile_statistics(cell, objective)
            for name in dict.fromkeys([*oracles_of(self._config), "differentiation"]):  # the control variate needs it
                getattr(objective, ORACLES[name].method)(theta, jax.random.split(jax.random.key(0), 1))
            self._warm.add(program)
        return objective

    def _compile_statistics(self, cell: StudyCell, objective: MjxObjective | Reference) -> None:
        """Compile the statistics in another thread, in parallel with the rollouts."""
        in_blocks = blocks_of(self._plan, cell) > 1
        if not isinstance(objective, MjxObjective) or traces_folder() is None or in_blocks:
            return
        config, task = self._config, self._plan.groups[cell.group].task
        blank = BlankObjective(**vars(objective))
        key, seeds = jax.random.split(jax.random.key(0), 1), seeds_together(self._plan, cell)
        size = padded_samples(self._plan, cell)
        batches = {
            name: getattr(blank, ORACLES[name].method)(task.theta, jax.random.clone(key)) for name in oracles_of(config)
        }
        drawn = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((seeds, size, *leaf.shape[1:]), leaf.dtype), batches)
        soft = task.theta if takes_candidates(task) and task.contact_pair is not None else None
        pilot = blank.evaluate(task.theta, jax.random.split(jax.random.key(0), min(cell.samples, PILOT)))
        reference = reference_of(task, blank, *self._reference_keys, pilot, soft)
        keys = jax.random.split(self._keys["test"], config.batches)[:seeds]
        types = drawn, type_of(np.asarray(size)), jax.tree.map(type_of, reference), type_of(keys)
        statistics = _seed_numbers(estimators_of(self._plan, cell), config.confidence)
        self._compiling = self._pool.submit(unheard(statistics.ahead(*types)))

    def _reference(self, cell: StudyCell, objective: MjxObjective | Reference, pilot: Evaluation) -> GradientEstimate:
        softened = cell.group, cell.sigma
        if softened not in self._soft and not cell.model.analytic:
            self._soft[softened] = soft_gradient(
                self._objectives.simulator(cell.group), cell.sigma, self._reference_keys[1]
            )
        task = self._plan.groups[cell.group].task
        return reference_of(task, objective, *self._reference_keys, pilot, self._soft.get(softened))

    def _numbers(
        self, cell: StudyCell, numbers: Any, reference: GradientEstimate, tallies: Sequence[dict[str, Tally]]
    ) -> Arrays:
        """Assemble all numbers of a cell from those of its seeds."""
        samples = cell.samples * self._config.batches
        arrays = _of_seeds(numbers, self._config.batches) | _bias(numbers, reference)
        arrays |= _of_batches(estimators_of(self._plan, cell), tallies, samples)
        if arrays["gradient"].size > MOST_KEPT:
            del arrays["gradient"]
        else:
            arrays["reference"] = np.asarray(reference.mean)
        return {name: np.asarray(array, float) for name, array in arrays.items()}


def done(result: Result) -> Future[Result]:
    """A future that has its result."""
    future = Future[Result]()
    future.set_result(result)
    return future


def _of_batches(
    chosen: Sequence[Estimator], tallies: Sequence[dict[str, Tally]], samples: int
) -> dict[str, np.ndarray]:
    """Times, residuals and onset counts of each estimator's batches."""
    told = [together(each[oracle] for each in tallies for oracle in estimator.needs) for estimator in chosen]
    arrays = {
        "seconds_per_sample": np.array([each.seconds / samples for each in told]),
        "residual": np.array([each.residual for each in told]),
        "unconverged": np.array([each.unconverged for each in told]),
    }
    numbers = np.stack([numbers_of(each.onsets) for each in told], axis=-1)
    if np.any(np.isfinite(numbers)):
        arrays |= dict(zip(ONSETS, numbers, strict=True))
    return arrays


def _of_seeds(numbers: Sequence[dict[str, Any]], seeds: int) -> dict[str, np.ndarray]:
    """Numbers by seed and estimator, NaN where not applicable, and those of the reference."""
    arrays = {
        name: np.stack([np.full(seeds, np.nan) if row[name] is None else row[name] for row in numbers], axis=1)
        for name, variable in GRADIENTS.items()
        if variable.dims == BATCH
    }
    first = numbers[0]  # the reference's numbers are the same for every estimator and seed
    arrays["gradient"] = np.stack([row["gradient"] for row in numbers], axis=1)
    return arrays | {name: np.asarray(first[name][0]) for name, variable in GRADIENTS.items() if not variable.dims}


def _bias(numbers: Sequence[dict[str, Any]], reference: GradientEstimate) -> dict[str, np.ndarray]:
    """Each estimator's bias relative to the norm of the reference, from the means of its seeds."""
    found = jax.device_get(_biases(np.stack([row["gradient"] for row in numbers]), reference))
    return {name: np.asarray(each, float) for name, each in found.items()}


@jax.jit
def _biases(means: Float[Array, "estimators seeds params"], reference: GradientEstimate) -> dict[str, Array]:
    square = jnp.sum(reference.mean**2)
    squared, errors = zip(*(estimators.squared_bias_of_means(each, reference) for each in means), strict=True)
    gaps = [jnp.linalg.norm(jnp.mean(each, axis=0) - reference.mean) for each in means]
    return {
        "squared_bias": jnp.stack(squared) / square,
        "squared_bias_se": jnp.stack(errors) / square,
        "pooled_error": jnp.stack(gaps) / jnp.sqrt(square),
    }


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


def reference_of(
    task: Task,
    objective: MjxObjective | Reference,
    odd_keys: Key[Array, " pairs"],
    candidate_keys: Key[Array, " samples"],
    pilot: Evaluation,
    soft: Float[Array, " params"] | None,
) -> GradientEstimate:
    """Return the reference gradient of a contact model, independent of which others are compared.

    Args:
        objective: the task under that contact model, or its analytic system.
        odd_keys: keys of the rollout pairs.
        candidate_keys: keys of the first-order samples whose median is a candidate for the control variate.
        pilot: a batch from other keys, used to select among the candidates.
        soft: another candidate, see `soft_gradient`.
    """
    if not isinstance(objective, MjxObjective) or not takes_candidates(task):
        plus, minus = objective.evaluate_pair(task.theta, odd_keys)
        return _antithetic(plus, minus, "zero_noise")
    own = jnp.median(objective.differentiate(task.theta, candidate_keys).gradient, axis=0)
    candidates = jnp.stack([own, jnp.zeros_like(own) if soft is None else soft])
    padding = padded_size(len(pilot.value)) - len(pilot.value)
    pilot = jax.tree.map(lambda leaf: np.pad(leaf, [(0, padding)] + [(0, 0)] * (leaf.ndim - 1)), pilot)
    return _reference_gradient(objective.evaluate_odd(task.theta, odd_keys), pilot, candidates, objective.sigma)


def takes_candidates(task: Task) -> bool:
    """Whether the reference is made from odd parts and a control variate."""
    return task.policy.additive and task.noise == "gaussian"


_antithetic = jax.jit(estimators.antithetic, static_argnames="baseline")


@partial(jax.jit, static_argnames="sigma")
def _reference_gradient(
    odd: Evaluation, pilot: Evaluation, candidates: Float[Array, "candidates params"], sigma: float
):
    return estimate_reference(odd, pilot, list(candidates), sigma)


@cache
def _seed_numbers(chosen: tuple[Estimator, ...], confidence: float) -> Compiled:
    """Compiled statistics of all estimators, batched over seeds: a function of batches, which may be padded, their
    number of samples, reference and keys."""

    def numbers(batches, samples, reference, key):
        estimates = [_estimate(estimator, batches, samples) for estimator in chosen]
        found = estimate_numbers(estimates, reference, key, confidence)
        padding = len(batches["evaluation"].value) - samples
        return [row | {"nonfinite": row["nonfinite"] - padding} for row in found]

    return Compiled(jax.vmap(numbers, (0, None, None, 0)), "numbers of seeds", chosen, confidence)


def _estimate(estimator: Estimator, batches: Batches, samples: Array) -> GradientEstimate:
    """The estimate from the first samples of batches, the others being padding if the estimator is mergeable."""
    if not estimator.mergeable:
        return estimator(batches)
    parts = [part.per_sample for part in estimator.parts(*estimator.pick(batches))]
    real = jnp.arange(len(parts[0]))[:, None] < samples
    return estimator.join(*(estimators.summarise(jnp.where(real, part, jnp.nan)) for part in parts))


def _padded(leaf: Array, size: int) -> Array | np.ndarray:
    """Batches of several seeds with copies of their last sample, up to a size."""
    samples = leaf.shape[1]
    return leaf if samples == size else np.asarray(leaf)[:, np.minimum(np.arange(size), samples - 1)]


@partial(jax.jit, static_argnames="chosen")
def _rows_of_parts(batches: Batches, chosen: tuple[Estimator, ...]) -> list[list[Array]]:
    """Samples of each estimator's parts."""
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
