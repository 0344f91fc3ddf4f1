"""Analytic systems and functions as Objectives for any estimator, with MJX's noise."""

import dataclasses
import math
from collections.abc import Callable
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from estimators import Differentiation, Evaluation, Linearisation, StepDifferentiation, StepEvaluation
from estimators.noise import batch_noise, check_density, check_sigma, noise_score, split_sample_key
from mjx_study.reference.function import Function
from mjx_study.reference.system import (
    ControlJacobians,
    Controls,
    Costs,
    Rollout,
    StateJacobians,
    States,
    System,
    gradients_along,
    roll_out,
    value_and_gradients,
)

PARAMETRISATIONS: Final = ("controls", "feedback", "start")
"""Possible meanings of theta in a `ReferenceObjective`."""

Start = tuple[float, ...] | Callable[[Key[Array, ""]], Float[Array, " states"]]
Theta = Float[Array, "*each params"]
"""One theta, or one per sample."""
Keys = Key[Array, " samples"]


@dataclasses.dataclass(frozen=True)
class ReferenceObjective:
    """F(theta) = E V_1 of a policy on an analytic system, with noise w of standard deviation sigma.

    Methods that take keys also accept one theta per key.

    `parametrises` determines the meaning of theta and where the noise acts:

    - "controls": u_h = theta_h + w_h; theta is (horizon, controls), flattened.
    - "feedback": u_h = Theta x_h + w_h; theta is the matrix Theta, (controls, states), flattened. Score
      sum_h w_h x_h^T / sigma^2.
    - "start": x_1 = theta + w, all controls 0; theta is the initial state.

    Attributes:
        start: initial state, or a function of a key that draws one; each sample then has its own zero-noise rollout as
            baseline. None if theta is the initial state.
        sigma: standard deviation of the noise, in the unit of the quantity it is added to.
        noise: name of the noise density in `estimators.NOISES`.
        metrics: function that computes named metrics from rollout states including the initial one; None for none.
    """

    system: System
    start: Start | None
    horizon: int
    sigma: float
    parametrises: str = "controls"
    noise: str = "gaussian"
    metrics: Callable[[Float[np.ndarray, "samples steps states"]], dict[str, np.ndarray]] | None = None

    def __post_init__(self) -> None:
        check_sigma(self.sigma)
        check_density(self.noise)
        if self.parametrises not in PARAMETRISATIONS:
            raise ValueError(f"parametrises is {self.parametrises!r}; choose from {', '.join(PARAMETRISATIONS)}")
        least = 0 if self.parametrises == "start" else 1
        if self.horizon < least:
            raise ValueError(f"horizon must be at least {least}, got {self.horizon}")
        if (self.start is None) != (self.parametrises == "start"):
            raise ValueError("give a start, or None if theta is the initial state")
        if isinstance(self.start, tuple) and len(self.start) != self.system.num_states:
            raise ValueError(f"the start must have {self.system.num_states} entries, got {len(self.start)}")

    def evaluate(self, theta: Theta, keys: Keys) -> Evaluation:
        return self._evaluation(theta, *self._draw(keys))

    def evaluate_pair(self, theta: Theta, keys: Keys) -> tuple[Evaluation, Evaluation]:
        starts, noise = self._draw(keys)
        return self._evaluation(theta, starts, noise), self._evaluation(theta, starts, -noise)

    def evaluate_steps(self, theta: Theta, keys: Keys) -> StepEvaluation:
        return self._steps(theta, *self._draw(keys))

    def evaluate_step_pair(self, theta: Theta, keys: Keys) -> tuple[StepEvaluation, StepEvaluation]:
        starts, noise = self._draw(keys)
        return self._steps(theta, starts, noise), self._steps(theta, starts, -noise)

    def differentiate_corrected(self, theta: Theta, keys: Keys) -> Differentiation:
        """`differentiate`: analytic systems, whose springs set in without a jump, and functions have no onset term."""
        return self.differentiate(theta, keys)

    @property
    def num_params(self) -> int:
        return math.prod(self._shape)

    def differentiate(self, theta: Theta, keys: Keys) -> Differentiation:
        starts, noise = self._draw(keys)
        value, gradient = self._differentiate(theta, starts, noise)
        return Differentiation(jnp.asarray(value), jnp.asarray(gradient.reshape(len(noise), -1)))

    def differentiate_steps(self, theta: Theta, keys: Keys) -> StepDifferentiation:
        start, controls, *feedback = self._policy(theta, *self._draw(keys))
        rollout = roll_out(self.system, start, controls, *feedback)
        gradients = gradients_along(self.system, rollout, *feedback)
        over_noise = gradients.start[:, None] if self.parametrises == "start" else gradients.controls
        return StepDifferentiation(
            jnp.asarray(rollout.value), jnp.asarray(over_noise), self._policy_jacobian(rollout.states)
        )

    def linearise(self, theta: Theta, keys: Keys) -> Linearisation:
        starts, noise = self._draw(keys)
        start, controls, *feedback = self._policy(theta, starts, noise)
        rollout = roll_out(self.system, start, controls, *feedback)
        before, samples, size = rollout.states[:, :-1], len(rollout.value), self.system.num_states
        over_cost = self.system.cost_gradients(before, rollout.controls)
        over_step = self.system.jacobians(before, rollout.controls)
        over_final = self.system.final_gradient(rollout.states[:, -1])
        shape = (samples, self.horizon, self.system.num_controls, size)
        over_policy = jnp.broadcast_to(feedback[0][..., None, :, :], shape) if feedback else None
        over_start = jnp.broadcast_to(jnp.eye(size), (samples, size, size)) if self.parametrises == "start" else None
        return Linearisation(
            steps=self._steps_along(rollout, theta, starts, noise),
            cost_state=jnp.asarray(over_cost[0]),
            cost_control=jnp.asarray(over_cost[1]),
            final_state=jnp.asarray(over_final),
            over_state=jnp.asarray(over_step[0]),
            over_control=jnp.asarray(over_step[1]),
            policy_state=over_policy,
            start_jacobian=over_start,
        )

    def observe(self, theta: Theta, keys: Keys) -> dict[str, np.ndarray]:
        """Rollout metrics other than the cost, by name and sample; may be empty."""
        return {} if self.metrics is None else self.metrics(self._roll_out(theta, *self._draw(keys)).states)

    def value_and_gradient(
        self, theta: Float[Array, " params"], key: Key[Array, ""]
    ) -> tuple[float, Float[np.ndarray, " params"]]:
        """Zero-noise cost and its gradient, from the initial state drawn with `key` if it is random."""
        start = np.asarray(self.start(split_sample_key(key)[0])) if callable(self.start) else self._fixed_start()
        value, gradient = self._differentiate(theta, start, np.zeros(self._noise_shape))
        return float(value), gradient.reshape(-1)

    @property
    def _shape(self) -> tuple[int, ...]:
        """Shape of theta in the policy."""
        states, controls = self.system.num_states, self.system.num_controls
        shapes = {"start": (states,), "controls": (self.horizon, controls), "feedback": (controls, states)}
        return shapes[self.parametrises]

    @property
    def _noise_shape(self) -> tuple[int, int]:
        if self.parametrises == "start":
            return (1, self.system.num_states)
        return (self.horizon, self.system.num_controls)

    def _roll_out(self, theta, starts, noise) -> Rollout:
        return roll_out(self.system, *self._policy(theta, starts, noise))

    def _zero_noise(self, theta, starts, noise) -> Rollout:
        return self._roll_out(theta, starts, np.zeros(noise.shape[1:]))

    def _evaluation(self, theta, starts, noise) -> Evaluation:
        rollout, zero_noise = self._roll_out(theta, starts, noise), self._zero_noise(theta, starts, noise)
        score = np.asarray(noise_score(jnp.asarray(noise), self.sigma, self.noise))
        if self.parametrises == "feedback":
            score = np.einsum("shu,shx->sux", score, rollout.states[:, :-1])
        baseline = np.broadcast_to(zero_noise.value, len(noise))
        return Evaluation(jnp.asarray(rollout.value), jnp.asarray(score.reshape(len(noise), -1)), jnp.asarray(baseline))

    def _steps(self, theta, starts, noise) -> StepEvaluation:
        return self._steps_along(self._roll_out(theta, starts, noise), theta, starts, noise)

    def _steps_along(self, rollout: Rollout, theta, starts, noise) -> StepEvaluation:
        both = rollout, self._zero_noise(theta, starts, noise)
        to_go = (part.value_to_go[..., : noise.shape[1]] if self.horizon else part.value[..., None] for part in both)
        value, baseline = (jnp.asarray(np.broadcast_to(part, noise.shape[:2])) for part in to_go)
        score = jnp.asarray(noise_score(jnp.asarray(noise), self.sigma, self.noise))
        return StepEvaluation(value, baseline, score, self._policy_jacobian(rollout.states))

    def _policy_jacobian(self, states):
        """D_theta (Theta x) of every step; None if the noise is added to theta itself."""
        if self.parametrises != "feedback":
            return None
        controls = self.system.num_controls
        jacobian = np.einsum("uv,shx->shuvx", np.eye(controls), states[:, :-1])
        return jnp.asarray(jacobian.reshape(*jacobian.shape[:3], self.num_params))

    def _fixed_start(self) -> np.ndarray:
        return np.zeros(self.system.num_states) if self.start is None else np.array(self.start, float)

    def _draw(self, keys):
        """Initial states (just one if fixed) and noise of a batch of samples."""
        start_keys, noise = batch_noise(keys, self._noise_shape, self.noise)
        start = np.asarray(jax.vmap(self.start)(start_keys)) if callable(self.start) else self._fixed_start()
        return start, self.sigma * np.asarray(noise)

    def _policy(self, theta, start, noise):
        """Initial state, open-loop controls and feedback matrix, if any, as arguments for `roll_out`."""
        theta = np.asarray(theta, float)
        if theta.ndim > 2 or theta.shape[-1:] != (self.num_params,):
            raise ValueError(f"theta must have shape ({self.num_params},), got {theta.shape}")
        shaped = theta.reshape(*theta.shape[:-1], *self._shape)  # with a sample axis if there is one theta per sample
        if self.parametrises == "start":
            return shaped + noise[..., 0, :], np.zeros((self.horizon, self.system.num_controls))
        if self.parametrises == "controls":
            return start, shaped + noise
        return start, noise, shaped

    def _differentiate(self, theta, start, noise):
        value, gradients = value_and_gradients(self.system, *self._policy(theta, start, noise))
        return value, getattr(gradients, self.parametrises)


@dataclasses.dataclass(frozen=True)
class FinalCost:
    """A system whose state is the argument of a function, its final cost; it takes no steps."""

    function: Function
    num_controls: int = 0

    @property
    def num_states(self) -> int:
        return self.function.num_params

    def step(self, state: States, control: Controls) -> States:
        return state

    def jacobians(self, state: States, control: Controls) -> tuple[StateJacobians, ControlJacobians]:
        return np.zeros((*state.shape, self.num_states)), np.zeros((*state.shape, 0))

    def cost(self, state: States, control: Controls) -> Costs:
        return np.zeros(state.shape[:-1])

    def cost_gradients(self, state: States, control: Controls) -> tuple[States, Controls]:
        return np.zeros(state.shape), np.zeros(control.shape)

    def final_cost(self, state: States) -> Costs:
        return self.function.value(state)

    def final_gradient(self, state: States) -> States:
        return self.function.gradient(state)


def function_objective(function: Function, sigma: float, noise: str = "gaussian") -> ReferenceObjective:
    """F(theta) = E f(theta + w) for a function of the parameters alone, with noise w of standard deviation sigma.

    Its samples are rollouts without steps, from theta + w, with f as the final cost. Sigma is in the unit of theta.
    """
    return ReferenceObjective(FinalCost(function), None, 0, sigma, "start", noise)
