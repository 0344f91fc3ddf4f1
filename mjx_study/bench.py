"""What rollouts and gradients cost, against what one would use otherwise; rates and ratios of one run.

The rivals get the same batch, devices and precision:

- stock MJX: `jax.grad` through `mjx.step` with the one solver iteration that reverse mode allows (its gradient is then
  not that of the converged step);
- the C engine: centred `mjd_transitionFD` at every step and an adjoint sweep, one thread measured and multiplied by the
  number of devices, as if threads cost nothing.
"""

import copy
import dataclasses
import statistics
import time
from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from mjx_study._mjx import mjx
from mjx_study.contact import apply_contact, family_model
from mjx_study.dynamics import State
from mjx_study.gradcheck import apply_to_host
from mjx_study.objective import Simulator, chunk_for
from mjx_study.policy import OpenLoop
from mjx_study.runtime import environment
from mjx_study.study import Progress
from mjx_study.task import Task

REPEATS: Final = 5
ENGINE_SAMPLES: Final = 8
STIFFNESS: Final = 100.0  # [N/m]; speed hardly depends on it


@dataclasses.dataclass(frozen=True)
class BenchReport:
    """Seconds per sample, memory, and the ratios that follow.

    Attributes:
        task, samples, horizon: what was run.
        value_seconds: a zeroth-order sample, one rollout [s].
        gradient_seconds: a first-order sample, one rollout and its gradient [s].
        stock_gradient_seconds: a gradient through stock MJX with one solver iteration [s].
        engine_gradient_seconds: a gradient by the C engine's differences on as many threads [s].
        gradient_memory: temporary memory of all samples' gradients at once [MiB].
        environment: versions and machine.
    """

    task: str
    samples: int
    horizon: int
    value_seconds: float
    gradient_seconds: float
    stock_gradient_seconds: float
    engine_gradient_seconds: float
    gradient_memory: float
    environment: dict[str, Any]

    @property
    def ratios(self) -> dict[str, float]:
        """The figures that can be compared between machines."""
        return {
            "gradient_per_value": self.gradient_seconds / self.value_seconds,
            "speedup_over_stock": self.stock_gradient_seconds / self.gradient_seconds,
            "speedup_over_engine": self.engine_gradient_seconds / self.gradient_seconds,
        }

    def as_json(self) -> dict[str, Any]:
        """The report as plain data."""
        return dataclasses.asdict(self) | {"ratios": self.ratios}

    def lines(self) -> list[str]:
        """The report as text."""
        ratios = self.ratios
        devices = self.environment["devices"]

        def rate(label: str, seconds: float) -> str:
            return f"  {label:<46} {1e3 * seconds:8.3f} ms  {self.horizon / seconds / 1e6:8.3f} million steps/s"

        return [
            f"{self.task}: {self.samples} samples of {self.horizon} steps, {self.environment['precision']}, "
            f"{len(devices)} x {self.environment['backend']} ({self.environment['processor']})",
            "per sample:",
            rate("zeroth order (one rollout)", self.value_seconds),
            rate("first order (rollout and gradient)", self.gradient_seconds),
            rate("jax.grad through mjx.step, one iteration", self.stock_gradient_seconds),
            rate("C engine, mjd_transitionFD and adjoint", self.engine_gradient_seconds),
            "ratios of this run:",
            f"  a first-order sample costs {ratios['gradient_per_value']:.2f} zeroth-order samples",
            f"  gradients per second: {ratios['speedup_over_stock']:.2f} x stock mjx.step, "
            f"{ratios['speedup_over_engine']:.2f} x the C engine",
            f"  memory of {self.samples} gradients at once: {self.gradient_memory:.1f} MiB",
        ]


@dataclasses.dataclass(frozen=True)
class BenchPlan:
    """What to measure, checked."""

    task: Task
    samples: int


def plan_bench(task: Task, samples: int) -> BenchPlan:
    """Check what is to be measured.

    Raises:
        ValueError: fewer than one sample, or a task whose policy or coordinates the rivals cannot run.
    """
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    if not isinstance(task.policy, OpenLoop) or task.random_start or task.scene.host.nq != task.scene.host.nv:
        raise ValueError(f"bench compares open loops from a fixed start without quaternions, and {task.name} is none")
    return BenchPlan(task, samples)


def bench(plan: BenchPlan, progress: Progress = lambda done, total, what: None) -> BenchReport:
    """Measure everything once, ours and the rivals' interleaved."""
    task, samples = plan.task, plan.samples
    devices = jax.local_devices()
    contact = family_model("mujoco", task.scene, stiffness=STIFFNESS, effective_mass=task.effective_mass)
    keys = jax.random.split(jax.random.key(0), samples)
    simulator = Simulator(task, chunk_size=chunk_for(samples, devices))
    objective = simulator.objective(contact)

    progress(0, 4, "compiling")
    stock = _stock_gradients(task, contact, samples, devices)
    contenders: dict[str, Callable[[], Any]] = {
        "value": lambda: objective.evaluate(task.theta, keys),
        "gradient": lambda: objective.differentiate(task.theta, keys),
        "stock": stock,
    }
    for done, contender in enumerate(contenders.values()):
        progress(done, 4, "compiling")
        jax.block_until_ready(contender())
    times: dict[str, list[float]] = {name: [] for name in contenders}
    progress(3, 4, "measuring")
    for _ in range(REPEATS):
        for name, contender in contenders.items():
            times[name].append(_seconds(contender))
    engine = statistics.median(_seconds(lambda: _engine_gradient(task, contact)) for _ in range(ENGINE_SAMPLES))
    medians = {name: statistics.median(values) / samples for name, values in times.items()}
    progress(4, 4, "done")
    return BenchReport(
        task=task.name,
        samples=samples,
        horizon=task.horizon,
        value_seconds=medians["value"],
        gradient_seconds=medians["gradient"],
        stock_gradient_seconds=medians["stock"],
        engine_gradient_seconds=engine / len(devices),
        gradient_memory=simulator.gradient_memory(contact, samples) / 2**20,
        environment=environment(),
    )


def _seconds(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def _stock_gradients(task: Task, contact: Any, samples: int, devices: Any) -> Callable[[], Any]:
    """Gradients of the whole cost through `mjx.step`, sharded like ours."""
    scene = task.scene
    one = scene.model.replace(opt=scene.model.opt.replace(iterations=1))
    start = task.draw_start(jax.random.key(0))
    first = scene.template.replace(qpos=start.qpos, qvel=start.qvel)

    def cost(theta, contact):
        model = apply_contact(one, contact)

        def advance(data, control):
            state = State(data.qpos, data.qvel, data.act, data.qacc_warmstart)
            value = task.running_cost(state, control)
            return mjx.step(model, data.replace(ctrl=control)), value

        last, values = jax.lax.scan(advance, first, task.policy.feedforward(theta))
        return jnp.sum(values) + task.final_cost(State(last.qpos, last.qvel, last.act, last.qacc_warmstart))

    mesh = Mesh(np.array(devices), ("samples",))
    shared, split = PartitionSpec(), PartitionSpec("samples")
    gradients = jax.jit(
        jax.shard_map(
            jax.vmap(jax.grad(cost), in_axes=(0, None)),
            mesh=mesh,
            in_specs=(split, shared),
            out_specs=split,
            check_vma=False,
        )
    )
    padded = -(-samples // len(devices)) * len(devices)
    noise = np.random.default_rng(0).normal(scale=task.sigma, size=(padded, len(task.theta)))
    thetas = jnp.asarray(np.asarray(task.theta) + noise.astype(task.theta.dtype))
    return lambda: gradients(thetas, contact)


def _engine_start(task: Task, contact: Any) -> tuple[mujoco.MjModel, mujoco.MjData]:
    host = copy.copy(task.scene.host)
    apply_to_host(host, contact)
    data, start = mujoco.MjData(host), task.draw_start(jax.random.key(0))
    data.qpos[:], data.qvel[:] = np.asarray(start.qpos), np.asarray(start.qvel)
    return host, data


def _engine_gradient(task: Task, contact: Any) -> np.ndarray:
    """Gradient of the sum of the last state by the C engine: centred differences of each step, one adjoint sweep."""
    host, data = _engine_start(task, contact)
    controls = np.asarray(task.policy.feedforward(task.theta), float)
    size = 2 * host.nv + host.na
    over_state = np.zeros((task.horizon, size, size))
    over_control = np.zeros((task.horizon, size, host.nu))
    for index, control in enumerate(controls):
        data.ctrl[:] = control
        mujoco.mjd_transitionFD(host, data, 1e-6, True, over_state[index], over_control[index], None, None)
        mujoco.mj_step(host, data)
    adjoint, gradient = np.ones(size), np.empty(controls.shape)
    for index in reversed(range(task.horizon)):
        gradient[index] = adjoint @ over_control[index]
        adjoint = adjoint @ over_state[index]
    return gradient
