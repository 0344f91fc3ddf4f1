"""Optimising a policy with any estimator: planning, running several seeds at once, and going on where a run stopped.

A plan is checked completely before anything is computed. All seeds of an estimator advance in one compiled program, in
MJX without a return to the host between rollouts and update; on a reference system the rollouts are NumPy's. Iteration
i of seed s draws from a key of its own, so that a run which was stopped and goes on ends bit for bit where an
undisturbed one does; all estimators share these keys.
"""

import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float, Key

from estimators import ESTIMATORS, ORACLES, EstimatorOptions, Objective, draw
from estimators.ddcg import PUBLISHED_TOLERANCE
from mjx_study.descent import REASONS, Descent, Record, advance, begin, going, make_optimizer
from mjx_study.network import with_network
from mjx_study.objective import Simulator, TracedObjective, chunk_for
from mjx_study.results import write_whole
from mjx_study.runtime import environment
from mjx_study.study import Cell, Progress, check_estimators, plan_cells
from mjx_study.task import Task
from mjx_study.tasks import make_task

REPORT_EVERY: Final = 10
"""Iterations between reports of progress, which wait for the device."""
SAVE_SECONDS: Final = 20.0
"""Seconds between checkpoints."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OptimiseConfig:
    """Everything that decides a run.

    Attributes:
        task: name of a task.
        estimators: names of estimators, each of which makes a run.
        contact: contact family; None for the task's.
        stiffness: of the contact [N/m]; None for the middle one of the task's.
        damping: of the contact [N s/m]; None for the family's.
        reference: run on the analytic reference in place of MJX.
        network: widths of the hidden layers of a network in place of the task's policy; None for that.
        iterations, samples, learning_rate, decay: None for the task's recipe.
        optimizer: name of an optimiser of optax.
        seeds: runs of each estimator.
        seed: of all randomness.
        sigma, noise: standard deviation and density of the noise; None for the task's.
        baseline, gamma, failure_probability, variance_proxy, radius, max_norm, window, tolerance: see
            `estimators.EstimatorOptions`; gamma None for the task's.
        cone, horizon, model: as in a comparison.
        evaluation_samples: rollouts behind the cost of a final policy, the same for all.
        chunk_size: samples per device and call; None to choose by the number of samples.
    """

    task: str
    estimators: tuple[str, ...] = ("zobg", "fobg", "aobg")
    contact: str | None = None
    stiffness: float | None = None
    damping: float | None = None
    reference: bool = False
    network: tuple[int, ...] | None = None
    iterations: int | None = None
    samples: int | None = None
    learning_rate: float | None = None
    decay: float | None = None
    optimizer: str = "sgd"
    seeds: int = 3
    seed: int = 0
    sigma: float | None = None
    noise: str | None = None
    baseline: str = "zero_noise"
    gamma: float | None = None
    failure_probability: float = 0.05
    variance_proxy: str = "variance"
    radius: str | float = "max_deviation"
    max_norm: float | None = None
    window: int | None = None
    tolerance: float = PUBLISHED_TOLERANCE
    cone: str | None = None
    horizon: int | None = None
    model: str | None = None
    evaluation_samples: int = 200
    chunk_size: int | None = None

    def __post_init__(self) -> None:
        if not self.estimators:
            raise ValueError(f"no estimator given; choose from {', '.join(ESTIMATORS)}")
        for name in self.estimators:
            if name not in ESTIMATORS:
                raise ValueError(f"unknown estimator {name!r}; choose from {', '.join(ESTIMATORS)}")
        if len(set(self.estimators)) < len(self.estimators):
            raise ValueError(f"an estimator given twice: {', '.join(self.estimators)}")
        counts = {"iterations": 1, "samples": 2, "seeds": 1, "evaluation_samples": 2, "chunk_size": 1}
        for name, least in counts.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name.replace('_', ' ')} must be at least {least}, got {value}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")


@dataclasses.dataclass(frozen=True)
class OptimisePlan:
    """A run that has been checked: its task is built, its contact model and optimiser are valid."""

    config: OptimiseConfig
    task: Task
    cell: Cell
    options: EstimatorOptions
    warnings: tuple[str, ...]


def plan_optimise(config: OptimiseConfig) -> OptimisePlan:
    """Check a configuration and resolve its defaults, computing nothing.

    Raises:
        ValueError: anything about the configuration that cannot be run; the message says what is accepted.
    """
    scene_options: dict[str, Any] = {"cone": config.cone, "horizon": config.horizon, "model": config.model}
    task = make_task(config.task, **{name: value for name, value in scene_options.items() if value is not None})
    changes = {"sigma": config.sigma, "noise": config.noise}
    task = task.replace(**{name: value for name, value in changes.items() if value is not None})
    if config.network is not None:
        if config.reference:
            raise ValueError("a network needs MJX: the analytic references take the task's own policy")
        task = with_network(task, config.network, jax.random.key(config.seed))
    if config.reference and task.reference is None:
        raise ValueError(f"{task.name} has no analytic reference")
    numbers = {}
    for name in ("iterations", "samples", "learning_rate", "decay"):
        value = getattr(config, name)
        if value is None:
            if task.recipe is None:
                raise ValueError(f"{task.name} has no recipe: give {name.replace('_', ' ')}")
            value = getattr(task.recipe, name)
        numbers[name] = value
    make_optimizer(config.optimizer, numbers["learning_rate"], numbers["decay"])
    options = EstimatorOptions(
        baseline=config.baseline,
        gamma=task.gamma if config.gamma is None else config.gamma,
        failure_probability=config.failure_probability,
        variance_proxy=config.variance_proxy,
        radius=config.radius,
        sigma=task.sigma,
        max_norm=config.max_norm,
        window=config.window,
        tolerance=config.tolerance,
    )
    check_estimators(config.estimators, task, options)
    family = config.contact or ("mujoco" if "mujoco" in task.families else task.families[0])
    stiffness = task.stiffnesses[len(task.stiffnesses) // 2] if config.stiffness is None else config.stiffness
    (cell,), messages = plan_cells(task, (family,), (stiffness,), config.damping)
    chunk = chunk_for(numbers["samples"], jax.local_devices()) if config.chunk_size is None else config.chunk_size
    resolved = dataclasses.replace(
        config,
        contact=cell.family,
        stiffness=cell.stiffness,
        sigma=task.sigma,
        noise=task.noise,
        gamma=options.gamma,
        horizon=task.horizon,
        cone={0: "pyramidal", 1: "elliptic"}[int(task.scene.host.opt.cone)],
        chunk_size=chunk,
        **numbers,
    )
    return OptimisePlan(resolved, task, cell, options, () if config.reference else messages)


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
        rollouts: simulated in one iteration of one seed, those of baselines included.
    """

    estimator: str
    theta: Float[np.ndarray, "seeds params"]
    history: dict[str, Float[np.ndarray, "iterations seeds"]]
    seconds: Float[np.ndarray, " iterations"]
    reason: np.ndarray
    final_cost: Float[np.ndarray, " seeds"]
    final_cost_se: Float[np.ndarray, " seeds"]
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
        warnings: about the contact model.
    """

    config: OptimiseConfig
    environment: dict[str, Any]
    runs: tuple[Run, ...]
    start_cost: tuple[float, float]
    warnings: tuple[str, ...]


def optimise(
    plan: OptimisePlan, folder: Path | None = None, progress: Progress = lambda done, total, what: None
) -> OptimiseResult:
    """Run every estimator; with a folder, from where runs in it stopped, and with checkpoints there.

    Raises:
        ValueError: the folder holds a run of another configuration, or a file that is not one.
    """
    config = plan.config
    assert config.iterations is not None and config.chunk_size is not None, "a plan's configuration is resolved"
    backend = _Backend(plan)
    kept = {name: None if folder is None else load_checkpoint(folder, name, config) for name in config.estimators}
    iterations, runs = config.iterations, []
    total = len(config.estimators) * iterations
    for index, name in enumerate(config.estimators):
        report = lambda done, index=index, name=name: progress(index * iterations + done, total, name)  # noqa: E731
        runs.append(_run(plan, backend, name, kept[name], folder, report))
    start = backend.cost(plan.task.theta)
    progress(total, total, "done")
    return OptimiseResult(config, environment(), tuple(runs), start, plan.warnings)


class _Backend:
    """Where rollouts come from: MJX in the compiled program, or a reference on the host."""

    def __init__(self, plan: OptimisePlan):
        config, task = plan.config, plan.task
        self.plan = plan
        self.objective: Objective
        if config.reference:
            reference = task.reference(plan.cell.stiffness)  # type: ignore[misc]
            self.objective = dataclasses.replace(reference, sigma=task.sigma, noise=task.noise)  # type: ignore[type-var]
        else:
            simulator = Simulator(task, chunk_size=config.chunk_size)  # type: ignore[arg-type]
            self.objective = TracedObjective(simulator, plan.cell.contact, task.sigma)
            self.evaluation = Simulator(task, chunk_size=config.chunk_size).objective(plan.cell.contact)  # type: ignore[arg-type]

    def place(self, state: Descent) -> Descent:
        """The state where an iteration leaves it, on all devices, so that the first one compiles for all."""
        if not isinstance(self.objective, TracedObjective):
            return state
        mesh = Mesh(np.array(self.objective.simulator.devices), ("samples",))
        return jax.device_put(state, NamedSharding(mesh, PartitionSpec()))

    def iteration(self, name: str) -> Callable[[Descent, Key[Array, " seeds"]], tuple[Descent, Record]]:
        """An iteration of all seeds."""
        plan, needs = self.plan, ESTIMATORS[name].needs
        config = plan.config
        optimizer = make_optimizer(config.optimizer, config.learning_rate, config.decay)  # type: ignore[arg-type]

        def batches(theta: Float[Array, " params"], key: Key[Array, ""]) -> dict[str, Any]:
            return draw(needs, self.objective, theta, key, config.samples)  # type: ignore[arg-type]

        def update(state: Descent, drawn: dict[str, Any]) -> tuple[Descent, Record]:
            return advance(state, drawn, name, plan.options, optimizer)

        if not config.reference:
            return jax.jit(lambda state, keys: update(state, jax.vmap(batches)(state.theta, keys)))
        compiled = jax.jit(update)

        def on_host(state: Descent, keys: Key[Array, " seeds"]) -> tuple[Descent, Record]:
            drawn = [batches(theta, key) for theta, key in zip(state.theta, keys, strict=True)]
            return compiled(state, jax.tree.map(lambda *leaves: jnp.stack(leaves), *drawn))

        return on_host

    def cost(self, theta: Float[Array, " params"]) -> tuple[float, float]:
        """Mean cost with noise at theta, over samples that are the same for every theta, and its standard error."""
        config = self.plan.config
        key = jax.random.fold_in(jax.random.key(config.seed), 2**31 - 1)
        objective = self.objective if config.reference else self.evaluation
        value = np.asarray(objective.evaluate(theta, jax.random.split(key, config.evaluation_samples)).value)
        value = value[np.isfinite(value)]
        if len(value) < 2:
            return math.nan, math.nan
        return float(np.mean(value)), float(np.std(value, ddof=1) / math.sqrt(len(value)))


def _run(
    plan: OptimisePlan,
    backend: _Backend,
    name: str,
    kept: "Checkpoint | None",
    folder: Path | None,
    report: Callable[[int], None],
) -> Run:
    config, task = plan.config, plan.task
    iterations: int = config.iterations  # type: ignore[assignment]
    optimizer = make_optimizer(config.optimizer, config.learning_rate, config.decay)  # type: ignore[arg-type]
    state, records, seconds = begin(optimizer, task.theta, config.seeds), [], []
    if kept is not None:
        state, records, seconds = kept.restored(state)
    state = backend.place(state)
    records, seconds = records[:iterations], seconds[:iterations]
    keys = jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(config.seed), seed))(jnp.arange(config.seeds))
    keys_of = jax.jit(lambda index: jax.vmap(lambda key: jax.random.fold_in(key, index))(jax.random.clone(keys)))
    iterate = backend.iteration(name)
    done, elapsed = len(records), seconds[-1] if seconds else 0.0
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
            if folder is not None and time.perf_counter() - saved > SAVE_SECONDS:
                save_checkpoint(folder, name, config, state, records, seconds)
                saved = last = time.perf_counter()
    collect(None)
    if folder is not None:
        save_checkpoint(folder, name, config, state, records, seconds)
    costs = [backend.cost(theta) for theta in state.theta]
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
        rollouts=_rollouts(name, config.samples, task.random_start),  # type: ignore[arg-type]
    )


def _rollouts(name: str, samples: int, random_start: bool) -> int:
    """Rollouts in one iteration of one seed: a pair is two, and each batch of order 0 has its baselines."""
    count = 0
    for oracle in ESTIMATORS[name].needs:
        baselines = samples if random_start else 1
        count += samples * (2 if "pair" in oracle else 1)
        count += baselines if ORACLES[oracle].order == 0 or oracle == "linearisation" else 0
    return count


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A run on disk."""

    arrays: dict[str, np.ndarray]

    def restored(self, like: Descent) -> tuple[Descent, list[Record], list[float]]:
        """State, records and seconds; `like` has the state's structure."""
        leaves, structure = jax.tree.flatten(like)
        state = structure.unflatten([jnp.asarray(self.arrays[f"state_{index}"]) for index in range(len(leaves))])
        columns = [self.arrays[f"history_{field.name}"] for field in dataclasses.fields(Record)]
        records = [Record(*map(jnp.asarray, row)) for row in zip(*columns, strict=True)]
        return state, records, list(map(float, self.arrays["seconds"]))


def _identity(config: OptimiseConfig) -> str:
    """What must not differ for a run to go on: all but how long it is, and which runs are beside it."""
    free = ("iterations", "estimators", "evaluation_samples", "chunk_size")
    plain = {name: value for name, value in dataclasses.asdict(config).items() if name not in free}
    return json.dumps(plain, sort_keys=True)


def checkpoint_path(folder: Path, name: str) -> Path:
    """Where a run of an estimator is kept."""
    return folder / f"run-{name}.npz"


def save_checkpoint(
    folder: Path, name: str, config: OptimiseConfig, state: Descent, records: list[Record], seconds: list[float]
) -> None:
    """Write a run so that it can go on; the file is either the old one or the new one, never half of one."""
    arrays = {f"state_{index}": np.asarray(leaf) for index, leaf in enumerate(jax.tree.leaves(state))}
    for field in dataclasses.fields(Record):
        column = np.array([getattr(record, field.name) for record in records])
        arrays[f"history_{field.name}"] = column.reshape(len(records), config.seeds)
    arrays |= {"seconds": np.array(seconds), "config": np.array(_identity(config))}
    arrays["digest"] = np.array(_digest(arrays))
    write_whole(checkpoint_path(folder, name), lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]


def load_checkpoint(folder: Path, name: str, config: OptimiseConfig) -> Checkpoint | None:
    """A run that can go on, or None where there is none.

    Raises:
        ValueError: the file is damaged, or of another configuration.
    """
    path = checkpoint_path(folder, name)
    if not path.exists():
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
        digest = str(arrays.pop("digest"))
    except Exception as error:  # numpy, zipfile and zlib raise what they like
        raise ValueError(f"{path} is damaged ({error}); move it away to start again") from error
    if digest != _digest(arrays):
        raise ValueError(f"{path} is damaged (its digest does not match); move it away to start again")
    theirs, ours = json.loads(str(arrays["config"])), json.loads(_identity(config))
    different = sorted(key for key in theirs | ours if theirs.get(key) != ours.get(key))
    if different:
        told = ", ".join(f"{key} {theirs.get(key)} there and {ours.get(key)} here" for key in different[:3])
        raise ValueError(f"{folder} holds another run ({told}); choose another folder")
    return Checkpoint(arrays)


def _digest(arrays: dict[str, np.ndarray]) -> str:
    sha = hashlib.sha256()
    for key in sorted(arrays):
        sha.update(key.encode() + str(arrays[key].dtype).encode() + np.ascontiguousarray(arrays[key]).tobytes())
    return sha.hexdigest()
