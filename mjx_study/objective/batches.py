"""Batches of samples on all devices: a task's compiled programs, and the `Objective` that estimators take."""

import dataclasses
import math
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from estimators import Differentiation, Evaluation, Linearisation, StepDifferentiation, StepEvaluation
from estimators.noise import check_sigma
from mjx_study.compiled import Builds, Compiled
from mjx_study.graph.scans import with_native_scans
from mjx_study.objective.chunks import spread
from mjx_study.objective.cost import simulate
from mjx_study.objective.programs import SamplePrograms
from mjx_study.runtime import local_devices
from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.onset import OnsetCounts
from mjx_study.tasks.task import Task

Theta = Float[Array, " params"]
Keys = Key[Array, " samples"]


def compiled_rollout(task: Task) -> Compiled:
    """Compile `simulate` for a task, as a function of (theta, contact, key, noise_scale)."""
    return Compiled(partial(simulate, task), "rollout", task)


@dataclasses.dataclass(frozen=True, eq=False)
class Simulator:
    """The compiled programs of a task.

    Attributes:
        task: the task to simulate; each call replaces its scene's contact parameters.
        chunk_size: samples per device and call; see `chunk_for`.
        devices: devices to spread samples over; by default those of `mjx_study.runtime.local_devices`.
    """

    task: Task
    chunk_size: int
    devices: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        if self.chunk_size < 1:
            raise ValueError(f"chunk_size must be at least 1 sample, got {self.chunk_size}")
        object.__setattr__(self, "devices", tuple(self.devices) or tuple(local_devices()))

    @cached_property
    def _programs(self) -> dict[str, Compiled]:
        return {
            name: Compiled(jax.vmap(with_native_scans(each), (None, None, None, 0, 0)), name, self.task)
            for name, each in SamplePrograms(self.task).by_name.items()
        }

    def objective(self, contact: ContactModel | None, sigma: float | None = None) -> "MjxObjective":
        """Return the objective for a contact model, with the task's noise level or another."""
        return MjxObjective(self, contact, self.task.sigma if sigma is None else sigma)

    def memory(self, kind: str, contact: ContactModel | None, samples: int) -> int:
        """XLA's planned temporary memory [bytes] for a batch of one kind, all chunks at once on all devices."""
        arguments = self._chunk(kind, self.task.theta, contact, 1.0)
        ready: Any = self._programs[kind].executable(*arguments)
        built = ready if isinstance(ready, jax.stages.Compiled) else ready.lower(*arguments).compile()
        plan: Any = built.memory_analysis()
        return plan.temp_size_in_bytes * samples // self.chunk_size

    def run(self, name: str, theta: Any, contact: ContactModel | None, sigma: Any, keys: Any, noise_scale: Any) -> Any:
        """Run one of `SamplePrograms` on samples, given the data of their keys and their noise factors; outputs as
        returned by `spread`. A ValueError if sigma or theta is invalid, or without samples."""
        check_sigma(sigma)
        if theta.shape != (self.task.policy.num_params,):
            raise ValueError(f"theta has shape {theta.shape}, the policy needs ({self.task.policy.num_params},)")
        if len(noise_scale) == 0:
            raise ValueError("there are no samples to run: give at least one key")
        shared = theta, _contact_for(name, contact), np.asarray(sigma, self.task.scene.template.qpos.dtype)
        return jax.block_until_ready(
            spread(self._programs[name], shared, (keys, noise_scale), self.chunk_size, self.devices)
        )

    def form(self, name: str, theta: Any, contact: ContactModel | None, sigma: Any) -> Any:
        """Shapes and types of a chunk's outputs of one of `SamplePrograms`, without running it.

        Those of gradients follow from those of values: what takes both can be compiled before gradients are traced.
        """
        if name in ("gradient", "corrected"):
            value, score, residual = self.form("value", theta, contact, sigma)
            corrected = name == "corrected" or self.task.onset != "none"
            shape = self.chunk_size, len(dataclasses.fields(OnsetCounts))
            return value, score, residual, jax.ShapeDtypeStruct(shape, float) if corrected else None
        arguments = self._chunk(name, theta, contact, sigma)
        return self._programs[name].outputs(*arguments, platform=self.devices[0].platform)

    def build(self, name: str, theta: Any, contact: ContactModel | None, sigma: Any, builds: Builds) -> None:
        """Trace one of `SamplePrograms` and begin to compile it, where all devices share one program."""
        if self.devices[0].platform == "cpu":
            builds.start(self._programs[name], *self._chunk(name, theta, contact, sigma))

    def _chunk(self, name: str, theta: Any, contact: ContactModel | None, sigma: Any) -> tuple[Any, ...]:
        """Program arguments for a chunk of identical samples, with the shapes of any chunk."""
        dtype = self.task.scene.template.qpos.dtype
        keys = np.zeros((self.chunk_size, 2), np.uint32)
        return theta, _contact_for(name, contact), np.asarray(sigma, dtype), keys, np.ones(self.chunk_size, dtype)


@dataclasses.dataclass(frozen=True)
class MjxObjective:
    """F(theta) = E V_1 of a task with a contact model; implements `estimators.Objective`.

    Attributes:
        simulator: the compiled programs, shared by all contact models of a sweep.
        contact: the contact model; None for the MJCF's own.
        sigma: standard deviation of the noise, in the unit of the quantity it is added to.
    """

    simulator: Simulator
    contact: ContactModel | None
    sigma: float | Float[Array, ""]

    @property
    def num_params(self) -> int:
        return self.simulator.task.policy.num_params

    def evaluate(self, theta: Theta, keys: Keys) -> Evaluation:
        """Evaluate values and scores by rollouts, without differentiating the dynamics.

        The baseline, the zero-noise rollout from the same initial state, runs as extra samples with noise scale 0: a
        single one if the initial state is fixed, otherwise one per sample.
        """
        (evaluation,) = self._evaluate(theta, keys, (1.0,))
        return evaluation

    def evaluate_odd(self, theta: Theta, keys: Keys) -> Evaluation:
        """Evaluate the part of the objective that is odd in the noise, (f(w) - f(-w)) / 2, with two rollouts per
        sample.

        Only the odd part correlates with the score of noise added to theta, so its gradient is the same; the even part,
        most of the variance of a zeroth-order sample, drops out.

        Raises:
            ValueError: the policy has feedback, so the score is not odd in the noise.
        """
        if not self.simulator.task.policy.additive:
            raise ValueError("the odd part of an objective needs a policy whose noise is added to theta")
        samples = len(keys)
        rows, scale = np.tile(np.arange(samples), 2), np.repeat([1.0, -1.0], samples)
        values, scores, residuals = self._run("value", theta, keys, rows, scale)
        with np.errstate(all="ignore"):  # lost samples are counted with the estimates
            odd = (values[:samples] - values[samples:]) / 2
            residual = _numpy_of(residuals).maximum(residuals[:samples], residuals[samples:])
        return Evaluation(*map(_placed, (odd, scores[:samples], np.zeros(samples, odd.dtype), residual)))

    def evaluate_pair(self, theta: Theta, keys: Keys) -> tuple[Evaluation, Evaluation]:
        """Evaluate pairs of samples with opposite noise, the same initial states and a shared baseline."""
        plus, minus = self._evaluate(theta, keys, (1.0, -1.0))
        return plus, minus

    def differentiate(self, theta: Theta, keys: Keys) -> Differentiation:
        """Return each sample's cost and its exact gradient with respect to theta."""
        return Differentiation(*jax.tree.map(_placed, self._run("gradient", theta, keys)))

    def evaluate_steps(self, theta: Theta, keys: Keys) -> StepEvaluation:
        (steps,) = self._evaluate_steps(theta, keys, (1.0,))
        return steps

    def evaluate_step_pair(self, theta: Theta, keys: Keys) -> tuple[StepEvaluation, StepEvaluation]:
        plus, minus = self._evaluate_steps(theta, keys, (1.0, -1.0))
        return plus, minus

    def differentiate_corrected(self, theta: Theta, keys: Keys) -> Differentiation:
        """`differentiate` with the task's onset term, or the linear one if the task has none."""
        return Differentiation(*jax.tree.map(_placed, self._run("corrected", theta, keys)))

    def differentiate_steps(self, theta: Theta, keys: Keys) -> StepDifferentiation:
        """Roll out as `differentiate`, with the derivative of each sample's cost with respect to its noise."""
        return StepDifferentiation(*jax.tree.map(_placed, self._run("step_gradient", theta, keys)))

    def linearise(self, theta: Theta, keys: Keys) -> Linearisation:
        """Roll out as `differentiate`, with the derivatives of every step.

        The state is (qpos, qvel, act), so a quaternion counts as four entries.
        """
        (to_go, scores, jacobian), residual, derivatives = self._run("linearisation", theta, keys)
        zero_noise = self._zero_noise_to_go(theta, keys)
        steps = StepEvaluation(*jax.tree.map(_placed, (to_go, zero_noise, scores, jacobian, residual)))
        return Linearisation(steps, *jax.tree.map(_placed, derivatives))

    def _evaluate(self, theta, keys, signs: tuple[float, ...]) -> list[Evaluation]:
        samples, zero_noise = len(keys), self._zero_noise_rows(len(keys))
        rows = np.append(np.tile(np.arange(samples), len(signs)), zero_noise)
        scale = np.append(np.repeat(signs, samples), np.zeros(len(zero_noise)))
        values, scores, residuals = self._run("value", theta, keys, rows, scale)
        baseline = _for_all(values[len(signs) * samples :], samples)
        return [
            Evaluation(value, score, _placed(baseline), residual)
            for value, score, residual in _in_turn((values, scores, residuals), samples, len(signs))
        ]

    def _evaluate_steps(self, theta, keys, signs: tuple[float, ...]) -> list[StepEvaluation]:
        samples = len(keys)
        rows, scale = np.tile(np.arange(samples), len(signs)), np.repeat(signs, samples)
        (to_go, scores, jacobian), residual = self._run("steps", theta, keys, rows, scale)
        zero_noise = _placed(self._zero_noise_to_go(theta, keys))
        return [
            StepEvaluation(part[0], zero_noise, *part[1:])
            for part in _in_turn((to_go, scores, jacobian, residual), samples, len(signs))
        ]

    def _zero_noise_rows(self, samples: int) -> np.ndarray:
        """Samples with a zero-noise rollout of their own: just one if all start in the same state."""
        return np.arange(samples if self.simulator.task.random_start else min(samples, 1))

    def _zero_noise_to_go(self, theta, keys):
        """Costs to go of the zero-noise rollouts, just one if all samples share it."""
        rows = self._zero_noise_rows(len(keys))
        (to_go, *_), _ = self._run("steps", theta, keys, rows, np.zeros(len(rows)))
        return _for_all(to_go, len(keys))

    def _run(self, name: str, theta, keys, rows=None, noise_scale=None):
        """Run a program on rows of the keys, by default each row once."""
        rows = np.arange(len(keys)) if rows is None else rows
        scale = np.ones(len(rows)) if noise_scale is None else noise_scale
        # Raw key data, since sharing noise among several rollouts is intended rather than reuse of a key.
        key_data = np.asarray(jax.random.key_data(keys))[rows]
        dtype = self.simulator.task.scene.template.qpos.dtype
        return self.simulator.run(name, theta, self.contact, self.sigma, key_data, scale.astype(dtype))


@dataclasses.dataclass(frozen=True)
class BlankObjective(MjxObjective):
    """An objective whose batches hold zeros: their shapes, without compiling the `programs` that they need."""

    programs: dict[str, None] = dataclasses.field(default_factory=dict)

    def build(self, builds: Builds) -> None:
        """Begin to compile `programs`, those begun before excepted."""
        for name in self.programs:
            self.simulator.build(name, self.simulator.task.theta, self.contact, self.sigma, builds)

    def _run(self, name: str, theta, keys, rows=None, noise_scale=None):
        self.programs[name] = None
        rows = np.arange(len(keys)) if rows is None else rows
        made = self.simulator.form(name, theta, self.contact, self.sigma)
        return jax.tree.map(lambda leaf: np.zeros((len(rows), *leaf.shape[1:]), leaf.dtype), made)


@dataclasses.dataclass(frozen=True)
class TracedObjective(MjxObjective):
    """An objective inside a larger compiled program on one device, without returning to the host between batch and
    estimate.

    Attributes:
        batched: whether the program batches the objective, whose programs are then traced anew in it.
        samples: number of the keys whose samples are computed; of others, those of whole chunks are zeros.
    """

    batched: bool = True
    samples: Int[Array, ""] | None = None

    def _run(self, name: str, theta, keys, rows=None, noise_scale=None):
        simulator = self.simulator
        rows = np.arange(len(keys)) if rows is None else rows
        dtype = simulator.task.scene.template.qpos.dtype
        scale = np.ones(len(rows), dtype) if noise_scale is None else np.asarray(noise_scale, dtype)
        chunk = simulator.chunk_size
        chunks = np.minimum(np.arange(math.ceil(len(rows) / chunk) * chunk), len(rows) - 1).reshape(-1, chunk)
        back: Any = slice(len(rows))
        if self.samples is not None:  # few chunks are to hold all rows of the first samples
            order = np.argsort(rows, stable=True)
            chunks, back = order[chunks], np.argsort(order)
        key_data, sigma = jax.random.key_data(keys), jnp.asarray(self.sigma, dtype)
        kept = simulator._programs[name]
        blank = simulator._chunk(name, theta, None, 1.0)[-2:]
        program = kept.jitted if self.batched else kept.within(theta, self.contact, sigma, *blank)

        def call(chunk):
            drawn, factor, *needed = chunk
            run = partial(program, theta, self.contact, sigma, drawn, factor)
            if not needed:
                return run()
            blank = lambda: jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(run))  # noqa: E731
            return jax.lax.cond(needed[0], run, blank)

        parts = key_data[rows[chunks]], jnp.asarray(scale[chunks])
        if self.samples is not None and len(chunks) > 1:
            parts += (jnp.asarray(rows[chunks].min(axis=1)) < self.samples,)
        if len(chunks) == 1:
            return jax.tree.map(lambda leaf: leaf[back], call(jax.tree.map(lambda part: part[0], parts)))
        outputs = jax.lax.map(call, parts)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[back], outputs)


def _in_turn(outputs: tuple[Any, ...], samples: int, count: int) -> list[tuple[Any, ...]]:
    """Split concatenated outputs into batches of one size; any further rows are dropped."""
    starts = range(0, count * samples, samples)
    return [jax.tree.map(lambda leaf, at=at: _placed(leaf[at : at + samples]), outputs) for at in starts]


def _placed(leaf: Any) -> Any:
    """An array of JAX's, without a program for its shape."""
    return jax.device_put(leaf) if isinstance(leaf, np.ndarray) else leaf


def _for_all(rows, samples: int):
    """Broadcast rows, one per sample or one for all; on the host, to avoid a compilation per size."""
    return _numpy_of(rows).broadcast_to(rows, (samples, *rows.shape[1:]))


def _numpy_of(array: Any) -> Any:
    return np if isinstance(array, np.ndarray) else jnp


def _contact_for(name: str, contact: ContactModel | None) -> ContactModel | None:
    """Drop a contact model's surrogate for programs without derivatives, so that one program serves all models."""
    if contact is None or name not in ("value", "steps"):
        return contact
    return dataclasses.replace(contact, backward=None)
