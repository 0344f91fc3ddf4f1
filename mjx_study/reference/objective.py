"""An analytic system as an Objective: every estimator runs on it unchanged, with the same noise as in MJX."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from estimators import Differentiation, Evaluation
from mjx_study.noise import split_sample_key, standard_noise
from mjx_study.reference.adjoint import roll_out, value_and_gradient
from mjx_study.reference.system import System


@dataclasses.dataclass(frozen=True)
class ReferenceObjective:
    """F(theta) = E V_1(theta + w) of an open loop on an analytic system.

    Attributes:
        system: the system, with its cost.
        start: the start state, fixed.
        horizon: number of steps H; theta is (H, controls), flattened.
        sigma: standard deviation of the noise, in the control's unit.
    """

    system: System
    start: tuple[float, ...]
    horizon: int
    sigma: float

    @property
    def num_params(self) -> int:
        """Length of theta."""
        return self.horizon * self.system.num_controls

    def evaluate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Evaluation:
        """Values and scores by rollouts alone."""
        controls, noise = self._controls(theta, keys)
        start = np.array(self.start)
        value = roll_out(self.system, start, controls).value
        silent = roll_out(self.system, start, self._shape(np.asarray(theta)))
        score = (noise / self.sigma**2).reshape(len(value), -1)
        return Evaluation(jnp.asarray(value), jnp.asarray(score), jnp.full(len(value), silent.value))

    def differentiate(self, theta: Float[Array, " params"], keys: Key[Array, " samples"]) -> Differentiation:
        """Values and hand-derived gradients."""
        controls, _ = self._controls(theta, keys)
        value, gradient = value_and_gradient(self.system, np.array(self.start), controls)
        return Differentiation(jnp.asarray(value), jnp.asarray(gradient.reshape(len(value), -1)))

    def _shape(self, theta: Float[np.ndarray, "*batch params"]) -> Float[np.ndarray, "*batch horizon controls"]:
        return theta.reshape(*theta.shape[:-1], self.horizon, self.system.num_controls)

    def _controls(self, theta, keys):
        draw = jax.vmap(
            lambda key: standard_noise(split_sample_key(key)[1], self.horizon, self.system.num_controls, jnp.float64)
        )
        noise = self.sigma * np.asarray(draw(keys))
        return self._shape(np.asarray(theta)) + noise, noise
