"""Gradient descent in a cell: every estimator, several seeds at once, resuming from the last checkpoint.

All seeds of an estimator advance in one compiled program. With MJX, its rollouts and updates stay on one device, and
estimators run in parallel on as many devices as there are; analytic systems are simulated in NumPy. Iteration i of seed
s has its own random key, so an interrupted run ends bitwise identical to an uninterrupted one; all estimators share
these keys.
"""

import dataclasses
import math
import time
from collections.abc import Hashable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float, Int, Key

from estimators import Estimator
from mjx_study.compiled import Builds
from mjx_study.experiment.descent_rollouts import Backend
from mjx_study.experiment.iteration import Descent, Record, begin, going, make_optimizer, schedule_factors
from mjx_study.experiment.memory import bytes_per_sample
from mjx_study.experiment.resolution import recipe_of
from mjx_study.experiment.sampling import rollouts_of
from mjx_study.experiment.study import (
    SAVE_SECONDS,
    Arrays,
    Checkpoint,
    Computation,
    StudyCell,
    StudyKind,
    StudyPlan,
    done,
    estimators_of,
)
from mjx_study.options.configuration import StudyConfig
from mjx_study.options.option import OptionError
from mjx_study.results.findings import descent_findings
from mjx_study.results.kind import Drawing
from mjx_study.results.variables import DESCENTS, HISTORY, METRIC, START
from mjx_study.table import number
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Recipe, Task

HISTORY_NUMBERS: Final = 20  # approximate count of numbers kept per iteration and seed, over all estimators
REPORT_EVERY: Final = 10
"""Iterations between progress reports, which wait for the device."""


class Descents(StudyKind):
    """Costs that gradient descent reaches with each estimator."""

    name, title = "descents", "gradient descent"
    variables = DESCENTS
    columns = ("final_cost", "stopped_seeds", "variance", "alpha", "nonfinite")
    compared = finite = "final_cost"
    computed = "rollouts"
    findings = staticmethod(descent_findings)
    one_program = True

    def axes(self, config: Mapping[str, Any]) -> dict[str, Sequence[int]]:
        return {"iteration": range(1, (config["iterations"] or 0) + 1)}

    def describe(self, plan: StudyPlan) -> str:
        lengths = dict.fromkeys(group.descent.iterations for group in plan.groups)
        return f"descents of {', '.join(map(str, lengths))} iterations"

    def recipe(self, config: StudyConfig, task: Task) -> Recipe:
        return recipe_of(config, task)

    def check(self, plan: StudyPlan, cell: StudyCell) -> None:
        config, group, chosen = plan.config, plan.groups[cell.group], estimators_of(plan, cell)
        recipe = group.descent
        make_optimizer(recipe.optimizer, recipe.learning_rate, recipe.decay)
        schedule_factors(config.sigma_schedule, recipe.iterations)
        schedule_factors(config.stiffness_schedule, recipe.iterations, most=1.0)
        if config.stiffness_schedule and any(
            model.stiffness is None or (model.contact is None and not model.analytic) for model in group.models
        ):
            raise OptionError("stiffness_schedule", "needs contact models with a stiffness; mjcf has none to set")
        fixed = [each.name for each in chosen if hasattr(each, "sigma")]
        if config.sigma_schedule and fixed:
            raise OptionError("sigma_schedule", f"changes sigma, and {fixed[0]} holds for one: omit one of them")

    def memory(self, plan: StudyPlan, cell: StudyCell) -> int:
        """Memory held at once [bytes]: the batches and histories of all seeds, or the rollouts of an evaluation."""
        task, config, recipe = plan.task_of(cell), plan.config, plan.groups[cell.group].descent
        evaluation = config.settings.evaluation_samples * bytes_per_sample(task, ("evaluation",), 0, draws=0)
        return max(super().memory(plan, cell) + 8 * HISTORY_NUMBERS * config.seeds * recipe.iterations, evaluation)

    def program_of(self, cell: StudyCell) -> Hashable:
        return super().program_of(cell), cell.sigma, cell.samples

    def programs_per_key(self, config: StudyConfig) -> int:
        return len(config.estimators)

    def rollouts(self, plan: StudyPlan, cell: StudyCell) -> np.ndarray:
        task, chosen = plan.task_of(cell), estimators_of(plan, cell)
        batches = [rollouts_of(each.needs, cell.samples, task) for each in chosen]
        evaluations = (plan.config.seeds * len(chosen) + 1) * plan.config.settings.evaluation_samples
        iterations = plan.groups[cell.group].descent.iterations
        return plan.config.seeds * iterations * np.sum(batches, axis=0) + [evaluations, 0]

    def computation(self, plan: StudyPlan) -> "DescentComputation":
        return DescentComputation(plan)

    def drawings(self, dataset: xr.Dataset) -> dict[str, Drawing]:
        from mjx_study.plots.descents import achieved, descent

        return {
            "achieved": Drawing(achieved, "Cost of the final policies against stiffness."),
            "descent": Drawing(descent, "Cost against iterations, rollouts and seconds."),
        }

    def summarised(self, dataset: xr.Dataset) -> xr.Dataset:
        """Add the number of stopped seeds."""
        return dataset.assign(stopped_seeds=dataset["stopped_at"].notnull())


KIND: Final = Descents()


class DescentComputation(Computation):
    """Computes the descents of a cell in a single unit, with checkpoints."""

    def __init__(self, plan: StudyPlan):
        self._plan = plan
        self._backends: dict[Hashable, Backend] = {}

    def compute(self, cell: StudyCell, unit: int, checkpoint: Checkpoint) -> Future[Arrays]:
        key = (cell.group, cell.sigma, cell.samples, cell.model.stiffness_or_zero if cell.model.analytic else None)
        if key not in self._backends:
            self._backends[key] = Backend(self._plan, cell)
        backend, kept = self._backends[key], dict(checkpoint.kept)
        chosen = estimators_of(self._plan, cell)
        runs = [_Run(backend, cell.model, each, index, kept, checkpoint) for index, each in enumerate(chosen)]
        backend.costs = {run.estimator.name: (run.already, math.nan) for run in runs}
        builds = Builds()
        for run in runs:
            run.build(builds)
        backend.build_evaluation(cell.model, builds)
        builds.wait()
        with ThreadPoolExecutor(backend.threads) as pool:
            each_in_turn = map if backend.threads == 1 else pool.map
            list(each_in_turn(_Run.descend, runs))
        total = len(chosen) * backend.recipe.iterations
        checkpoint.report(total, total, "evaluating the final policies")
        numbers = [run.numbers() for run in runs]
        found = {name: np.stack([each[name] for each in numbers], axis=-1) for name in numbers[0] if name != "theta"}
        found["theta"] = np.stack([each["theta"] for each in numbers], axis=1)  # (seed, estimator, param)
        mean, error = backend.cost(backend.task.theta, cell.model)
        found |= {"start_cost": np.array(mean), "start_cost_se": np.array(error)}
        start = backend.metrics(backend.task.theta, cell.model)
        found |= {START + name: np.array(value) for name, value in start.items()}
        return done(kept | {name: np.asarray(array, float) for name, array in found.items()})


@dataclasses.dataclass
class _Run:
    """Descents of one estimator, the cell's `index`-th, from all seeds; all estimators add to the arrays `kept`."""

    backend: Backend
    model: ContactPoint
    estimator: Estimator
    index: int
    kept: dict[str, np.ndarray]
    checkpoint: Checkpoint

    def __post_init__(self) -> None:
        """Begin at the start, or restore a run from its checkpoint."""
        backend, index = self.backend, self.index
        self.state = begin(backend.optimizer, backend.task.theta, backend.seeds, backend.rows)
        self.records: list[Record] = []
        self.seconds: list[float] = []
        if f"seconds_{index}" in self.kept:
            with self.checkpoint.restored():
                self._restore()
        self.already = len(self.records)
        self.state = backend.place(self.state, index)
        self._keys_of = partial(_keys, backend.config.seed, seeds=backend.rows)
        self._iterate = backend.iteration(self.estimator, self.model)

    @property
    def _goes_on(self) -> bool:
        return self.already < self.backend.recipe.iterations and bool(np.any(going(self.state)))

    def build(self, builds: Builds) -> None:
        """Begin to compile an iteration."""
        if self._goes_on:
            first = self._keys_of(self.already), self.already
            self.backend.build(self.estimator, builds, self.model, self.state, *first)

    def _restore(self) -> None:
        """Take state, records and times from the checkpoint; KeyError or ValueError if it is not of this run."""
        leaves, structure = jax.tree.flatten(self.state)
        length = self.kept[f"seconds_{self.index}"].size
        if length > self.backend.recipe.iterations:
            raise ValueError(f"it has {length} iterations")

        def kept(name: str, shape: tuple[int, ...], kind: str) -> np.ndarray:
            array = self.kept[name]
            if array.shape != shape or array.dtype.kind != kind:
                raise ValueError(f"{name} has shape {array.shape} and type {array.dtype}")
            return array

        state = [
            kept(f"state_{self.index}_{i}", (self.backend.seeds, *leaf.shape[1:]), leaf.dtype.kind)
            for i, leaf in enumerate(leaves)
        ]
        each = length, self.backend.seeds
        columns = [kept(f"history_{self.index}_{name}", each, "f") for name in HISTORY]
        whole = [np.concatenate([rows, leaf[len(rows) :]]) for rows, leaf in zip(state, leaves, strict=True)]
        self.state = structure.unflatten(whole)
        self.records += [Record(zip(HISTORY, row, strict=True)) for row in zip(*columns, strict=True)]
        self.seconds += map(float, kept(f"seconds_{self.index}", (length,), "f"))

    def descend(self) -> None:
        """Run the remaining iterations, writing a checkpoint now and then and at the end."""
        iterations, done, pending = self.backend.recipe.iterations, self.already, []
        if self._goes_on:  # the first call takes longer; its result is discarded
            jax.block_until_ready(self._iterate(self.state, self._keys_of(done), done))
        last = saved = time.perf_counter()
        while done < iterations and (pending or bool(np.any(going(self.state)))):
            self.state, record = self._iterate(self.state, self._keys_of(done), done)
            pending.append(record)
            done += 1
            if len(pending) >= REPORT_EVERY:
                last = self._collect(pending, last)
                self._report(done)
                if last - saved > SAVE_SECONDS:
                    self._save()
                    saved = last = time.perf_counter()
        if pending:
            self._collect(pending, last)
        if done > self.already:
            self._save()

    def _report(self, done: int) -> None:
        """Report the progress of all estimators, and their costs so far."""
        backend = self.backend
        with backend.saving:
            last = np.asarray(self.records[-1]["cost"])
            last = last[np.isfinite(last)]
            backend.costs[self.estimator.name] = done, float(np.mean(last)) if len(last) else math.nan
            total = len(backend.costs) * backend.recipe.iterations
            costs = {name: cost for name, (_, cost) in backend.costs.items() if not math.isnan(cost)}
            shown = ", ".join(f"{name} {number(cost, 4)}" for name, cost in costs.items())
            self.checkpoint.report(sum(each for each, _ in backend.costs.values()), total, f"descent; cost: {shown}")

    def _collect(self, pending: list[Record], since: float) -> float:
        """Fetch records from the device, and return when they arrived."""
        self.records += jax.tree.map(lambda leaf: leaf[: self.backend.seeds], jax.device_get(pending))
        now, elapsed = time.perf_counter(), self.seconds[-1] if self.seconds else 0.0
        self.seconds += [elapsed + (now - since) * (place + 1) / len(pending) for place in range(len(pending))]
        pending.clear()
        return now

    def _save(self) -> None:
        with self.backend.saving:
            leaves = jax.tree.leaves(self._state_of_seeds)
            self.kept.update({f"state_{self.index}_{leaf}": value for leaf, value in enumerate(leaves)})
            self.kept.update({f"history_{self.index}_{name}": values for name, values in self._history().items()})
            self.kept[f"seconds_{self.index}"] = np.array(self.seconds)
            self.checkpoint.save(dict(self.kept))

    @property
    def _state_of_seeds(self) -> Descent:
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: self.backend.seeds], self.state)

    def _history(self) -> dict[str, Float[np.ndarray, "iterations seeds"]]:
        shape = len(self.records), self.backend.seeds
        return {name: np.array([record[name] for record in self.records], float).reshape(shape) for name in HISTORY}

    def numbers(self) -> dict[str, np.ndarray]:
        """Numbers of the run, once it has ended."""
        backend, history, state = self.backend, self._history(), self._state_of_seeds
        thetas = [jax.device_put(theta) for theta in state.theta]
        costs = [backend.cost(theta, self.model) for theta in thetas]
        metrics = [backend.metrics(theta, self.model) for theta in thetas]
        reason = state.reason
        done = np.sum(~np.isnan(history["nonfinite"]), axis=0)
        found = {name: _padded(values, backend.recipe.iterations) for name, values in history.items()}
        return found | {
            "theta": state.theta,
            "seconds": _padded(np.array(self.seconds), backend.recipe.iterations),
            "stopped_at": np.where(reason > 0, done, np.nan),
            "reason": np.where(reason > 0, reason, np.nan),
            "final_cost": np.array([mean for mean, _ in costs]),
            "final_cost_se": np.array([error for _, error in costs]),
            "rollouts": rollouts_of(self.estimator.needs, backend.samples, backend.task)[0],
            **{METRIC + name: np.array([each[name] for each in metrics]) for name in metrics[0]},
        }


@partial(jax.jit, static_argnames="seeds")
def _keys(seed: Int[Array, ""] | int, iteration: Int[Array, ""] | int, seeds: int) -> Key[Array, " seeds"]:
    """Keys of an iteration, of seeds that may be more than there are."""
    first = jax.random.key(seed)
    return jax.vmap(lambda each: jax.random.fold_in(jax.random.fold_in(first, each), iteration))(jnp.arange(seeds))


def _padded(values: np.ndarray, length: int) -> np.ndarray:
    """Pad values with NaN to a length along the first axis."""
    missing = [(0, length - len(values))] + [(0, 0)] * (values.ndim - 1)
    return np.pad(np.asarray(values, float), missing, constant_values=np.nan)
