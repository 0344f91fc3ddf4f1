"""(Task, ContactModel) -> the Objective that estimators see.

Batching, chunks and devices live here and nowhere else. A `Simulator` holds the two compiled programs of a task, one
that evaluates and one that differentiates; contact parameters, theta, sigma and keys are arguments, so a sweep over
them compiles nothing new. Samples are spread over the devices with `jax.shard_map`, where each device leaves the
solver's loop on its own, in chunks of fixed size that bound memory.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Key

from estimators import Differentiation, Evaluation
from mjx_study.contact import ContactModel, apply_contact
from mjx_study.dynamics import State, rollout
from mjx_study.noise import split_sample_key, standard_noise
from mjx_study.task import Task, check_sigma

MAX_CHUNK: Final = {"cpu": 512, "gpu": 2**15 + 1, "tpu": 2**15 + 1}
"""Most samples per device in one call, by backend: a CPU gains nothing from larger batches, an accelerator needs them;
and this bounds memory (about 40 kB for each gradient of 200 steps of a two-joint model). One more than a power of two,
for the baseline."""


def rollout_cost(
    task: Task,
    theta: Float[Array, " params"],
    contact: ContactModel | None,
    start: State,
    noise: Float[Array, "steps dimensions"],
) -> tuple[Float[Array, ""], tuple[State, Float[Array, "horizon nu"], Float[Array, ""]]]:
    """Total cost V_1 of one rollout, a pure function of everything that may be traced or differentiated.

    Args:
        task: what is simulated.
        theta: parameters of its policy.
        contact: the contact model; None for the MJCF's own.
        start: the start state, before the policy acts on it.
        noise: of the policy's `noise_shape`.

    Returns:
        The cost; and the states `(horizon + 1, ...)` with the start first, the controls, and the largest relative
        solver residual.
    """
    feedforward = task.policy.feedforward(theta, noise)

    def control_law(index, state):
        feedback = task.policy.feedback(theta, state)
        return feedforward[index] if feedback is None else feedforward[index] + feedback

    model = apply_contact(task.scene.model, contact)
    first = task.policy.place(theta, noise, start)
    states, controls, residuals = rollout(task.scene, model, first, control_law, task.horizon)
    last = jax.tree.map(lambda leaf: leaf[-1], states)
    cost = jnp.sum(jax.vmap(task.running_cost)(_before_each_step(states), controls)) + task.final_cost(last)
    return cost, (states, controls, jnp.max(residuals))


def simulate(
    task: Task,
    theta: Float[Array, " params"],
    contact: ContactModel | None,
    key: Key[Array, ""],
    noise_scale: float | Float[Array, ""],
) -> tuple[State, Float[Array, "horizon nu"], Float[Array, ""], Float[Array, ""]]:
    """One sample's rollout: its states with the start first, controls, cost and largest solver residual.

    Args:
        task: what is simulated.
        theta: parameters of its policy.
        contact: the contact model; None for the MJCF's own.
        key: of the sample; draws start and noise as in a batch.
        noise_scale: factor on the noise; 0 for a rollout without.
    """
    start_key, noise_key = split_sample_key(key)
    noise = noise_scale * task.sigma * standard_noise(noise_key, task.policy.noise_shape, theta.dtype)
    cost, (states, controls, residual) = rollout_cost(task, theta, contact, task.draw_start(start_key), noise)
    return states, controls, cost, residual


def _before_each_step(states: State) -> State:
    return jax.tree.map(lambda leaf: leaf[:-1], states)


@dataclasses.dataclass(frozen=True, eq=False)
class Simulator:
    """The compiled programs of a task.

    Attributes:
        task: what is simulated; its scene's contact parameters are replaced by those of each call.
        chunk_size: samples per device and call; `chunk_for` chooses one.
        devices: where samples are spread; by default all local devices.
    """

    task: Task
    chunk_size: int
    devices: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        if self.chunk_size < 1:
            raise ValueError(f"chunk_size must be at least 1 sample, got {self.chunk_size}")
        devices = tuple(self.devices) or tuple(jax.local_devices())
        object.__setattr__(self, "devices", devices)
        for name, program in (("_values", self._sample_value), ("_gradients", self._sample_gradient)):
            object.__setattr__(self, name, self._compile(program, devices))

    def objective(self, contact: ContactModel | None, sigma: float | None = None) -> "MjxObjective":
        """Bind a contact model, and a noise level other than the task's."""
        return MjxObjective(self, contact, self.task.sigma if sigma is None else sigma)

    @property
    def num_compilations(self) -> int:
        """How many programs this simulator has compiled so far."""
        return sum(program._cache_size() for program in (self._values, self._gradients))  # type: ignore[attr-defined]

    def gradient_memory(self, contact: ContactModel | None, samples: int) -> int:
        """Temporary memory of the gradients of a batch, all chunks at once on all devices [bytes], as XLA plans it."""
        capacity = self.chunk_size * len(self.devices)
        dtype = self.task.scene.template.qpos.dtype
        keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(0), capacity)))
        arguments = (self.task.theta, contact, np.asarray(1.0, dtype), keys, np.ones(capacity, dtype))
        plan = self._gradients.lower(*arguments).compile().memory_analysis()  # type: ignore[attr-defined]
        return plan.temp_size_in_bytes * len(self.devices) * samples // capacity

    def _compile(self, program, devices: tuple[Any, ...]):
        mesh = Mesh(np.array(devices), ("samples",))
        shared, split = PartitionSpec(), PartitionSpec("samples")
        batched = jax.vmap(program, in_axes=(None, None, None, 0, 0))
        return jax.jit(
            jax.shard_map(
                batched,
                mesh=mesh,
                in_specs=(shared, shared, shared, split, split),
                out_specs=split,
                check_vma=False,
            )
        )

    def _cost(self, theta, contact, sigma, key_data, noise_scale) -> tuple[Array, tuple[State, Array, Array]]:
        """Cost of one rollout, and its states, noise and largest solver residual."""
        task = self.task
        start_key, noise_key = split_sample_key(jax.random.wrap_key_data(key_data))
        dtype = task.scene.template.qpos.dtype
        noise = noise_scale * sigma * standard_noise(noise_key, task.policy.noise_shape, dtype)
        cost, (states, _, residual) = rollout_cost(task, theta, contact, task.draw_start(start_key), noise)
        return cost, (states, noise, residual)

    def _sample_value(self, theta, contact, sigma, key_data, noise_scale):
        value, (states, noise, residual) = self._cost(theta, contact, sigma, key_data, noise_scale)
        score = self.task.policy.score(theta, _before_each_step(states), noise / sigma**2)
        return value, score, residual

    def _sample_gradient(self, theta, contact, sigma, key_data, noise_scale):
        (value, (_, _, residual)), gradient = jax.value_and_grad(self._cost, has_aux=True)(
            theta, contact, sigma, key_data, noise_scale
        )
        return value, gradient, residual

    def _run(self, program, theta, contact, sigma, keys, noise_scale):
        """Call a program chunk by chunk; the last chunk is padded by repeating its last sample."""
        check_sigma(sigma)
        if theta.shape != (self.task.policy.num_params,):
            raise ValueError(f"theta has shape {theta.shape}, the policy needs ({self.task.policy.num_params},)")
        if len(noise_scale) == 0:
            raise ValueError("there is no sample to run: give at least one key")
        dtype = self.task.scene.template.qpos.dtype
        samples, capacity = len(noise_scale), self.chunk_size * len(self.devices)
        padded = np.minimum(np.arange(math.ceil(samples / capacity) * capacity), samples - 1)
        outputs = [
            program(theta, contact, np.asarray(sigma, dtype), keys[part], noise_scale[part])
            for part in padded.reshape(-1, capacity)
        ]
        host = jax.device_get(outputs)
        return [np.concatenate(leaves)[:samples] for leaves in zip(*host, strict=True)]

    def run_values(self, theta, contact, sigma, key_data, noise_scale):
        """Values, scores and residuals of samples, each with its key's data and a factor on its noise; NumPy arrays."""
        return self._run(self._values, theta, contact, sigma, key_data, noise_scale)  # type: ignore[attr-defined]

    def run_gradients(self, theta, contact, sigma, key_data):
        """Values, gradients and residuals of samples, each with its key's data; NumPy arrays."""
        scale = np.ones(len(key_data), self.task.scene.template.qpos.dtype)
        return self._run(self._gradients, theta, contact, sigma, key_data, scale)  # type: ignore[attr-defined]


@dataclasses.dataclass(frozen=True)
class MjxObjective:
    """F(theta) = E V_1 of a task under one contact model; implements `estimators.Objective`.

    Attributes:
        simulator: the compiled programs, shared by all contact models of a sweep.
        contact: the contact model; None for the MJCF's own.
        sigma: standard deviation of the noise, in the unit of what it is added to.
    """

    simulator: Simulator
    contact: ContactModel | None
    sigma: float

    @property
    def num_params(self) -> int:
        """Length of theta."""
        return self.simulator.task.policy.num_params

    def evaluate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Evaluation:
        """Values and scores by rollouts alone; the dynamics are not differentiated.

        The baseline, the zero-noise rollout from the same start, rides along as samples whose noise is scaled by 0: one
        for all where the start is fixed, otherwise one each.
        """
        samples = len(keys)
        silent = np.arange(samples if self.simulator.task.random_start else min(samples, 1))
        scale = np.concatenate([np.ones(samples), np.zeros(len(silent))])
        values, scores, residuals = self._values(theta, keys, np.append(np.arange(samples), silent), scale)
        baseline = np.broadcast_to(values[samples:], samples)
        return Evaluation(*map(jnp.asarray, (values[:samples], scores[:samples], baseline, residuals[:samples])))

    def evaluate_odd(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Evaluation:
        """The part of the objective that is odd in the noise, (f(w) - f(-w)) / 2, by two rollouts per sample.

        Only the odd part correlates with the score of noise that is added to theta, so it has the same gradient; the
        even part, most of the variance of a zeroth-order sample, is gone.

        Raises:
            ValueError: the policy has feedback; then the score is not odd in the noise.
        """
        if not self.simulator.task.policy.additive:
            raise ValueError("the odd part of an objective needs a policy whose noise is added to theta")
        samples = len(keys)
        scale = np.repeat([1.0, -1.0], samples)
        values, scores, residuals = self._values(theta, keys, np.tile(np.arange(samples), 2), scale)
        odd = (values[:samples] - values[samples:]) / 2
        residual = np.maximum(residuals[:samples], residuals[samples:])
        return Evaluation(*map(jnp.asarray, (odd, scores[:samples], np.zeros_like(odd), residual)))

    def evaluate_pair(
        self, theta: Float[Array, " params"], keys: Key[Array, " samples"]
    ) -> tuple[Evaluation, Evaluation]:
        """Two evaluations whose noises are opposite, sample by sample, from the same starts; three rollouts each."""
        samples = len(keys)
        scale = np.repeat([1.0, -1.0, 0.0], samples)
        values, scores, residuals = self._values(theta, keys, np.tile(np.arange(samples), 3), scale)
        above, below = slice(samples), slice(samples, 2 * samples)
        silent = jnp.asarray(values[2 * samples :])
        plus, minus = (
            Evaluation(*map(jnp.asarray, (values[part], scores[part], silent, residuals[part])))
            for part in (above, below)
        )
        return plus, minus

    def differentiate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Differentiation:
        """Values and exact gradients of each sample's cost with respect to theta."""
        key_data = np.asarray(jax.random.key_data(keys))
        outputs = self.simulator.run_gradients(theta, self.contact, self.sigma, key_data)
        return Differentiation(*map(jnp.asarray, outputs))

    def _values(self, theta, keys, rows, noise_scale):
        # Rows of the bare key data: one noise is drawn on purpose for several rollouts, which is no reuse of a key.
        key_data = np.asarray(jax.random.key_data(keys))[rows]
        scale = noise_scale.astype(self.simulator.task.scene.template.qpos.dtype)
        return self.simulator.run_values(theta, self.contact, self.sigma, key_data, scale)


def chunk_for(samples: int, devices: Sequence[Any]) -> int:
    """The chunk size that runs `samples` and their baseline in the fewest, evenly filled calls on these devices."""
    per_device, most = math.ceil((samples + 1) / len(devices)), MAX_CHUNK[devices[0].platform]
    return math.ceil(per_device / math.ceil(per_device / most))
