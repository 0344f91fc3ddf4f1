"""Objectives whose expectations have closed forms."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.stats import norm

from estimators import Differentiation, Evaluation, Linearisation, StepDifferentiation, StepEvaluation
from experiments.linear_quadratic import LinearQuadratic
from mjx_study.reference import ReferenceObjective


@dataclass(frozen=True)
class OneStep:
    """f(theta + w) with w ~ N(0, sigma^2 I): open loop, one step."""

    function: Callable[[Array], Array]
    num_params: int
    sigma: float

    def noise(self, theta: Array, keys: Array) -> Array:
        return self.sigma * jax.vmap(lambda key: jax.random.normal(key, theta.shape, theta.dtype))(keys)

    def evaluate(self, theta: Array, keys: Array) -> Evaluation:
        return self.at_noise(theta, self.noise(theta, keys))

    def at_noise(self, theta: Array, noise: Array) -> Evaluation:
        return Evaluation(
            value=jax.vmap(self.function)(theta[None, :] + noise),
            score=noise / self.sigma**2,
            baseline=jnp.full(noise.shape[:1], self.function(theta)),
        )

    def evaluate_pair(self, theta: Array, keys: Array) -> tuple[Evaluation, Evaluation]:
        noise = self.noise(theta, keys)
        return self.at_noise(theta, noise), self.at_noise(theta, -noise)

    def evaluate_steps(self, theta: Array, keys: Array) -> StepEvaluation:
        return one_step(self.evaluate(theta, keys))

    def evaluate_step_pair(self, theta: Array, keys: Array) -> tuple[StepEvaluation, StepEvaluation]:
        plus, minus = self.evaluate_pair(theta, keys)
        return one_step(plus), one_step(minus)

    def differentiate_steps(self, theta: Array, keys: Array) -> StepDifferentiation:
        batch = self.differentiate(theta, keys)
        return StepDifferentiation(batch.value, batch.gradient[:, None], None)

    def linearise(self, theta: Array, keys: Array) -> Linearisation:
        """f as the final cost of no step at all, from the start theta + w."""
        steps = one_step(self.evaluate(theta, jax.random.clone(keys)))
        final = self.differentiate(theta, keys).gradient
        samples, size = final.shape
        empty = jnp.zeros((samples, 0, size), theta.dtype)
        return Linearisation(
            steps=steps,
            cost_state=empty,
            cost_control=empty[:, :, :0],
            final_state=final,
            over_state=jnp.zeros((samples, 0, size, size), theta.dtype),
            over_control=jnp.zeros((samples, 0, size, 0), theta.dtype),
            policy_state=None,
            start_jacobian=jnp.broadcast_to(jnp.eye(size, dtype=theta.dtype), (samples, size, size)),
        )

    def differentiate(self, theta: Array, keys: Array) -> Differentiation:
        inputs = theta[None, :] + self.noise(theta, keys)
        value, gradient = jax.vmap(jax.value_and_grad(self.function))(inputs)
        return Differentiation(value=value, gradient=gradient)

    def differentiate_corrected(self, theta: Array, keys: Array) -> Differentiation:
        return self.differentiate(theta, keys)


def one_step(batch: Evaluation) -> StepEvaluation:
    return StepEvaluation(batch.value[:, None], batch.baseline[:, None], batch.score[:, None], None)


def heaviside(sigma: float) -> OneStep:
    return OneStep(lambda x: jnp.where(x[0] >= 0, jnp.ones((), x.dtype), jnp.zeros((), x.dtype)), 1, sigma)


def heaviside_gradient(theta: Array, sigma: float) -> Array:
    """grad Phi(theta/sigma) = phi(theta/sigma) / sigma."""
    return norm.pdf(theta / sigma) / sigma


def linear(slope: np.ndarray, sigma: float) -> OneStep:
    return OneStep(lambda x: jnp.sum(jnp.asarray(slope, x.dtype) * x), len(slope), sigma)


HESSIAN = np.array([[1.0, 0.4, 0.0], [0.4, -0.5, 0.3], [0.0, 0.3, 0.8]])


def quadratic(hessian: np.ndarray, sigma: float) -> OneStep:
    """x^T hessian x / 2."""
    return OneStep(lambda x: 0.5 * x @ jnp.asarray(hessian, x.dtype) @ x, len(hessian), sigma)


SYSTEM = LinearQuadratic(
    transition=np.array([[0.9, 0.3], [-0.2, 0.8]]),
    control=np.array([[0.5, 0.1], [-0.3, 0.7]]),
    state_weight=np.array([[1.0, 0.2], [0.2, 0.5]]),
    control_weight=np.array([[0.3, 0.0], [0.0, 0.2]]),
    final_weight=np.array([[1.0, 0.2], [0.2, 0.5]]),
)
START, START_DEVIATION = np.array([1.0, -0.5]), 0.3


def draw_start(key: Array) -> Array:
    return jnp.asarray(START) + START_DEVIATION * jax.random.normal(key, (2,))


FEEDBACK = ReferenceObjective(SYSTEM, draw_start, horizon=3, sigma=0.4, parametrises="feedback")
"""u = K x + w with theta = vec K, of a linear system with quadratic costs and a random start."""


def of_feedback(theta: np.ndarray) -> tuple[float, np.ndarray]:
    """Mean cost of `FEEDBACK` and its gradient, by the recursion of the second moment S of the state."""

    def mean_cost(gain: Array) -> Array:
        noise = FEEDBACK.sigma**2
        moment = jnp.asarray(np.outer(START, START)) + START_DEVIATION**2 * jnp.eye(2)
        closed_loop, cost = SYSTEM.transition + SYSTEM.control @ gain, jnp.zeros(())
        for _ in range(FEEDBACK.horizon):
            of_control = gain @ moment @ gain.T + noise * jnp.eye(2)
            cost += jnp.trace(SYSTEM.state_weight @ moment) + jnp.trace(SYSTEM.control_weight @ of_control)
            moment = closed_loop @ moment @ closed_loop.T + noise * SYSTEM.control @ SYSTEM.control.T
        return cost + jnp.trace(SYSTEM.final_weight @ moment)

    value, gradient = jax.value_and_grad(mean_cost)(jnp.reshape(jnp.asarray(theta), (2, 2)))
    return float(value), np.asarray(gradient).ravel()
