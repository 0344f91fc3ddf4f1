"""Objectives whose expectations have closed forms."""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.stats import norm

from estimators import Differentiation, Evaluation, Linearisation, StepDifferentiation, StepEvaluation


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


def relaxed_heaviside(sigma: float, width: float) -> OneStep:
    return OneStep(lambda x: jnp.clip(x[0] / width + 0.5, 0.0, 1.0), 1, sigma)


def relaxed_heaviside_gradient(theta: Array, sigma: float, width: float) -> Array:
    upper, lower = (theta + width / 2) / sigma, (theta - width / 2) / sigma
    return (norm.cdf(upper) - norm.cdf(lower)) / width


def linear(slope: np.ndarray, sigma: float) -> OneStep:
    return OneStep(lambda x: jnp.sum(jnp.asarray(slope, x.dtype) * x), len(slope), sigma)


HESSIAN = np.array([[1.0, 0.4, 0.0], [0.4, -0.5, 0.3], [0.0, 0.3, 0.8]])


def quadratic(hessian: np.ndarray, sigma: float) -> OneStep:
    """x^T hessian x / 2."""
    return OneStep(lambda x: 0.5 * x @ jnp.asarray(hessian, x.dtype) @ x, len(hessian), sigma)


@dataclass(frozen=True)
class LinearQuadratic:
    """x' = A x + B u, u = K x + w with theta = vec K, quadratic costs, random start: a feedback policy."""

    sigma: float = 0.4
    start_deviation: float = 0.3
    horizon: int = 3
    num_params: int = 4
    transition: np.ndarray = field(default_factory=lambda: np.array([[0.9, 0.3], [-0.2, 0.8]]))
    control: np.ndarray = field(default_factory=lambda: np.array([[0.5, 0.1], [-0.3, 0.7]]))
    start: np.ndarray = field(default_factory=lambda: np.array([1.0, -0.5]))
    state_cost: np.ndarray = field(default_factory=lambda: np.array([[1.0, 0.2], [0.2, 0.5]]))
    control_cost: np.ndarray = field(default_factory=lambda: np.array([[0.3, 0.0], [0.0, 0.2]]))

    def expected_cost(self, theta: Array) -> Array:
        """F by the recursion of the second moment S of the state."""
        gain = theta.reshape(2, 2)
        start = jnp.asarray(self.start)
        moment = jnp.outer(start, start) + self.start_deviation**2 * jnp.eye(2)
        closed_loop, cost = self.transition + self.control @ gain, jnp.zeros(())
        for _ in range(self.horizon):
            control_moment = gain @ moment @ gain.T + self.sigma**2 * jnp.eye(2)
            cost += jnp.trace(self.state_cost @ moment) + jnp.trace(self.control_cost @ control_moment)
            moment = closed_loop @ moment @ closed_loop.T + self.sigma**2 * self.control @ self.control.T
        return cost + jnp.trace(self.state_cost @ moment)

    def sample(self, key: Array) -> tuple[Array, Array]:
        start_key, noise_key = jax.random.split(key)
        start = jnp.asarray(self.start) + self.start_deviation * jax.random.normal(start_key, (2,))
        return start, self.sigma * jax.random.normal(noise_key, (self.horizon, 2))

    def rollout(self, theta: Array, start: Array, noise: Array) -> tuple[Array, Array]:
        """Costs to go, and the states before each step."""
        gain, state, costs, states = theta.reshape(2, 2), start, [], []
        for step in range(self.horizon):
            control = gain @ state + noise[step]
            states.append(state)
            costs.append(state @ self.state_cost @ state + control @ self.control_cost @ control)
            state = jnp.asarray(self.transition) @ state + jnp.asarray(self.control) @ control
        costs[-1] += state @ self.state_cost @ state
        return jnp.cumsum(jnp.stack(costs)[::-1])[::-1], jnp.stack(states)

    def steps(self, theta: Array, starts: Array, noise: Array) -> StepEvaluation:
        value, states = jax.vmap(lambda start, w: self.rollout(theta, start, w))(starts, noise)
        silent, _ = jax.vmap(lambda start, w: self.rollout(theta, start, 0 * w))(starts, noise)
        jacobian = jnp.einsum("uv,isx->isuvx", jnp.eye(2), states).reshape(*noise.shape, 4)
        return StepEvaluation(value, silent, noise / self.sigma**2, jacobian)

    def at_noise(self, theta: Array, starts: Array, noise: Array) -> Evaluation:
        steps = self.steps(theta, starts, noise)
        assert steps.policy_jacobian is not None
        score = jnp.einsum("ishp,ish->ip", steps.policy_jacobian, steps.noise_score)
        return Evaluation(steps.value_to_go[:, 0], score, steps.baseline_to_go[:, 0])

    def evaluate(self, theta: Array, keys: Array) -> Evaluation:
        return self.at_noise(theta, *jax.vmap(self.sample)(keys))

    def evaluate_pair(self, theta: Array, keys: Array) -> tuple[Evaluation, Evaluation]:
        starts, noise = jax.vmap(self.sample)(keys)
        return self.at_noise(theta, starts, noise), self.at_noise(theta, starts, -noise)

    def evaluate_steps(self, theta: Array, keys: Array) -> StepEvaluation:
        return self.steps(theta, *jax.vmap(self.sample)(keys))

    def evaluate_step_pair(self, theta: Array, keys: Array) -> tuple[StepEvaluation, StepEvaluation]:
        starts, noise = jax.vmap(self.sample)(keys)
        return self.steps(theta, starts, noise), self.steps(theta, starts, -noise)

    def differentiate(self, theta: Array, keys: Array) -> Differentiation:
        def one(start: Array, noise: Array) -> tuple[Array, Array]:
            return jax.value_and_grad(lambda at: self.rollout(at, start, noise)[0][0])(theta)

        value, gradient = jax.vmap(one)(*jax.vmap(self.sample)(keys))
        return Differentiation(value, gradient)

    def differentiate_corrected(self, theta: Array, keys: Array) -> Differentiation:
        return self.differentiate(theta, keys)

    def differentiate_steps(self, theta: Array, keys: Array) -> StepDifferentiation:
        starts, noise = jax.vmap(self.sample)(keys)
        total = jax.value_and_grad(lambda w, start: self.rollout(theta, start, w)[0][0])
        value, gradient = jax.vmap(total)(noise, starts)
        return StepDifferentiation(value, gradient, self.steps(theta, starts, noise).policy_jacobian)

    def linearise(self, theta: Array, keys: Array) -> Linearisation:
        starts, noise = jax.vmap(self.sample)(keys)
        gain = theta.reshape(2, 2)
        _, states = jax.vmap(lambda start, w: self.rollout(theta, start, w))(starts, noise)
        controls = states @ gain.T + noise
        last = states[:, -1] @ self.transition.T + controls[:, -1] @ self.control.T
        shape = (*noise.shape[:2], 2, 2)
        return Linearisation(
            steps=self.steps(theta, starts, noise),
            cost_state=2 * states @ self.state_cost,
            cost_control=2 * controls @ self.control_cost,
            final_state=2 * last @ self.state_cost,
            over_state=jnp.broadcast_to(self.transition, shape),
            over_control=jnp.broadcast_to(self.control, shape),
            policy_state=jnp.broadcast_to(gain, shape),
            start_jacobian=None,
        )
