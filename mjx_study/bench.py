"""Benchmark rollouts and gradients against alternatives; rates, and ratios within one run.

The baselines use the same policy, initial states, noise, devices and precision, and are left out for contact laws other
than MuJoCo's, which they lack:

- stock MJX: `jax.grad` through `mjx.step` with a single solver iteration, all that reverse mode allows (so its gradient
  is not that of the converged step), in batches that fit in memory, on as many threads as are fastest;
- the C engine's rollouts: `mujoco.rollout`, open loop, in float64, on as many threads as there are devices or cores;
- the C engine's gradients: centred `mjd_transitionFD` at every step and an adjoint sweep, measured on one thread and
  scaled by the number of devices, as if threading were free; not with quaternions or RK4, which it cannot
  differentiate.
"""

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from estimators import FirstOrder, ZerothOrder
from mjx_study.compiled import Compiled
from mjx_study.experiment.memory import check_memory
from mjx_study.graph.native import native_summary
from mjx_study.objective import Simulator, chunk_for, simulate, spread
from mjx_study.objective.cost import drawn
from mjx_study.progress import Progress, silent
from mjx_study.runtime import environment, local_devices
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import ContactModel, apply_contact, has_mujoco_law
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.engine import engine_model
from mjx_study.simulation.linear_algebra import MOST_UNROLLED
from mjx_study.tasks.contact_grid import ContactPoint, family_grid
from mjx_study.tasks.soundness import check_soundness
from mjx_study.tasks.task import Task

REPEATS: Final = 5
LONG: Final = 10.0
"""Time of a call beyond which it is measured once [s]."""
ENGINE_SAMPLES: Final = 5
STOCK_BATCH: Final = {"cpu": 125, "gpu": 32768, "tpu": 32768}
"""Maximum batch per device for stock MJX, whose gradients store every intermediate of every step."""
LARGE_BATCH: Final = STOCK_BATCH | {"cpu": 8}
"""The same above `MOST_UNROLLED` degrees of freedom, where a step of stock MJX takes tens of milliseconds on a CPU."""


TIMED: Final = {
    "value": "zeroth order (rollout and baseline)",
    "gradient": "first order (rollout and gradient)",
    "rollout": "a rollout",
    "stock_value": "a rollout through mjx.step",  # with the same solver budget
    "engine_value": "a rollout by the C engine, mujoco.rollout",
    "stock_gradient": "jax.grad through mjx.step, one iteration",
    "engine_gradient": "C engine, mjd_transitionFD and adjoint",
    "onset_base": "first order, MuJoCo's default contact",
    "onset": "first order with the onset term, same contact",
}
"""What is timed, per sample."""
RATIOS: Final = {
    "gradient_per_value": ("gradient", "value"),
    "rollouts_over_stock": ("stock_value", "rollout"),
    "rollouts_over_engine": ("engine_value", "rollout"),
    "speedup_over_stock": ("stock_gradient", "gradient"),
    "speedup_over_engine": ("engine_gradient", "gradient"),
    "onset_per_gradient": ("onset", "onset_base"),
}
"""Ratios of times, comparable between machines."""


@dataclasses.dataclass(frozen=True)
class BenchReport:
    """Seconds per sample of what `TIMED` names and applies, and temporary memory of all samples' rollouts, or
    gradients, at once [MiB]."""

    task: str
    samples: int
    horizon: int
    contact: str
    seconds: dict[str, float]
    value_memory: float
    gradient_memory: float
    environment: dict[str, Any]

    @property
    def ratios(self) -> dict[str, float]:
        seconds = self.seconds
        return {name: seconds[one] / seconds[other] for name, (one, other) in RATIOS.items() if one in seconds}

    def as_json(self) -> dict[str, Any]:
        fields = {name: value for name, value in vars(self).items() if name != "seconds"}
        return fields | {f"{name}_seconds": self.seconds.get(name) for name in TIMED} | {"ratios": self.ratios}

    def lines(self) -> list[str]:
        ratios, machine = self.ratios, self.environment
        device = machine["processor"] if machine["backend"] == "cpu" else machine["device_kind"]
        rates = {name: self.horizon / seconds / 1e6 for name, seconds in self.seconds.items()}
        engine = f", {ratios['speedup_over_engine']:.2f} x the C engine" if "speedup_over_engine" in ratios else ""
        onset = ratios.get("onset_per_gradient")
        against = [
            "  mjx.step and the C engine have MuJoCo's law and are left out: they would simulate another contact"
        ]
        if "rollouts_over_stock" in ratios:
            against = [
                f"  rollouts per second: {ratios['rollouts_over_stock']:.2f} x stock mjx.step, "
                f"{ratios['rollouts_over_engine']:.2f} x the C engine",
                f"  gradients per second: {ratios['speedup_over_stock']:.2f} x stock mjx.step{engine}",
            ]
        return [
            f"{self.task}: {self.samples} samples of {self.horizon} steps, {self.contact}, "
            f"{machine['precision']}, {len(machine['devices'])} x {machine['backend']} ({device})",
            f"native code: {machine['native']}",
            "per sample:",
            *(
                f"  {label:<46} {1e3 * self.seconds[name]:8.3f} ms  {rates[name]:8.3f} million steps/s"
                for name, label in TIMED.items()
                if name in rates
            ),
            "ratios of this run:",
            f"  a first-order sample costs {ratios['gradient_per_value']:.2f} zeroth-order samples",
            *([] if onset is None else [f"  the onset term makes it {onset:.2f} times as expensive"]),
            *against,
            f"  memory of {self.samples} rollouts at once: {self.value_memory:.1f} MiB, "
            f"of their gradients: {self.gradient_memory:.1f} MiB",
        ]


def check_bench(task: Task, samples: int) -> None:
    """Raise ValueError for fewer than one sample, more than fit into memory, or a task that cannot be simulated."""
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    check_soundness(task)
    check_memory(task, (ZerothOrder(), FirstOrder()), samples)


def run_bench(task: Task, samples: int, cell: ContactPoint, progress: Progress = silent, seed: int = 0) -> BenchReport:
    """Measure everything in a contact, interleaved with the baselines; report medians of repeats."""
    devices = local_devices()
    keys = jax.random.split(jax.random.key(seed), samples)
    simulator = Simulator(task, chunk_size=chunk_for(-(-samples // len(devices)), devices[:1], [task]))
    objective = simulator.objective(cell.contact)
    full = -(-samples // (simulator.chunk_size * len(devices))) * simulator.chunk_size * len(devices)
    key_data = np.resize(jax.random.key_data(keys), (full, 2))  # avoids padded chunks, as in stock
    noisy = np.ones(full, task.scene.template.qpos.dtype)
    contenders: dict[str, tuple[int, Callable[[], Any]]] = {
        "value": (samples, lambda: objective.evaluate(task.theta, keys)),
        "gradient": (samples, lambda: objective.differentiate(task.theta, keys)),
        "rollout": (full, lambda: simulator.run("value", task.theta, cell.contact, task.sigma, key_data, noisy)),
    }
    comparable = has_mujoco_law(cell.contact)
    if comparable:
        progress(0, 1, f"{task.name}: compiling stock")
        most = LARGE_BATCH if task.scene.host.nv > MOST_UNROLLED else STOCK_BATCH
        count = min(samples, most[devices[0].platform] * len(devices))
        count, stock_value, stock_gradient = _fitting_stock(task, cell.contact, keys, count, devices)
        contenders |= {
            "stock_value": (count, stock_value),
            "stock_gradient": (count, stock_gradient),
            "engine_value": engine_rollouts(task, cell.contact, keys[: STOCK_BATCH["cpu"]], len(devices)),
        }
    if task.contact_pair is not None:  # MuJoCo's default contact, whose force jumps at the onset
        (jumping,), _ = family_grid(task, ["mujoco_default"])
        default = simulator.objective(jumping.contact)
        contenders["onset_base"] = samples, lambda: default.differentiate(task.theta, keys)
        contenders["onset"] = samples, lambda: default.differentiate_corrected(task.theta, keys)
    total = 2 * len(contenders)
    for done, (name, (_, call)) in enumerate(contenders.items()):
        progress(done, total, f"{task.name}: compiling {name.replace('_', ' ')}")
        jax.block_until_ready(call())
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for repeat in range(REPEATS):
        progress(len(contenders) + min(repeat, len(contenders) - 1), total, f"{task.name}: measuring")
        for name, (count, call) in contenders.items():
            if repeat and times[name][0] * count > LONG:
                continue
            times[name].append(_seconds(call) / count)
    seconds = {name: statistics.median(values) for name, values in times.items()}
    if comparable and (engine := _engine_seconds(task, cell.contact)) is not None:
        seconds["engine_gradient"] = engine / len(devices)
    progress(total, total, "done")
    return BenchReport(
        task=task.name,
        samples=samples,
        horizon=task.horizon,
        contact=cell.label,
        seconds=seconds,
        value_memory=simulator.memory("value", cell.contact, samples) / 2**20,
        gradient_memory=simulator.memory("gradient", cell.contact, samples) / 2**20,
        environment=environment() | {"native": native_summary()},
    )


def _seconds(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def _fitting_stock(task: Task, contact: ContactModel | None, keys: Any, samples: int, devices: Any):
    """Largest batch, by halving, whose gradients through `mjx.step` fit in memory, with the programs."""
    while True:
        value, gradient = stock_programs(task, contact, keys[:samples], devices)
        try:
            jax.block_until_ready(gradient(devices))
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error) or samples <= len(devices):
                raise
            samples //= 2
        else:
            return samples, *(_on_fastest(call, devices) for call in (value, gradient))


def _on_fastest(call: Callable[[Any], Any], devices: Sequence[Any]) -> Callable[[], Any]:
    """A call on those numbers of threads that is fastest on a CPU, of all, a quarter and so on: stock MJX's hinder each
    other from some number on."""
    choices = [devices]
    while len(choices[-1]) > 1 and devices[0].platform == "cpu":
        choices.append(devices[: max(1, len(choices[-1]) // 4)])
    jax.block_until_ready(call(devices))
    fastest = min(choices, key=lambda some: _seconds(lambda: call(some)))
    return lambda: call(fastest)


def stock_programs(
    task: Task, contact: ContactModel | None, keys: Any, devices: Sequence[Any]
) -> tuple[Callable[[Any], Any], ...]:
    """Programs for costs and gradients of the same samples through `mjx.step`, split into as many calls as there are
    devices, and made on those given."""
    scene, policy = task.scene, task.policy

    def cost(theta, contact, key_data, iterations: int):
        model = scene.model.replace(opt=scene.model.opt.replace(iterations=iterations))
        model = apply_contact(model, contact)
        running_cost, final_cost = task.costs(contact)
        start, noise = drawn(task, jax.random.wrap_key_data(key_data), task.sigma, 1.0)
        start = policy.place(theta, noise, start)

        def advance(data, feedforward):
            state = State(data.qpos, data.qvel, data.act, data.qacc_warmstart)
            feedback = policy.feedback(theta, state)
            control = feedforward if feedback is None else feedforward + feedback
            return mjx.step(model, data.replace(ctrl=control)), running_cost(state, control)

        first = scene.template.replace(qpos=start.qpos, qvel=start.qvel, act=start.act)
        last, values = jax.lax.scan(advance, first, policy.feedforward(theta, noise))
        return jnp.sum(values) + final_cost(State(last.qpos, last.qvel, last.act, last.qacc_warmstart))

    def stock_rollouts(theta, contact, key):
        return cost(theta, contact, key, int(scene.host.opt.iterations))

    def stock_gradients(theta, contact, key):
        return jax.grad(cost)(theta, contact, key, 1)

    values, gradients = (Compiled(jax.vmap(each, (None, None, 0))) for each in (stock_rollouts, stock_gradients))
    shared, rows = (task.theta, contact), (np.asarray(jax.random.key_data(keys)),)
    chunk = -(-len(keys) // len(devices))
    return tuple(partial(spread, run, shared, rows, chunk) for run in (values, gradients))


def _engine_seconds(task: Task, contact: ContactModel | None) -> float | None:
    """Median time of a gradient by the C engine [s]; None if its differences are unsupported."""
    host = task.scene.host
    if host.nq != host.nv or host.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return None
    key = jax.random.key(0)
    states, controls, *_ = jax.jit(lambda theta, contact: simulate(task, theta, contact, key, 1.0))(task.theta, contact)
    start = (np.asarray(states.qpos[0], float), np.asarray(states.qvel[0], float))
    played = np.asarray(controls, float)
    gradient = lambda: gradient_of_engine(engine_model(task.scene, contact), start, played)  # noqa: E731
    times = [_seconds(gradient) for _ in range(ENGINE_SAMPLES)]
    return statistics.median(times)


def engine_rollouts(
    task: Task, contact: ContactModel | None, keys: jax.Array, threads: int
) -> tuple[int, Callable[[], np.ndarray]]:
    """Prepare rollouts by the C engine, and return their number and a function that runs them and returns states
    `(rollouts, horizon, state)`, laid out as `mujoco.mjtState.mjSTATE_FULLPHYSICS`.

    Their starts and controls are recorded from this project's rollouts, so feedback costs the engine nothing.
    """
    host = engine_model(task.scene, contact)
    simulated = jax.vmap(lambda key: simulate(task, task.theta, contact, key, 1.0)[:2])
    states, controls = jax.jit(simulated)(keys)
    data = [mujoco.MjData(host) for _ in range(threads)]
    state = mujoco.mjtState.mjSTATE_FULLPHYSICS
    starts = np.empty((len(keys), mujoco.mj_stateSize(host, state)))
    for row, qpos, qvel, act in zip(starts, states.qpos[:, 0], states.qvel[:, 0], states.act[:, 0], strict=True):
        data[0].qpos[:], data[0].qvel[:], data[0].act[:] = qpos, qvel, act
        mujoco.mj_getState(host, data[0], row, state)
    played = np.asarray(controls, float)
    return len(keys), lambda: rollout.rollout(host, data, starts, played, nstep=task.horizon, persistent_pool=True)[0]


def gradient_of_engine(
    host: mujoco.MjModel, start: tuple[np.ndarray, np.ndarray], controls: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of the final state's sum over initial state and controls, by centred differences of each of the C
    engine's steps and one adjoint sweep."""
    data = mujoco.MjData(host)
    data.qpos[:], data.qvel[:] = start
    size = 2 * host.nv + host.na
    over_state = np.zeros((len(controls), size, size))
    over_control = np.zeros((len(controls), size, host.nu))
    for index, control in enumerate(controls):
        data.ctrl[:] = control
        over = over_control[index] if host.nu else None
        mujoco.mjd_transitionFD(host, data, 1e-6, True, over_state[index], over, None, None)
        mujoco.mj_step(host, data)
    adjoint, gradient = np.ones(size), np.empty(controls.shape)
    for index in reversed(range(len(controls))):
        gradient[index] = adjoint @ over_control[index]
        adjoint = adjoint @ over_state[index]
    return adjoint, gradient
