"""Analytic systems and functions as Objectives: every estimator runs on them unchanged, with MJX's noise."""

import dataclasses
from collections.abc import Callable
from typing import Final, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from estimators import Differentiation, Evaluation, Objective
from mjx_study.noise import split_sample_key, standard_noise
from mjx_study.reference.adjoint import roll_out, value_and_gradients
from mjx_study.reference.function import Function, check_noise
from mjx_study.reference.system import System

DECISIONS: Final = ("controls", "feedback", "start")
"""What theta may be in a `ReferenceObjective`."""

Start = tuple[float, ...] | Callable[[Key[Array, ""]], Float[Array, " states"]]


@runtime_checkable
class Reference(Objective, Protocol):
    """An Objective with derivatives by hand, which can also be had without noise."""

    def value_and_gradient(
        self, theta: Float[Array, " params"], key: Key[Array, ""]
    ) -> tuple[float, Float[np.ndarray, " params"]]:
        """Noise-free cost and its gradient, from the start that `key` draws."""
        ...


@dataclasses.dataclass(frozen=True)
class ReferenceObjective:
    """F(theta) = E V_1 of a policy on an analytic system, with w ~ N(0, sigma^2 I).

    What theta is, and where the noise goes:

    - "controls": u_h = theta_h + w_h; theta is (horizon, controls), flattened.
    - "feedback": u_h = Theta x_h + w_h; theta is the matrix Theta, (controls, states), flattened. Score
      sum_h w_h x_h^T / sigma^2.
    - "start": x_1 = theta + w, all controls 0; theta is the start state.

    Attributes:
        system: the system, with its cost.
        start: the start state; or its distribution, as a function of a key, and then each sample draws its own and has
            its own zero-noise rollout as baseline. None if theta is the start.
        horizon: number of steps.
        sigma: standard deviation of the noise, in the unit of what it is added to.
        decision: what theta is, see above.
    """

    system: System
    start: Start | None
    horizon: int
    sigma: float
    decision: str = "controls"

    def __post_init__(self) -> None:
        check_noise(self.sigma)
        if self.decision not in DECISIONS:
            raise ValueError(f"unknown decision {self.decision!r}; choose from {', '.join(DECISIONS)}")
        if self.horizon < 1:
            raise ValueError(f"horizon must be at least 1 step, got {self.horizon}")
        if (self.start is None) != (self.decision == "start"):
            raise ValueError("give a start, except where theta is the start: then it must be None")
        if isinstance(self.start, tuple) and len(self.start) != self.system.num_states:
            raise ValueError(f"the start must have {self.system.num_states} entries, got {len(self.start)}")

    @property
    def num_params(self) -> int:
        """Length of theta."""
        states, controls = self.system.num_states, self.system.num_controls
        return {"controls": self.horizon * controls, "feedback": controls * states, "start": states}[self.decision]

    def evaluate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Evaluation:
        """Values and scores by rollouts alone."""
        starts, noise = self._draw(keys)
        rollout = roll_out(self.system, *self._policy(theta, starts, noise))
        silent = roll_out(self.system, *self._policy(theta, starts, np.zeros(noise.shape[1:])))
        score = noise
        if self.decision == "feedback":
            score = np.einsum("shu,shx->sux", noise, rollout.states[:, :-1])
        score = score.reshape(len(noise), -1) / self.sigma**2
        baseline = np.broadcast_to(silent.value, len(noise))
        return Evaluation(jnp.asarray(rollout.value), jnp.asarray(score), jnp.asarray(baseline))

    def differentiate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Differentiation:
        """Values and hand-derived gradients."""
        starts, noise = self._draw(keys)
        value, gradient = self._differentiate(theta, starts, noise)
        return Differentiation(jnp.asarray(value), jnp.asarray(gradient.reshape(len(noise), -1)))

    def value_and_gradient(
        self, theta: Float[Array, " params"], key: Key[Array, ""]
    ) -> tuple[float, Float[np.ndarray, " params"]]:
        """Noise-free cost and its gradient, from the start that `key` draws for a sample (if it draws one)."""
        start = np.asarray(self.start(split_sample_key(key)[0])) if callable(self.start) else self._fixed_start()
        value, gradient = self._differentiate(theta, start, np.zeros(self._noise_shape))
        return float(value), gradient.reshape(-1)

    @property
    def _noise_shape(self) -> tuple[int, int]:
        if self.decision == "start":
            return (1, self.system.num_states)
        return (self.horizon, self.system.num_controls)

    def _fixed_start(self) -> np.ndarray:
        return np.zeros(self.system.num_states) if self.start is None else np.array(self.start, float)

    def _draw(self, keys):
        """Start states, one for all where it is fixed, and noise of a batch of samples."""

        def one(key):
            start_key, noise_key = split_sample_key(key)
            start = self.start(start_key) if callable(self.start) else ()
            return start, standard_noise(noise_key, self._noise_shape, jnp.float64)

        start, noise = jax.vmap(one)(keys)
        return np.asarray(start) if callable(self.start) else self._fixed_start(), self.sigma * np.asarray(noise)

    def _policy(self, theta, start, noise):
        """Start, open-loop part of the control, and feedback matrix, as `roll_out` takes them."""
        theta = np.asarray(theta)
        if theta.shape != (self.num_params,):
            raise ValueError(f"theta must have shape ({self.num_params},), got {theta.shape}")
        controls = (self.horizon, self.system.num_controls)
        if self.decision == "start":
            return theta + noise[..., 0, :], np.zeros(controls)
        if self.decision == "controls":
            return start, theta.reshape(controls) + noise
        return start, noise, theta.reshape(self.system.num_controls, self.system.num_states)

    def _differentiate(self, theta, start, noise):
        value, gradients = value_and_gradients(self.system, *self._policy(theta, start, noise))
        return value, getattr(gradients, self.decision)


@dataclasses.dataclass(frozen=True)
class FunctionObjective:
    """F(theta) = E f(theta + w) of a function of the parameters alone, with w ~ N(0, sigma^2 I).

    Attributes:
        function: f.
        sigma: standard deviation of the noise, in the unit of theta.
    """

    function: Function
    sigma: float

    def __post_init__(self) -> None:
        check_noise(self.sigma)

    @property
    def num_params(self) -> int:
        """Length of theta."""
        return self.function.num_params

    def evaluate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Evaluation:
        """Values and scores w / sigma^2."""
        noise = self._noise(keys)
        point = self._point(theta)
        baseline = np.broadcast_to(self.function.value(point), len(noise))
        value = self.function.value(point + noise)
        return Evaluation(*map(jnp.asarray, (value, noise / self.sigma**2, baseline)))

    def differentiate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Differentiation:
        """Values and hand-derived gradients."""
        points = self._point(theta) + self._noise(keys)
        return Differentiation(jnp.asarray(self.function.value(points)), jnp.asarray(self.function.gradient(points)))

    def value_and_gradient(
        self, theta: Float[Array, " params"], key: Key[Array, ""]
    ) -> tuple[float, Float[np.ndarray, " params"]]:
        """f(theta) and its gradient; a function has no start to draw, so the key is not used."""
        point = self._point(theta)
        return float(self.function.value(point)), self.function.gradient(point)

    def _noise(self, keys) -> np.ndarray:
        shape = (1, self.num_params)
        draw = jax.vmap(lambda key: standard_noise(split_sample_key(key)[1], shape, jnp.float64))
        return self.sigma * np.asarray(draw(keys))[:, 0]

    def _point(self, theta) -> np.ndarray:
        point = np.asarray(theta, float)
        if point.shape != (self.num_params,):
            raise ValueError(f"theta must have shape ({self.num_params},), got {point.shape}")
        return point
