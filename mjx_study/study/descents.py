"""Optimising a policy with any estimator: planning, running several seeds at once, and going on where a run stopped.

A plan is checked completely before anything is computed. All seeds of an estimator advance in one compiled program, in
MJX without a return to the host between rollouts and update; on a reference system the rollouts are NumPy's. Iteration
i of seed s draws from a key of its own, so that a run which was stopped and goes on ends bit for bit where an
undisturbed one does; all estimators share these keys.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Key

from estimators import ORACLES, Estimator, Objective, draw
from mjx_study.objective import Simulator, TracedObjective, simulate
from mjx_study.runtime import environment
from mjx_study.simulation.contact import ContactModel
from mjx_study.study.checkpoint import Checkpoints
from mjx_study.study.configuration import (
    EstimatorConfig,
    Progress,
    at_theta,
    configured_estimators,
    configured_task,
    resolved_fields,
)
from mjx_study.study.identity import contents
from mjx_study.study.iteration import REASONS, Descent, Record, advance, begin, going, make_optimizer
from mjx_study.study.memory import check_memory
from mjx_study.tasks.contact_grid import ContactPoint, contact_grid
from mjx_study.tasks.network import with_network
from mjx_study.tasks.task import Task

REPORT_EVERY: Final = 10
"""Iterations between reports of progress, which wait for the device."""
SAVE_SECONDS: Final = 20.0
"""Seconds between checkpoints."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OptimiseConfig(EstimatorConfig):
    """Everything that decides a run; each estimator makes one. See also `EstimatorConfig`.

    Attributes:
        contact: contact family; None for the task's.
        stiffness: of the contact [N/m]; None for the middle one of the task's.
        reference: run on the analytic reference in place of MJX.
        network: widths of the hidden layers of a network in place of the task's policy; None for that.
        iterations, samples, learning_rate, decay: None for the task's recipe.
        optimizer: name of an optimiser of optax.
        seeds: runs of each estimator.
        evaluation_samples: rollouts behind the cost of a final policy, the same for all.
    """

    ranges: ClassVar = {"samples": "[2, 1e7]", "stiffness": "[0, inf)"}  # 0 where there is no contact

    contact: str | None = None
    stiffness: float | None = None
    reference: bool = False
    network: tuple[int, ...] | None = None
    iterations: int | None = None
    samples: int | None = None
    learning_rate: float | None = None
    decay: float | None = None
    optimizer: str = "sgd"
    seeds: int = 3
    evaluation_samples: int = 200

    @property
    def identity(self) -> dict[str, Any]:
        """What must not differ for a run to go on: all but how long it is, and which runs are beside it."""
        free = ("iterations", "estimators", "evaluation_samples", "chunk_size")
        return {name: value for name, value in dataclasses.asdict(self).items() if name not in free}


@dataclasses.dataclass(frozen=True)
class OptimisePlan:
    """A run that has been checked: its task is built, its contact model and optimiser are valid."""

    config: OptimiseConfig
    task: Task
    cell: ContactPoint
    estimators: tuple[Estimator, ...]
    warnings: tuple[str, ...]

    @property
    def identity(self) -> dict[str, Any]:
        """What must not differ for a run to go on: its configuration, and what task and contact are made of."""
        contact = self.cell.contact
        arrays = () if contact is None else (contact.solref, contact.solimp)
        parameters = [np.asarray(array).tolist() for array in arrays]
        return contents({self.task.name: [self.task]}) | self.config.identity | {"contact_parameters": parameters}


def plan_optimise(config: OptimiseConfig, task: Task | None = None, cell: ContactPoint | None = None) -> OptimisePlan:
    """Check a configuration and resolve its defaults, computing nothing.

    Args:
        config: what to run.
        task: in place of the one that the configuration names.
        cell: the contact model, in place of the one that the configuration names.

    Raises:
        ValueError: anything about the configuration that cannot be run; the message says what is accepted.
    """
    task = configured_task(config, task)
    if config.network is not None:
        if config.reference:
            raise ValueError("a network needs MJX: the analytic references take the task's own policy")
        task = with_network(task, config.network, jax.random.key(config.seed))
    task = at_theta(task, config.theta)
    if config.reference and task.reference is None:
        raise ValueError(f"{task.name} has no analytic reference")
    if config.reference and config.onset != "none":
        raise ValueError("the analytic references have no onset term; leave onset out")
    numbers = {name: getattr(config, name) for name in ("iterations", "samples", "learning_rate", "decay")}
    if task.recipe is None:
        numbers["decay"] = numbers["decay"] or 0.0
        if missing := [name.replace("_", " ") for name, value in numbers.items() if value is None]:
            raise ValueError(f"{task.name} has no recipe: give {', '.join(missing)}")
    else:
        numbers = {name: getattr(task.recipe, name) if value is None else value for name, value in numbers.items()}
    make_optimizer(config.optimizer, numbers["learning_rate"], numbers["decay"])
    chosen = configured_estimators(config, task)
    history = 20 * config.seeds * numbers["iterations"]
    check_memory(task, chosen, config.seeds * numbers["samples"], other=history)
    check_memory(task, (), config.evaluation_samples)
    messages: tuple[str, ...] = ()
    if cell is None:
        stiffness = task.middle_stiffness if config.stiffness is None else config.stiffness
        (cell,), messages = contact_grid(task, (config.contact or task.main_family,), (stiffness,), config.damping)
    resolved = dataclasses.replace(
        config,
        contact=cell.family,
        stiffness=cell.stiffness,
        **resolved_fields(config, task, numbers["samples"]),
        **numbers,
    )
    return OptimisePlan(resolved, task, cell, chosen, () if config.reference else messages)


@dataclasses.dataclass(frozen=True)
class Run:
    """All seeds of one estimator.

    Attributes:
        estimator: name.
        theta: final parameters of each seed.
        history: of every `Record` field, by iteration and seed.
        seconds: since the start, at each iteration, compilation excluded.
        reason: index into `descent.REASONS` of each seed.
        final_cost, final_cost_se: mean cost of each seed's final policy over the evaluation samples, and its standard
            error; NaN where no sample is finite.
        outcomes: by name, what each seed's final policy comes to, the mean over the evaluation samples.
        rollouts: simulated in one iteration of one seed, those of baselines included.
    """

    estimator: str
    theta: Float[np.ndarray, "seeds params"]
    history: dict[str, Float[np.ndarray, "iterations seeds"]]
    seconds: Float[np.ndarray, " iterations"]
    reason: np.ndarray
    final_cost: Float[np.ndarray, " seeds"]
    final_cost_se: Float[np.ndarray, " seeds"]
    outcomes: dict[str, Float[np.ndarray, " seeds"]]
    rollouts: int

    @property
    def stopped(self) -> dict[int, tuple[int, str]]:
        """By seed that stopped: its last iteration, from 1, and why."""
        done = np.sum(~np.isnan(self.history["nonfinite"]), axis=0)
        return {seed: (int(done[seed]), REASONS[code]) for seed, code in enumerate(self.reason) if code}

    @property
    def best(self) -> int:
        """The seed of least final cost."""
        return int(np.nanargmin(self.final_cost)) if np.any(np.isfinite(self.final_cost)) else 0


@dataclasses.dataclass(frozen=True)
class OptimiseResult:
    """What a run found, with what it depended on.

    Attributes:
        config: as resolved.
        environment: versions, machine, devices, precision.
        runs: one per estimator.
        start_cost: mean cost of the start's policy over the evaluation samples, and its standard error.
        start_outcomes: what the start's policy comes to.
        warnings: about the contact model, and about runs that several versions computed.
        unsaved: checkpoints that could not be written, and why.
    """

    config: OptimiseConfig
    environment: dict[str, Any]
    runs: tuple[Run, ...]
    start_cost: tuple[float, float]
    start_outcomes: dict[str, float]
    warnings: tuple[str, ...]
    unsaved: tuple[str, ...] = ()


def optimise(
    plan: OptimisePlan,
    folder: Path | None = None,
    progress: Progress = lambda done, total, what: None,
    backend: "Backend | None" = None,
    *,
    accept_versions: bool = False,
) -> OptimiseResult:
    """Run every estimator; with a folder, from where runs in it stopped, and with checkpoints there.

    Args:
        plan: what to run.
        folder: of checkpoints.
        progress: called as it goes on.
        backend: of an earlier plan that differs from this one in its contact model alone, so that nothing is compiled
            again.
        accept_versions: go on where other versions of JAX, MuJoCo or this package stopped.

    Raises:
        ValueError: the folder holds a run of another configuration, of more iterations or of other versions, or a file
            that is not one.
    """
    config = plan.config
    assert config.iterations is not None and config.chunk_size is not None, "a plan's configuration is resolved"
    backend = Backend(plan) if backend is None else backend
    checkpoints = None if folder is None else open_checkpoints(folder, plan, accept_versions=accept_versions)
    iterations, runs = config.iterations, []
    total = len(config.estimators) * iterations
    for index, (name, estimator) in enumerate(zip(config.estimators, plan.estimators, strict=True)):
        report = lambda done, index=index, name=name: progress(index * iterations + done, total, name)  # noqa: E731
        runs.append(_run(plan, backend, name, estimator, checkpoints, report))
    start, came_to = backend.cost(plan.task.theta, plan.cell), backend.outcomes(plan.task.theta, plan.cell)
    progress(total, total, "done")
    mixed, unsaved = ((), ()) if checkpoints is None else (checkpoints.mixed, tuple(checkpoints.unsaved.values()))
    return OptimiseResult(config, environment(), tuple(runs), start, came_to, plan.warnings + mixed, unsaved)


def open_checkpoints(folder: Path, plan: OptimisePlan, *, accept_versions: bool = False) -> Checkpoints:
    """The runs of a folder, checked against a plan; see `Checkpoints`."""
    config = plan.config
    return Checkpoints(
        folder, config.estimators, plan.identity, config.iterations or 0, accept_versions=accept_versions
    )


class Backend:
    """Where rollouts come from: MJX in compiled programs that serve every contact model, or a reference on the host."""

    def __init__(self, plan: OptimisePlan):
        self.config, self.task = plan.config, plan.task
        self.simulator = None if plan.config.reference else Simulator(plan.task, chunk_size=plan.config.chunk_size)  # type: ignore[arg-type]
        self._iterations: dict[Estimator, Callable[..., tuple[Descent, Record]]] = {}

    def place(self, state: Descent) -> Descent:
        """The state where an iteration leaves it, on all devices, so that the first one compiles for all."""
        if self.simulator is None:
            return state
        mesh = Mesh(np.array(self.simulator.devices), ("samples",))
        return jax.device_put(state, NamedSharding(mesh, PartitionSpec()))

    def iteration(
        self, estimator: Estimator, cell: ContactPoint
    ) -> Callable[[Descent, Key[Array, " seeds"]], tuple[Descent, Record]]:
        """An iteration of all seeds under one contact model; compiled once for all of them."""
        config = self.config
        optimizer = make_optimizer(config.optimizer, config.learning_rate, config.decay)  # type: ignore[arg-type]

        def update(state: Descent, drawn: dict[str, Any]) -> tuple[Descent, Record]:
            return advance(state, drawn, estimator, optimizer)

        def batches(objective: Objective, theta: Float[Array, " params"], key: Key[Array, ""]) -> dict[str, Any]:
            return draw(estimator.needs, objective, theta, key, config.samples)  # type: ignore[arg-type]

        if self.simulator is not None:
            if estimator not in self._iterations:
                self._iterations[estimator] = jax.jit(
                    lambda contact, state, keys: update(
                        state, jax.vmap(partial(batches, self._traced(contact)))(state.theta, keys)
                    )
                )
            return partial(self._iterations[estimator], cell.contact)
        compiled = self._iterations.setdefault(estimator, jax.jit(update))
        reference = self.task.analytic(cell.stiffness)

        def on_host(state: Descent, keys: Key[Array, " seeds"]) -> tuple[Descent, Record]:
            drawn = [batches(reference, theta, key) for theta, key in zip(state.theta, keys, strict=True)]
            return compiled(state, jax.tree.map(lambda *leaves: jnp.stack(leaves), *drawn))

        return on_host

    def cost(self, theta: Float[Array, " params"], cell: ContactPoint) -> tuple[float, float]:
        """Mean cost with noise at theta, over samples that are the same for every theta, and its standard error."""
        objective = (
            self.task.analytic(cell.stiffness) if self.simulator is None else self.simulator.objective(cell.contact)
        )
        value = np.asarray(objective.evaluate(theta, self._evaluation_keys()).value)
        value = value[np.isfinite(value)]
        if len(value) < 2:
            return math.nan, math.nan
        return float(np.mean(value)), float(np.std(value, ddof=1) / math.sqrt(len(value)))

    def outcomes(self, theta: Float[Array, " params"], cell: ContactPoint) -> dict[str, float]:
        """What the rollouts of `cost` came to: means over those that are finite."""
        if self.simulator is None:
            found = self.task.analytic(cell.stiffness).observe(theta, self._evaluation_keys())
        elif self.task.outcomes is None:
            return {}
        else:
            found = jax.device_get(self._observe(theta, cell.contact, self._evaluation_keys()))
        return {name: float(np.mean(values, where=np.isfinite(values))) for name, values in sorted(found.items())}

    def _traced(self, contact: ContactModel | None) -> TracedObjective:
        assert self.simulator is not None
        return TracedObjective(self.simulator, contact, self.task.sigma)

    def _evaluation_keys(self) -> Key[Array, " samples"]:
        key = jax.random.fold_in(jax.random.key(self.config.seed), 2**31 - 1)
        return jax.random.split(key, self.config.evaluation_samples)

    @partial(jax.jit, static_argnums=0)
    def _observe(
        self, theta: Float[Array, " params"], contact: ContactModel | None, keys: Key[Array, " samples"]
    ) -> dict[str, Array]:
        """Outcomes of rollouts in MJX, by name and sample."""

        def one(key: Key[Array, ""]) -> dict[str, Array]:
            states, *_ = simulate(self.task, theta, contact, key, 1.0)
            return self.task.outcomes(states)  # type: ignore[misc]

        return jax.vmap(one)(keys)


def _run(
    plan: OptimisePlan,
    backend: Backend,
    name: str,
    estimator: Estimator,
    checkpoints: Checkpoints | None,
    report: Callable[[int], None],
) -> Run:
    config, task = plan.config, plan.task
    iterations: int = config.iterations  # type: ignore[assignment]
    optimizer = make_optimizer(config.optimizer, config.learning_rate, config.decay)  # type: ignore[arg-type]
    state, records, seconds = begin(optimizer, task.theta, config.seeds), [], []
    kept = None if checkpoints is None else checkpoints.kept[name]
    if kept is not None:
        state, records, seconds = kept.restored(state)
    state = backend.place(state)
    keys = jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(config.seed), seed))(jnp.arange(config.seeds))
    keys_of = jax.jit(lambda index: jax.vmap(lambda key: jax.random.fold_in(key, index))(jax.random.clone(keys)))
    iterate = backend.iteration(estimator, plan.cell)
    done = already = len(records)
    elapsed = seconds[-1] if seconds else 0.0
    if done < iterations and bool(jnp.any(going(state))):
        jax.block_until_ready(iterate(state, keys_of(done)))  # compiles; what it gives is dropped
    saved = last = time.perf_counter()
    pending: list[Record] = []

    def collect(record: Record | None) -> None:
        nonlocal last, elapsed
        if record is not None:
            pending.append(record)
        if pending and (record is None or len(pending) >= REPORT_EVERY):
            records.extend(jax.device_get(pending))
            now = time.perf_counter()
            seconds.extend(elapsed + (now - last) * (index + 1) / len(pending) for index in range(len(pending)))
            elapsed, last = seconds[-1], now
            pending.clear()

    while done < iterations:
        if not pending and not bool(jnp.any(going(state))):
            break
        state, record = iterate(state, keys_of(done))
        done += 1
        collect(record)
        if not pending:
            report(done)
            if checkpoints is not None and time.perf_counter() - saved > SAVE_SECONDS:
                checkpoints.save(name, state, records, seconds)
                saved = last = time.perf_counter()
    collect(None)
    if checkpoints is not None and done > already:
        checkpoints.save(name, state, records, seconds)
    costs = [backend.cost(theta, plan.cell) for theta in state.theta]
    came_to = [backend.outcomes(theta, plan.cell) for theta in state.theta]
    history = {
        field.name: np.array([getattr(record, field.name) for record in records]).reshape(len(records), config.seeds)
        for field in dataclasses.fields(Record)
    }
    return Run(
        estimator=name,
        theta=np.asarray(state.theta),
        history=history,
        seconds=np.array(seconds),
        reason=np.asarray(state.reason),
        final_cost=np.array([mean for mean, _ in costs]),
        final_cost_se=np.array([error for _, error in costs]),
        outcomes={what: np.array([each[what] for each in came_to]) for what in came_to[0]},
        rollouts=_rollouts(estimator.needs, config.samples, task.random_start),  # type: ignore[arg-type]
    )


def _rollouts(needs: Sequence[str], samples: int, random_start: bool) -> int:
    """Rollouts in one iteration of one seed: a pair is two, and each batch of order 0 has its baselines."""
    count = 0
    for oracle in needs:
        baselines = samples if random_start else 1
        count += samples * (2 if "pair" in oracle else 1)
        count += baselines if ORACLES[oracle].order == 0 or oracle == "linearisation" else 0
    return count
