"""(Task, ContactModel) -> the Objective that estimators see.

Batching, chunks and devices are handled here and nowhere else. A `Simulator` holds the compiled programs of a task, one
for each kind of batch that estimators ask for; contact parameters, theta, sigma and keys are arguments, so a sweep over
them compiles nothing new. Samples run in chunks of fixed size that bound memory, on all devices at once: a chunk is one
call of a program for one device, so that each device leaves the solver's loop independently. What a chunk holds does
not depend on the devices, and neither does a bit of the result.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from estimators import Differentiation, Evaluation, Linearisation, StepDifferentiation, StepEvaluation
from mjx_study.compiled import Compiled
from mjx_study.reference.noise import noise_score, split_sample_key, standard_noise
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.branches import jump_term
from mjx_study.simulation.contact import ContactModel, apply_contact
from mjx_study.simulation.dynamics import State, rollout, step
from mjx_study.simulation.linear_algebra import SMALL
from mjx_study.simulation.onset import SLOTS, OnsetCounts, as_row, corrected_rollout, without_derivative
from mjx_study.stopwatch import timed
from mjx_study.tasks.task import Task, check_sigma

MAX_CHUNK: Final = {"cpu": 256, "gpu": 2**17 + 1, "tpu": 2**17 + 1}
"""Largest number of samples per device and call, by backend: a CPU gains little from larger batches, an accelerator
needs them. One more than a power of two, for the baseline."""
SHARE: Final = 0.25
"""Most of an accelerator's memory that the gradients of a chunk take."""

LAPACK_BATCH: Final = 2048
"""Batch from which jaxlib 0.10.2 divides factorisations of matrices among its threads on CPUs, which never ends where
two programs do so at a time. Matrices of up to `SMALL` rows do not go to LAPACK."""


def spread(program: Compiled, shared: Any, rows: Sequence[np.ndarray], chunk: int, devices: Sequence[Any]) -> Any:
    """Call a compiled program on chunks of rows, on all devices at once.

    On CPUs all chunks run on the first device, called from as many threads as there are devices: those calls run side
    by side, and one compilation serves all cores. (JAX 0.11 crashes as it compiles MJX under `shard_map` or `pmap`.)

    Args:
        program: of the shared arguments and one chunk of each array of rows.
        rows: arrays of one length.
        chunk: rows in a call; the last chunk is padded by repeating the last row.
        devices: of this process.

    Returns:
        The program's outputs, which have a leading axis of rows: NumPy arrays, or on accelerators arrays of the first.
    """
    on_host = devices[0].platform == "cpu"
    fetched, join = (jax.device_get, np) if on_host else (partial(jax.device_put, device=devices[0]), jnp)
    devices = [devices[0]] * len(devices) if on_host else devices
    count = len(rows[0])
    chunks = np.minimum(np.arange(math.ceil(count / chunk) * chunk), count - 1).reshape(-1, chunk)
    devices, outputs = devices[: len(chunks)], [None] * len(chunks)
    placed = {device: jax.device_put(shared, device) for device in devices}

    def call(device: Any, part: np.ndarray) -> Any:
        return run(*placed[device], *jax.device_put(tuple(array[part] for array in rows), device))

    # Traced in this thread, because tracing patches MJX for the whole process.
    run = program.prepare(*placed[devices[0]], *(array[chunks[0]] for array in rows), platform=devices[0].platform)
    left = iter(range(len(chunks)))

    def work(device: Any) -> None:
        for index in left:
            outputs[index] = fetched(call(device, chunks[index]))

    with ThreadPoolExecutor(len(devices)) as pool:
        for worker in [pool.submit(work, device) for device in devices]:
            worker.result()
    return jax.tree.map(lambda *leaves: join.concatenate(leaves)[:count], *outputs)


def rollout_cost(
    task: Task,
    theta: Float[Array, " params"],
    contact: ContactModel | None,
    start: State,
    noise: Float[Array, "steps dimensions"],
    onset: str = "none",
    weight: float | Float[Array, ""] = 1.0,
) -> tuple[Float[Array, ""], tuple[State, Float[Array, "horizon nu"], Float[Array, ""], OnsetCounts | None]]:
    """Total cost V_1 of one rollout, a pure function of everything that may be traced or differentiated.

    Args:
        contact: the contact model; None for the MJCF's own.
        start: the initial state, before the policy acts on it.
        noise: noise of the policy's `noise_shape`.
        onset: "none", or "linear" or "jump" for a derivative with the onset term (see `mjx_study.simulation.onset` and
            `mjx_study.simulation.branches`).
        weight: factor on the linear onset term; 0 for a derivative without it.

    Returns:
        The cost; and the states `(horizon + 1, ...)` including the initial one, the controls, the largest relative
        solver residual, and the counts of onsets (None without the onset term).
    """
    feedforward = task.policy.feedforward(theta, noise)

    def control_law(index, state, theta=theta, feedforward=feedforward):
        feedback = task.policy.feedback(theta, state)
        return feedforward[index] if feedback is None else feedforward[index] + feedback

    model = apply_contact(task.scene.model, contact)
    backward = _backward(task, contact)
    if backward is not None and onset != "none":
        raise ValueError("the onset term is of exact derivatives: leave onset out, or the contact's backward model")
    first = task.policy.place(theta, noise, start)
    simulated, counts, term = (task.scene, model, first, control_law, task.horizon), None, 0.0
    if onset == "linear":
        states, controls, residuals, counts = corrected_rollout(*simulated, weight=weight)
    else:
        states, controls, residuals = rollout(*simulated, backward)
    if onset == "jump":
        fixed = jax.lax.stop_gradient((theta, feedforward))
        law = lambda index, state: control_law(index, state, *fixed)  # noqa: E731
        costs = task.running_cost, task.final_cost
        term, counts = jump_term(task.scene, without_derivative(model), states, controls, law, *costs)
    cost = jnp.sum(jax.vmap(task.running_cost)(_before_each_step(states), controls)) + task.final_cost(_last(states))
    return cost + term, (states, controls, jnp.max(residuals), counts)


def _backward(task: Task, contact: ContactModel | None) -> mjx.Model | None:
    """The model whose derivatives stand in for those of the contact model's own; None for its own."""
    other = None if contact is None else contact.backward
    return None if other is None else apply_contact(task.scene.model, other)


def simulate(
    task: Task,
    theta: Float[Array, " params"],
    contact: ContactModel | None,
    key: Key[Array, ""],
    noise_scale: float | Float[Array, ""],
) -> tuple[State, Float[Array, "horizon nu"], Float[Array, ""], Float[Array, ""]]:
    """One sample's rollout: states including the initial one, controls, cost and largest solver residual.

    Args:
        task: the task; gives the noise's density and standard deviation.
        theta: parameters of its policy, (params,).
        contact: the contact model; None for the MJCF's own.
        key: key of the sample; draws initial state and noise as in a batch.
        noise_scale: factor on the noise; 0 for a zero-noise rollout.
    """
    start_key, noise_key = split_sample_key(key)
    noise = noise_scale * task.sigma * standard_noise(noise_key, task.policy.noise_shape, theta.dtype, task.noise)
    cost, (states, controls, residual, _) = rollout_cost(task, theta, contact, task.draw_start(start_key), noise)
    return states, controls, cost, residual


def _before_each_step(states: State) -> State:
    return jax.tree.map(lambda leaf: leaf[:-1], states)


def _last(states: State) -> State:
    return jax.tree.map(lambda leaf: leaf[-1], states)


def _coordinates(state: State) -> Float[Array, " states"]:
    """The state as a vector, without the solver's warm start."""
    return jnp.concatenate([state.qpos, state.qvel, state.act])


@dataclasses.dataclass(frozen=True, eq=False)
class Simulator:
    """The compiled programs of a task.

    Attributes:
        task: the task to simulate; each call replaces its scene's contact parameters.
        chunk_size: samples per device and call; `chunk_for` chooses one.
        devices: devices over which samples are spread; by default all local ones.
    """

    task: Task
    chunk_size: int
    devices: tuple[Any, ...] = ()

    def __post_init__(self) -> None:
        if self.chunk_size < 1:
            raise ValueError(f"chunk_size must be at least 1 sample, got {self.chunk_size}")
        object.__setattr__(self, "devices", tuple(self.devices) or tuple(jax.local_devices()))
        batched = {name: jax.vmap(each, (None, None, None, 0, 0)) for name, each in self.sample_programs.items()}
        object.__setattr__(self, "_programs", {name: Compiled(each, name, self.task) for name, each in batched.items()})

    def objective(self, contact: ContactModel | None, sigma: float | None = None) -> "MjxObjective":
        """The objective under a contact model, with the task's noise level or another."""
        return MjxObjective(self, contact, self.task.sigma if sigma is None else sigma)

    @property
    def num_compilations(self) -> int:
        """Number of programs that this simulator has compiled so far."""
        return sum(program.num_compilations for program in self._programs.values())  # type: ignore[attr-defined]

    @property
    def sample_programs(self) -> dict[str, Callable[..., Any]]:
        """One-sample programs for each kind of batch, as pure functions to be batched.

        Each takes (theta, contact, sigma, key data, factor on the noise).
        """
        return {
            "value": self._sample_value,
            "gradient": self._sample_gradient,
            "corrected": partial(self._sample_gradient, onset="linear" if self.task.onset == "none" else None),
            "steps": self._sample_steps,
            "step_gradient": self._sample_step_gradient,
            "linearisation": self._sample_linearisation,
        }

    def memory(self, kind: str, contact: ContactModel | None, samples: int) -> int:
        """XLA's planned temporary memory for a batch of one kind, all chunks at once on all devices [bytes]."""
        dtype = self.task.scene.template.qpos.dtype
        keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(0), self.chunk_size)))
        arguments = (self.task.theta, contact, np.asarray(1.0, dtype), keys, np.ones(self.chunk_size, dtype))
        plan = self._programs[kind].jitted.lower(*arguments).compile().memory_analysis()  # type: ignore[attr-defined]
        return plan.temp_size_in_bytes * samples // self.chunk_size

    def _draw(self, sigma, key_data, noise_scale) -> tuple[State, Float[Array, "steps dimensions"]]:
        task = self.task
        start_key, noise_key = split_sample_key(jax.random.wrap_key_data(key_data))
        dtype = task.scene.template.qpos.dtype
        standard = standard_noise(noise_key, task.policy.noise_shape, dtype, task.noise)
        return task.draw_start(start_key), noise_scale * sigma * standard

    def _cost(self, theta, contact, sigma, key_data, noise_scale, onset="none"):
        """Cost of one rollout, and its states, controls, noise, largest solver residual and onset counts."""
        start, noise = self._draw(sigma, key_data, noise_scale)
        cost, (states, controls, residual, counts) = rollout_cost(self.task, theta, contact, start, noise, onset)
        return cost, (states, controls, noise, residual, counts)

    def _sample_value(self, theta, contact, sigma, key_data, noise_scale):
        value, (states, _, noise, residual, _) = self._cost(theta, contact, sigma, key_data, noise_scale)
        scores = noise_score(noise, sigma, self.task.noise)
        return value, self.task.policy.score(theta, _before_each_step(states), scores), residual

    def _sample_gradient(self, theta, contact, sigma, key_data, noise_scale, onset=None):
        (value, (*_, residual, counts)), gradient = jax.value_and_grad(self._cost, has_aux=True)(
            theta, contact, sigma, key_data, noise_scale, onset or self.task.onset
        )
        return value, gradient, residual, as_row(counts)

    def _sample_steps(self, theta, contact, sigma, key_data, noise_scale):
        _, (states, controls, noise, residual, _) = self._cost(theta, contact, sigma, key_data, noise_scale)
        return self._step_terms(theta, states, controls, noise, sigma), residual

    def _sample_step_gradient(self, theta, contact, sigma, key_data, noise_scale):
        start, noise = self._draw(sigma, key_data, noise_scale)
        (value, (states, _, residual, counts)), gradient = jax.value_and_grad(
            lambda noise: rollout_cost(self.task, theta, contact, start, noise, self.task.onset), has_aux=True
        )(noise)
        return value, gradient, self._policy_jacobian(theta, states), residual, as_row(counts)

    def _sample_linearisation(self, theta, contact, sigma, key_data, noise_scale):
        task = self.task
        start, noise = self._draw(sigma, key_data, noise_scale)
        _, (states, controls, residual, _) = rollout_cost(task, theta, contact, start, noise)
        model = _backward(task, contact) or apply_contact(task.scene.model, contact)
        before, last = _before_each_step(states), _last(states)
        sizes = np.cumsum([states.qpos.shape[1], states.qvel.shape[1]])

        def state_of(vector, like: State) -> State:
            qpos, qvel, act = jnp.split(vector, sizes)
            return State(qpos, qvel, act, like.warmstart)

        def derivatives(state: State, control):
            vector = _coordinates(state)
            following = lambda x, u: _coordinates(step(task.scene, model, state_of(x, state), u)[0])  # noqa: E731
            over_cost = jax.grad(lambda x, u: task.running_cost(state_of(x, state), u), argnums=(0, 1))
            feedback = lambda x: task.policy.feedback(theta, state_of(x, state))  # noqa: E731
            over_policy = None if task.policy.additive else jax.jacfwd(feedback)(vector)
            return over_cost(vector, control), jax.jacfwd(following, argnums=(0, 1))(vector, control), over_policy

        over_cost, over_step, over_policy = jax.vmap(derivatives)(before, controls)
        over_final = jax.grad(lambda x: task.final_cost(state_of(x, last)))(_coordinates(last))
        over_start = None
        if task.policy.at_start:
            over_start = jax.jacfwd(lambda at: _coordinates(task.policy.place(at, noise, start)))(theta)
        terms = self._step_terms(theta, states, controls, noise, sigma)
        return terms, residual, (*over_cost, over_final, *over_step, over_policy, over_start)

    def _step_terms(self, theta, states, controls, noise, sigma):
        """Costs to go from each step with noise, the noise's scores, and the policy's Jacobian."""
        running = jax.vmap(self.task.running_cost)(_before_each_step(states), controls)
        to_go = jnp.cumsum(running[::-1])[::-1] + self.task.final_cost(_last(states))
        return to_go[: len(noise)], noise_score(noise, sigma, self.task.noise), self._policy_jacobian(theta, states)

    def _policy_jacobian(self, theta, states):
        policy = self.task.policy
        if policy.additive:
            return None
        return jax.vmap(lambda state: jax.jacrev(lambda at: policy.feedback(at, state))(theta))(
            _before_each_step(states)
        )

    def run(self, name: str, theta: Any, contact: ContactModel | None, sigma: Any, keys: Any, noise_scale: Any) -> Any:
        """Run one of `sample_programs`, see `spread`.

        Args:
            name: key in `sample_programs`.
            theta: parameters, (params,).
            contact: the contact model; None for the MJCF's own.
            sigma: standard deviation of the noise, in the unit of what it is added to.
            keys: data of each sample's key.
            noise_scale: factor on each sample's noise.

        Returns:
            The program's outputs with a leading axis of samples; as `spread` returns them.

        Raises:
            ValueError: sigma or theta is invalid, or there is no sample.
        """
        check_sigma(sigma)
        if theta.shape != (self.task.policy.num_params,):
            raise ValueError(f"theta has shape {theta.shape}, the policy needs ({self.task.policy.num_params},)")
        if len(noise_scale) == 0:
            raise ValueError("there is no sample to run: give at least one key")
        shared = theta, contact, np.asarray(sigma, self.task.scene.template.qpos.dtype)
        devices = self._devices_for(name)
        with timed(self.program(name, contact), rounds(len(noise_scale), self.chunk_size, len(devices))):
            program = self._programs[name]  # type: ignore[attr-defined]
            return jax.block_until_ready(spread(program, shared, (keys, noise_scale), self.chunk_size, devices))

    def program(self, name: str, contact: ContactModel | None) -> tuple[str, Task, Any, int]:
        """What the time of a call of one of `sample_programs` depends on: name, task, kind of contact, samples."""
        return name, self.task, jax.tree.structure(contact), self.chunk_size

    def _devices_for(self, name: str) -> tuple[Any, ...]:
        """The devices, or one where two at a time would wait for each other for ever; see `LAPACK_BATCH`."""
        corrected = name == "corrected" or self.task.onset != "none"
        batch = self.chunk_size * (SLOTS if corrected else 1)
        hangs = self.devices[0].platform == "cpu" and self.task.scene.host.nv > SMALL and batch >= LAPACK_BATCH
        return self.devices[:1] if hangs else self.devices


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
    sigma: float | Float[Array, ""]

    @property
    def num_params(self) -> int:
        return self.simulator.task.policy.num_params

    def evaluate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Evaluation:
        """Values and scores from rollouts alone; the dynamics are not differentiated.

        The baseline, the zero-noise rollout from the same initial state, is run as extra samples whose noise is scaled
        by 0: a single one if the initial state is fixed, otherwise one per sample.
        """
        (evaluation,) = self._evaluate(theta, keys, (1.0,))
        return evaluation

    def evaluate_odd(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Evaluation:
        """The part of the objective that is odd in the noise, (f(w) - f(-w)) / 2, from two rollouts per sample.

        Only the odd part correlates with the score of noise added to theta, so it has the same gradient; the even part,
        most of the variance of a zeroth-order sample, drops out.

        Raises:
            ValueError: the policy has feedback, so that the score is not odd in the noise.
        """
        if not self.simulator.task.policy.additive:
            raise ValueError("the odd part of an objective needs a policy whose noise is added to theta")
        samples = len(keys)
        scale = np.repeat([1.0, -1.0], samples)
        values, scores, residuals = self._run("value", theta, keys, np.tile(np.arange(samples), 2), scale)
        odd = (values[:samples] - values[samples:]) / 2
        residual = jnp.maximum(residuals[:samples], residuals[samples:])
        return Evaluation(*map(jnp.asarray, (odd, scores[:samples], jnp.zeros_like(odd), residual)))

    def evaluate_pair(
        self, theta: Float[Array, " params"], keys: Key[Array, " samples"]
    ) -> tuple[Evaluation, Evaluation]:
        """Two evaluations with opposite noise, sample by sample, from the same initial states, with one baseline."""
        plus, minus = self._evaluate(theta, keys, (1.0, -1.0))
        return plus, minus

    def differentiate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Differentiation:
        """Values and exact gradients of each sample's cost with respect to theta."""
        return Differentiation(*jax.tree.map(jnp.asarray, self._run("gradient", theta, keys)))

    def evaluate_steps(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> StepEvaluation:
        (steps,) = self._evaluate_steps(theta, keys, (1.0,))
        return steps

    def evaluate_step_pair(
        self, theta: Float[Array, " params"], keys: Key[Array, " samples"]
    ) -> tuple[StepEvaluation, StepEvaluation]:
        plus, minus = self._evaluate_steps(theta, keys, (1.0, -1.0))
        return plus, minus

    def differentiate_corrected(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Differentiation:
        """`differentiate` with the onset term that the task asks for, or the linear one where it asks for none."""
        return Differentiation(*jax.tree.map(jnp.asarray, self._run("corrected", theta, keys)))

    def differentiate_steps(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> StepDifferentiation:
        """The rollouts of `differentiate`, with the derivative of each sample's cost with respect to its noise."""
        return StepDifferentiation(*jax.tree.map(jnp.asarray, self._run("step_gradient", theta, keys)))

    def linearise(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Linearisation:
        """The rollouts of `differentiate`, with the derivatives of every step.

        The state is (qpos, qvel, act), so a quaternion counts four.
        """
        (terms, residual, derivatives), zero_noise = (
            self._run("linearisation", theta, keys),
            self._zero_noise_to_go(theta, keys),
        )
        to_go, scores, jacobian = terms
        steps = StepEvaluation(*jax.tree.map(jnp.asarray, (to_go, zero_noise, scores, jacobian, residual)))
        return Linearisation(steps, *jax.tree.map(jnp.asarray, derivatives))

    def _evaluate(self, theta, keys, signs: tuple[float, ...]) -> list[Evaluation]:
        samples, zero_noise = len(keys), self._zero_noise_rows(len(keys))
        rows = np.append(np.tile(np.arange(samples), len(signs)), zero_noise)
        scale = np.append(np.repeat(signs, samples), np.zeros(len(zero_noise)))
        values, scores, residuals = self._run("value", theta, keys, rows, scale)
        baseline = _for_all(values[len(signs) * samples :], samples)
        parts = [slice(index * samples, (index + 1) * samples) for index in range(len(signs))]
        return [
            Evaluation(*map(jnp.asarray, (values[part], scores[part], baseline, residuals[part]))) for part in parts
        ]

    def _evaluate_steps(self, theta, keys, signs: tuple[float, ...]) -> list[StepEvaluation]:
        samples = len(keys)
        scale = np.repeat(signs, samples)
        (to_go, scores, jacobian), residual = self._run(
            "steps", theta, keys, np.tile(np.arange(samples), len(signs)), scale
        )
        zero_noise = self._zero_noise_to_go(theta, keys)

        def half(part: slice) -> StepEvaluation:
            pick = lambda leaf: jnp.asarray(leaf[part])  # noqa: E731
            terms = jax.tree.map(pick, (to_go, scores, jacobian, residual))
            return StepEvaluation(terms[0], jnp.asarray(zero_noise), *terms[1:])

        return [half(slice(index * samples, (index + 1) * samples)) for index in range(len(signs))]

    def _zero_noise_rows(self, samples: int) -> np.ndarray:
        """The samples that have a zero-noise rollout of their own: one, if all start in the same state."""
        return np.arange(samples if self.simulator.task.random_start else min(samples, 1))

    def _zero_noise_to_go(self, theta, keys):
        """Costs to go of the zero-noise rollouts, a single one if all samples share it."""
        rows = self._zero_noise_rows(len(keys))
        (to_go, *_), _ = self._run("steps", theta, keys, rows, np.zeros(len(rows)))
        return _for_all(to_go, len(keys))

    def _run(self, name: str, theta, keys, rows=None, noise_scale=None):
        """Run a program on rows of the keys, by default each once."""
        rows = np.arange(len(keys)) if rows is None else rows
        scale = np.ones(len(rows)) if noise_scale is None else noise_scale
        # Bare key data: drawing the same noise for several rollouts is intended, not a reused key.
        key_data = np.asarray(jax.random.key_data(keys))[rows]
        dtype = self.simulator.task.scene.template.qpos.dtype
        contact = contact_for(name, self.contact)
        return self.simulator.run(name, theta, contact, self.sigma, key_data, scale.astype(dtype))


@dataclasses.dataclass(frozen=True)
class TracedObjective(MjxObjective):
    """The same objective inside a larger compiled program, on one device: nothing returns to the host between batch and
    estimate."""

    def _run(self, name: str, theta, keys, rows=None, noise_scale=None):
        simulator = self.simulator
        rows = np.arange(len(keys)) if rows is None else rows
        dtype = simulator.task.scene.template.qpos.dtype
        scale = np.ones(len(rows), dtype) if noise_scale is None else np.asarray(noise_scale, dtype)
        chunk = simulator.chunk_size
        chunks = np.minimum(np.arange(math.ceil(len(rows) / chunk) * chunk), len(rows) - 1).reshape(-1, chunk)
        program, key_data = simulator._programs[name].jitted, jax.random.key_data(keys)  # type: ignore[attr-defined]
        sigma = jnp.asarray(self.sigma, dtype)

        def call(chunk):
            drawn, factor = chunk
            return program(theta, self.contact, sigma, drawn, factor)

        parts = key_data[rows[chunks]], jnp.asarray(scale[chunks])
        if len(chunks) == 1:
            return jax.tree.map(lambda leaf: leaf[: len(rows)], call(jax.tree.map(lambda part: part[0], parts)))
        outputs = jax.lax.map(call, parts)
        return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:])[: len(rows)], outputs)


def _for_all(rows, samples: int):
    """Broadcast rows, one per sample or one for all; on the host without a compilation per size."""
    numpy = np if isinstance(rows, np.ndarray) else jnp
    return numpy.broadcast_to(rows, (samples, *rows.shape[1:]))


def contact_for(name: str, contact: ContactModel | None) -> ContactModel | None:
    """What a program reads of a contact model: no surrogate without derivatives, so that one serves all models."""
    return (
        dataclasses.replace(contact, backward=None) if contact is not None and name in ("value", "steps") else contact
    )


def rounds(samples: int, chunk: int, devices: int) -> int:
    """Calls one after another that samples take, in chunks on several devices at once."""
    return math.ceil(math.ceil(samples / chunk) / devices)


def chunk_for(samples: int, devices: Sequence[Any], tasks: Sequence[Task] = ()) -> int:
    """The chunk size that runs `samples` and their baseline in the fewest evenly filled calls.

    On accelerators as many calls as devices at least, and no more samples than gradients of the tasks fit into `SHARE`
    of the memory; on CPUs it depends on neither.
    """
    platform = devices[0].platform
    most, each = MAX_CHUNK[platform], samples + 1
    if platform != "cpu":
        each = math.ceil(each / len(devices))
        memory = (devices[0].memory_stats() or {}).get("bytes_limit", math.inf)
        most = max(1, int(min(most, SHARE * memory / max(map(_gradient_bytes, tasks), default=1))))
    return math.ceil(each / math.ceil(each / most))


def _gradient_bytes(task: Task) -> int:
    """Memory of the states and Jacobians that a gradient stores, about [bytes]."""
    host = task.scene.host
    inputs = host.nq + host.nv + host.na + host.nu
    return 8 * task.horizon * (inputs * (2 * host.nv + host.na) + 2 * inputs)
