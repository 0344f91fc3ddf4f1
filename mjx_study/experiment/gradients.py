"""Gradient estimates in a cell: every estimator on every seed's batches, compared with a reference gradient.

The estimators of a seed share its batches of values and of derivatives, drawn with independent keys; interpolated
estimates combine both. All cells use the same keys, so differences between contact models are not sampling noise.
"""

import math
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from threading import Lock
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Array, Key

import estimators
from estimators import ORACLES, Evaluation, GradientEstimate
from estimators.merged_samples import MAX_THINNED, moments_of
from estimators.statistics import merged_estimates
from mjx_study.compiled import Builds, type_of
from mjx_study.experiment import gradient_numbers, memory
from mjx_study.experiment.gradient_numbers import MOST_KEPT, cell_numbers, estimate_numbers, seed_numbers
from mjx_study.experiment.merged_samples import REFERENCE_UNIT, Blocks, pack
from mjx_study.experiment.reference_gradient import (
    CANDIDATES,
    averaged,
    candidates_of,
    most_parts,
    reference_of,
    soft_gradient,
)
from mjx_study.experiment.sampling import Objectives, cell_keys, draw_batches, rollouts_of, rows_of_keys, sample_keys
from mjx_study.experiment.study import (
    Arrays,
    Checkpoint,
    Computation,
    Result,
    StudyCell,
    StudyKind,
    StudyPlan,
    done,
    estimators_of,
)
from mjx_study.experiment.tally import Tally
from mjx_study.limits import MOST_GIB
from mjx_study.objective import BlankObjective, MjxObjective
from mjx_study.options.option import OptionError
from mjx_study.reference import ReferenceObjective
from mjx_study.results.findings import gradient_findings
from mjx_study.results.kind import Drawing
from mjx_study.results.rows import rows_of
from mjx_study.results.variables import GRADIENTS, ONSETS
from mjx_study.tasks.task import Task

PILOT: Final = memory.LARGEST_BLOCK
"""Maximum number of samples of the first batch used to select among the reference's control variates."""


class Gradients(StudyKind):
    """Gradient estimates at one theta, compared with a reference gradient."""

    name, title = "gradients", "gradient estimates"
    variables = GRADIENTS
    optional = (*ONSETS, "gradient", "reference", "reference_pairs")
    columns = ("variance", "effective_samples", "top_share", "relative_error", "debiased_error", "squared_bias")
    columns = (*columns, "alpha", "seconds_per_sample", "nonfinite")
    compared = "variance"
    finite = "gradient_norm"
    findings = staticmethod(gradient_findings)

    def check_memory(self, plan: StudyPlan) -> None:
        """Raise ValueError for batches that do not fit into memory, OptionError for a block size with estimators that
        need whole batches."""
        whole = [each.name for each in estimators_of(plan, plan.cells[0]) if not each.mergeable]
        if whole and plan.config.block_size is not None:
            reason = (
                f"splits batches, and {', '.join(whole)} must have whole ones: omit it; {memory.blocks_take(whole)}"
            )
            raise OptionError("block_size", reason)
        change = f"; or omit {', '.join(whole)}: {memory.blocks_take(whole)}" if whole else ""
        memory.check_batches(plan.memory, f"use fewer samples and more seeds{change}")

    def memory(self, plan: StudyPlan, cell: StudyCell) -> int:
        """Memory held at once [bytes]: batches and statistics, or a block, and moments until a batch is complete."""
        if (blocks := blocks_of(plan, cell)) == 1:
            return plan.memory_of_seed(cell) * seeds_together(plan, cell)
        moments = memory.bytes_of_moments(estimators_of(plan, cell), plan.task_of(cell).policy.num_params)
        kept = plan.config.seeds + math.ceil(math.log2(blocks))
        return block_of(plan, cell) * _bytes_in_block(plan, cell) + 2 * kept * moments

    def size(self, plan: StudyPlan, cell: StudyCell) -> int:
        parameters = plan.task_of(cell).policy.num_params
        means = plan.config.seeds * len(plan.config.estimators) * parameters
        return super().size(plan, cell) - (8 * (means + parameters) if means > MOST_KEPT else 0)

    def rollouts(self, plan: StudyPlan, cell: StudyCell) -> np.ndarray:
        candidates = 0 if cell.model.analytic else CANDIDATES
        batches = plan.config.seeds * rollouts_of(plan.oracles, cell.samples, plan.task_of(cell))
        return batches + [2 * plan.config.settings.reference_samples + candidates, candidates]

    def more_rollouts(self, plan: StudyPlan, cell: StudyCell) -> int:
        pairs = plan.config.settings.reference_samples
        return 2 * pairs * (_parts(plan, plan.task_of(cell)) - 1)

    def computation(self, plan: StudyPlan) -> "GradientComputation":
        return GradientComputation(plan)

    def drawings(self, dataset: xr.Dataset) -> dict[str, Drawing]:
        from mjx_study.plots import gradients as figures

        found = {
            "comparison": Drawing(
                figures.comparison,
                "Variance of one gradient sample, and relative error of the mean against the reference.",
            )
        }
        if dataset.sizes.get("seed", 1) > 1:
            found = {
                "variance": Drawing(
                    figures.variance, "Variance of one gradient sample; geometric mean over the seeds."
                ),
                "bias": Drawing(
                    figures.bias,
                    "Bias of each estimator against an unbiased zeroth-order reference; a triangle is an upper bound "
                    "where no bias is significant.",
                ),
                "alpha": Drawing(figures.alpha, "Weight of first-order gradients in the interpolations."),
            }
        if dataset.sizes["samples"] > 1:
            caption = "Relative error of the mean gradient against the number of samples."
            found["error_against_samples"] = Drawing(figures.error_against_samples, caption, keep="samples")
        return found

    def table(self, dataset: xr.Dataset) -> pd.DataFrame:
        return pd.DataFrame([row.as_dict() for row in rows_of(dataset)])


KIND: Final = Gradients()


def block_of(plan: StudyPlan, cell: StudyCell) -> int:
    """Number of a seed's samples held at once: all of them, or a block if the configuration asks for it, or if the
    batches would otherwise be rejected."""
    if plan.config.block_size is not None:
        return min(plan.config.block_size, cell.samples)
    fits = plan.memory_of_seed(cell) <= MOST_GIB * 2**30
    if fits or not all(each.mergeable for each in estimators_of(plan, cell)):
        return cell.samples
    even = int(memory.BLOCK_BYTES / _bytes_in_block(plan, cell)) // 2 * 2
    return min(cell.samples, memory.LARGEST_BLOCK, max(2, even))


def blocks_of(plan: StudyPlan, cell: StudyCell) -> int:
    """Number of blocks per seed; whole batches are one."""
    return math.ceil(cell.samples / block_of(plan, cell))


def _bytes_in_block(plan: StudyPlan, cell: StudyCell) -> int:
    """Memory per sample of a block, statistics included [bytes]."""
    return memory.bytes_per_sample(plan.task_of(cell), plan.oracles, 2 * len(plan.config.estimators), draws=0)


def seeds_together(plan: StudyPlan, cell: StudyCell) -> int:
    """Number of seeds that a cell draws at once: as many as fit into memory, in equal groups."""
    batches = plan.config.seeds
    fitting = max(1, int(memory.AT_ONCE[jax.default_backend()] / plan.memory_of_seed(cell)))
    return math.ceil(batches / math.ceil(batches / fitting))


class GradientComputation(Computation):
    """Computes the cells of a plan, in whole batches or in blocks."""

    def __init__(self, plan: StudyPlan):
        self._plan, self._config, self._objectives = plan, plan.config, Objectives(plan)
        self._warm: set[Any] = {None}
        self._soft: dict[tuple[int, float], Array | None] = {}
        self._builds = Builds()
        self._device, self._statistics = Lock(), ThreadPoolExecutor(1)

    @property
    def _keys(self) -> dict[str, Any]:
        return cell_keys(self._config.seed, self._config.seeds)

    def _keys_of_reference(self, index: int = 0) -> Key[Array, " pairs"]:
        """Keys of the pairs of a part of the reference."""
        odd = self._keys["reference"][0]
        return jax.random.split(
            jax.random.fold_in(odd, index) if index else odd, self._config.settings.reference_samples
        )

    @property
    def _keys_of_candidates(self) -> Key[Array, " samples"]:
        """Keys of the candidates, which all parts of the reference share."""
        return jax.random.split(self._keys["reference"][1], CANDIDATES)

    def begin(self, cell: StudyCell, checkpoint: Checkpoint) -> Blocks | None:
        blocks = blocks_of(self._plan, cell)
        if blocks == 1:
            return None
        with checkpoint.restored():
            work = Blocks(self._config.seeds, blocks, checkpoint.kept, partial(self._merged, cell))
            chosen = estimators_of(self._plan, cell)
            size = self._plan.task_of(cell).policy.num_params
            work.check([str(index) for index in range(len(chosen))], estimators.oracles_of(chosen), size)
        return work

    def compute(self, cell: StudyCell, unit: int, checkpoint: Checkpoint) -> Future[Arrays]:
        if blocks_of(self._plan, cell) == 1:
            return self._whole(cell)
        if unit != REFERENCE_UNIT:
            return done(self._block(cell, unit))
        objective, keys = self._objective(cell), sample_keys(self._keys["order"][0][0], 0, min(cell.samples, PILOT))
        pilot = objective.evaluate(self._plan.task_of(cell).theta, keys)
        return done({"reference": np.asarray(self._reference(cell, objective, pilot)[0].per_sample)})

    def _block(self, cell: StudyCell, unit: int) -> Arrays:
        objective, theta = self._objective(cell), self._plan.task_of(cell).theta
        chosen, size = estimators_of(self._plan, cell), block_of(self._plan, cell)
        seed, index = divmod(unit - 1, blocks_of(self._plan, cell))
        first, every = index * size, math.ceil(cell.samples / MAX_THINNED)
        count, oracles = min(size, cell.samples - first), estimators.oracles_of(chosen)
        some = slice(seed, seed + 1)
        drawn, seconds, residuals = draw_batches(
            objective, theta, self._keys, oracles, count, some, first, device=self._device
        )
        batches = jax.tree.map(lambda leaf: leaf[0], drawn)
        summary: dict[str, Any] = {name: Tally.of(drawn[name], seconds[name], residuals[name]) for name in oracles}
        for number, rows in enumerate(jax.device_get(gradient_numbers.samples_of_parts(batches, chosen))):
            summary |= {f"{number}.{part}": each for part, each in enumerate(moments_of(rows, first, every))}
        return pack(summary)

    def _merged(self, cell: StudyCell, blocks: Blocks) -> Arrays:
        """A cell's numbers from its blocks, all of which must be finished."""
        chosen, reference = estimators_of(self._plan, cell), estimators.summarise(jnp.asarray(blocks.reference))
        tests, parts, tallies = self._keys["tests"], [], []
        for seed in range(blocks.seeds):
            summary = blocks.whole(seed)
            estimates = []
            for index, estimator in enumerate(chosen):
                found = [each for name, each in summary.items() if name.startswith(f"{index}.")]
                estimates.append(estimator.join(*merged_estimates(tuple(found), cell.samples)))
            parts.append(
                jax.device_get(
                    estimate_numbers(estimates, reference, rows_of_keys(tests, seed), self._config.confidence)
                )
            )
            tallies.append({name: each for name, each in summary.items() if name in ORACLES})
        numbers = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
        found = cell_numbers(numbers, reference, chosen, tallies, cell.samples * blocks.seeds)
        return found | {"reference_pairs": np.array(float(self._config.settings.reference_samples))}

    def _whole(self, cell: StudyCell) -> Future[Arrays]:
        config, oracles, keys = self._config, self._plan.oracles, self._keys
        objective, theta = self._objective(cell), self._plan.task_of(cell).theta
        tests, chosen = keys["tests"], estimators_of(self._plan, cell)
        together, each = seeds_together(self._plan, cell), self._seeds_of_statistics(cell)
        pad = partial(gradient_numbers.padded, size=self._plan.padded_samples(cell))
        reference: GradientEstimate | None = None
        pairs = 0
        parts: list[Future[Any]] = []

        def statistics(drawn: Any, seconds: Any, residuals: Any, keys: Any) -> Any:
            batches, samples, found = jax.tree.map(pad, drawn), np.asarray(cell.samples), []
            for first in range(0, len(keys), each):
                some = slice(first, first + each)
                with self._device:
                    numbers = seed_numbers(chosen, config.confidence)(
                        jax.tree.map(lambda leaf, some=some: leaf[some], batches),
                        samples,
                        reference,
                        rows_of_keys(keys, some),
                    )
                    found.append(jax.device_get(numbers))
            numbers = jax.tree.map(lambda *leaves: np.concatenate(leaves), *found)
            tallies = {name: Tally.of(drawn[name], seconds[name], residuals[name]) for name in oracles}
            return numbers, tallies

        def all_numbers() -> Arrays:
            assert reference is not None
            numbers, tallies = zip(*(part.result() for part in parts), strict=True)
            joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *numbers)
            found = cell_numbers(joined, reference, chosen, tallies, cell.samples * config.seeds)
            return found | {"reference_pairs": np.array(float(pairs))}

        for start in range(0, config.seeds, together):
            some = slice(start, start + together)
            drawn = draw_batches(objective, theta, keys, oracles, cell.samples, some, device=self._device)
            if reference is None:
                pilot = jax.tree.map(lambda leaf: leaf[0, :PILOT], drawn[0]["evaluation"])
                with self._device:
                    reference, pairs = self._reference(cell, objective, pilot)
            if parts:
                parts[-1].result()  # keep at most two groups of seeds in memory
            parts.append(self._in_order(partial(statistics, *drawn, rows_of_keys(tests, some))))
        return self._in_order(all_numbers)

    def _in_order(self, call: Callable[[], Result]) -> Future[Result]:
        """Call in order; on accelerators in a thread, while the next batches are sampled."""
        return done(call()) if jax.default_backend() == "cpu" else self._statistics.submit(call)

    def _objective(self, cell: StudyCell) -> MjxObjective | ReferenceObjective:
        """The objective of a cell, with its programs compiled, so that measured times exclude compilation."""
        objective, theta = self._objectives(cell), self._plan.task_of(cell).theta
        if (program := self._plan.program_of(cell)) not in self._warm:
            if isinstance(objective, MjxObjective):
                self._build(cell, objective)
            for name in self._batches:
                getattr(objective, ORACLES[name].method)(theta, jax.random.split(jax.random.key(0), 1))
            self._warm.add(program)
        return objective

    @property
    def _batches(self) -> tuple[str, ...]:
        """The oracles of all batches: the estimators', and that of the reference's control variate."""
        return tuple(dict.fromkeys([*self._plan.oracles, "differentiation"]))

    def _seeds_of_statistics(self, cell: StudyCell) -> int:
        """Number of seeds in a call of the statistics: one on CPUs, so that any number of seeds takes one program."""
        return 1 if jax.default_backend() == "cpu" else seeds_together(self._plan, cell)

    def _build(self, cell: StudyCell, objective: MjxObjective) -> None:
        """Build the programs of rollouts, and of the statistics of whole batches, side by side."""
        config, task = self._config, self._plan.task_of(cell)
        blank = BlankObjective(**vars(objective))
        keys, seeds = self._keys["tests"], self._seeds_of_statistics(cell)
        blank.evaluate(task.theta, rows_of_keys(keys, slice(1)))
        blank.build(self._builds)  # the values' program, while the statistics are traced
        batches = {
            name: getattr(blank, ORACLES[name].method)(task.theta, rows_of_keys(keys, slice(1)))
            for name in self._batches
        }
        if blocks_of(self._plan, cell) == 1:
            size, drawn = self._plan.padded_samples(cell), {name: batches[name] for name in self._plan.oracles}
            drawn = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((seeds, size, *leaf.shape[1:]), leaf.dtype), drawn)
            pilot = blank.evaluate(task.theta, rows_of_keys(keys, np.zeros(min(cell.samples, PILOT), int)))
            candidates = candidates_of(task, blank, self._keys_of_candidates, None)
            reference = reference_of(task, blank, self._keys_of_reference(), pilot, candidates)
            keys = rows_of_keys(keys, slice(seeds))
            types = drawn, type_of(np.asarray(size)), jax.tree.map(type_of, reference), type_of(keys)
            self._builds.start(seed_numbers(estimators_of(self._plan, cell), config.confidence), *types)
        blank.build(self._builds)
        self._builds.wait()

    def _reference(
        self, cell: StudyCell, objective: MjxObjective | ReferenceObjective, pilot: Evaluation
    ) -> tuple[GradientEstimate, int]:
        """The reference gradient of a cell, and its number of pairs."""
        softened = cell.group, cell.sigma
        if softened not in self._soft and cell.model.contact is not None:
            self._soft[softened] = soft_gradient(
                self._objectives.simulator(cell.group), cell.sigma, self._keys_of_candidates
            )
        soft = None if cell.model.contact is None else self._soft[softened]
        task = self._plan.task_of(cell)
        candidates = candidates_of(task, objective, self._keys_of_candidates, soft)

        def part(index: int) -> GradientEstimate:
            return reference_of(task, objective, self._keys_of_reference(index), pilot, candidates)

        pairs = self._config.settings.reference_samples
        reference, parts = averaged(part, _parts(self._plan, task))
        return reference, parts * pairs


def _parts(plan: StudyPlan, task: Task) -> int:
    """Maximum number of references that are averaged: one if the configuration sets their pairs."""
    return 1 if plan.config.reference_samples is not None else most_parts(task, plan.config.settings.reference_samples)
