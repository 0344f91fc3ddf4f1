"""Single-sample programs for each kind of batch, as pure functions."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators.noise import noise_score
from mjx_study.objective.cost import before_each_step, derivative_model, drawn, last_of, rollout_cost
from mjx_study.simulation.contact import apply_contact
from mjx_study.simulation.dynamics import State, step
from mjx_study.simulation.onset import as_row
from mjx_study.tasks.task import Task


@dataclasses.dataclass(frozen=True, eq=False)
class SamplePrograms:
    """The single-sample programs of a task; each call replaces its scene's contact parameters."""

    task: Task

    @property
    def by_name(self) -> dict[str, Callable[..., Any]]:
        """Programs by name: pure functions of (theta, contact, sigma, key data, noise factor), to be batched."""
        return {
            "value": self._sample_value,
            "gradient": self._sample_gradient,
            "corrected": partial(self._sample_gradient, onset="linear" if self.task.onset == "none" else None),
            "steps": self._sample_steps,
            "step_gradient": self._sample_step_gradient,
            "linearisation": self._sample_linearisation,
        }

    def draw(self, sigma, key_data, noise_scale) -> tuple[State, Float[Array, "steps dimensions"]]:
        return drawn(self.task, jax.random.wrap_key_data(key_data), sigma, noise_scale)

    def cost(self, theta, contact, sigma, key_data, noise_scale, onset="none"):
        """Cost of one rollout, with its states, controls, noise, largest solver residual and onset counts."""
        start, noise = self.draw(sigma, key_data, noise_scale)
        cost, (states, controls, residual, counts) = rollout_cost(self.task, theta, contact, start, noise, onset)
        return cost, (states, controls, noise, residual, counts)

    def _sample_value(self, theta, contact, sigma, key_data, noise_scale):
        value, (states, _, noise, residual, _) = self.cost(theta, contact, sigma, key_data, noise_scale)
        scores = noise_score(noise, sigma, self.task.noise)
        return value, self.task.policy.score(theta, before_each_step(states), scores), residual

    def _sample_gradient(self, theta, contact, sigma, key_data, noise_scale, onset=None):
        (value, (*_, residual, counts)), gradient = jax.value_and_grad(self.cost, has_aux=True)(
            theta, contact, sigma, key_data, noise_scale, onset or self.task.onset
        )
        return value, gradient, residual, as_row(counts)

    def _sample_steps(self, theta, contact, sigma, key_data, noise_scale):
        _, (states, controls, noise, residual, _) = self.cost(theta, contact, sigma, key_data, noise_scale)
        return self._step_terms(theta, contact, states, controls, noise, sigma), residual

    def _sample_step_gradient(self, theta, contact, sigma, key_data, noise_scale):
        start, noise = self.draw(sigma, key_data, noise_scale)
        (value, (states, _, residual, counts)), gradient = jax.value_and_grad(
            lambda noise: rollout_cost(self.task, theta, contact, start, noise, self.task.onset), has_aux=True
        )(noise)
        return value, gradient, self._policy_jacobian(theta, states), residual, as_row(counts)

    def _sample_linearisation(self, theta, contact, sigma, key_data, noise_scale):
        task = self.task
        start, noise = self.draw(sigma, key_data, noise_scale)
        _, (states, controls, residual, _) = rollout_cost(task, theta, contact, start, noise)
        model = derivative_model(task, contact) or apply_contact(task.scene.model, contact)
        running_cost, final_cost = task.costs(contact)
        before, last = before_each_step(states), last_of(states)
        sizes = np.cumsum([states.qpos.shape[1], states.qvel.shape[1]])

        def state_of(vector, like: State) -> State:
            qpos, qvel, act = jnp.split(vector, sizes)
            return State(qpos, qvel, act, like.warmstart)

        def derivatives(state: State, control):
            vector = _coordinates(state)
            following = lambda x, u: _coordinates(step(task.scene, model, state_of(x, state), u)[0])  # noqa: E731
            over_cost = jax.grad(lambda x, u: running_cost(state_of(x, state), u), argnums=(0, 1))
            feedback = lambda x: task.policy.feedback(theta, state_of(x, state))  # noqa: E731
            over_policy = None if task.policy.additive else jax.jacfwd(feedback)(vector)
            return over_cost(vector, control), jax.jacfwd(following, argnums=(0, 1))(vector, control), over_policy

        over_cost, over_step, over_policy = jax.vmap(derivatives)(before, controls)
        over_final = jax.grad(lambda x: final_cost(state_of(x, last)))(_coordinates(last))
        over_start = None
        if task.policy.at_start:
            over_start = jax.jacfwd(lambda at: _coordinates(task.policy.place(at, noise, start)))(theta)
        terms = self._step_terms(theta, contact, states, controls, noise, sigma)
        return terms, residual, (*over_cost, over_final, *over_step, over_policy, over_start)

    def _step_terms(self, theta, contact, states, controls, noise, sigma):
        """Costs to go from each noisy step, noise scores, and the policy's Jacobian."""
        running_cost, final_cost = self.task.costs(contact)
        running = jax.vmap(running_cost)(before_each_step(states), controls)
        to_go = jnp.cumsum(running[::-1])[::-1] + final_cost(last_of(states))
        return to_go[: len(noise)], noise_score(noise, sigma, self.task.noise), self._policy_jacobian(theta, states)

    def _policy_jacobian(self, theta, states):
        policy = self.task.policy
        if policy.additive:
            return None
        return jax.vmap(lambda state: jax.jacrev(lambda at: policy.feedback(at, state))(theta))(
            before_each_step(states)
        )


def _coordinates(state: State) -> Float[Array, " states"]:
    """Return the state as a vector, without the solver's warm start."""
    return jnp.concatenate([state.qpos, state.qvel, state.act])
