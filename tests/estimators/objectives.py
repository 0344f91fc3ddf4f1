"""Objectives whose expectations have closed forms."""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.stats import norm

from estimators import Differentiation, Evaluation


@dataclass(frozen=True)
class OneStep:
    """f(theta + w) with w ~ N(0, sigma^2 I): open loop, one step."""

    function: Callable[[Array], Array]
    num_params: int
    sigma: float

    def noise(self, theta: Array, keys: Array) -> Array:
        return self.sigma * jax.vmap(lambda key: jax.random.normal(key, theta.shape, theta.dtype))(keys)

    def evaluate(self, theta: Array, keys: Array) -> Evaluation:
        noise = self.noise(theta, keys)
        return Evaluation(
            value=jax.vmap(self.function)(theta[None, :] + noise),
            score=noise / self.sigma**2,
            baseline=jnp.full(keys.shape, self.function(theta)),
        )

    def differentiate(self, theta: Array, keys: Array) -> Differentiation:
        inputs = theta[None, :] + self.noise(theta, keys)
        value, gradient = jax.vmap(jax.value_and_grad(self.function))(inputs)
        return Differentiation(value=value, gradient=gradient)


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
        """Total cost and score."""
        gain, state, cost, score = theta.reshape(2, 2), start, jnp.zeros(()), jnp.zeros((2, 2))
        for step in range(self.horizon):
            control = gain @ state + noise[step]
            score += jnp.outer(noise[step], state) / self.sigma**2
            cost += state @ self.state_cost @ state + control @ self.control_cost @ control
            state = jnp.asarray(self.transition) @ state + jnp.asarray(self.control) @ control
        return cost + state @ self.state_cost @ state, score.reshape(-1)

    def evaluate(self, theta: Array, keys: Array) -> Evaluation:
        def one(key: Array) -> tuple[Array, Array, Array]:
            start, noise = self.sample(key)
            return *self.rollout(theta, start, noise), self.rollout(theta, start, jnp.zeros_like(noise))[0]

        value, score, baseline = jax.vmap(one)(keys)
        return Evaluation(value, score, baseline)

    def differentiate(self, theta: Array, keys: Array) -> Differentiation:
        def one(start: Array, noise: Array) -> tuple[Array, Array]:
            return jax.value_and_grad(lambda at: self.rollout(at, start, noise)[0])(theta)

        value, gradient = jax.vmap(one)(*jax.vmap(self.sample)(keys))
        return Differentiation(value, gradient)
