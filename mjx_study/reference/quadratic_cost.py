"""Quadratic cost in the distance from a goal and in the control, shared by several systems."""

import numpy as np
from jaxtyping import Float


class QuadraticCost:
    """c(x, u) = e^T Q e + R |u|^2 with e = x - goal, and final cost e^T Q e.

    Attributes:
        goal: target state.
        state_weight: diagonal of Q.
        control_weight: R.
    """

    goal: tuple[float, ...]
    state_weight: tuple[float, ...]
    control_weight: float

    def cost(
        self, state: Float[np.ndarray, "*batch states"], control: Float[np.ndarray, "*batch controls"]
    ) -> Float[np.ndarray, "*batch"]:
        return np.asarray(self.final_cost(state) + self.control_weight * np.sum(control**2, axis=-1))

    def cost_gradients(
        self, state: Float[np.ndarray, "*batch states"], control: Float[np.ndarray, "*batch controls"]
    ) -> tuple[Float[np.ndarray, "*batch states"], Float[np.ndarray, "*batch controls"]]:
        return self.final_gradient(state), 2 * self.control_weight * control

    def final_cost(self, state: Float[np.ndarray, "*batch states"]) -> Float[np.ndarray, "*batch"]:
        return np.asarray(np.sum(np.array(self.state_weight) * (state - np.array(self.goal)) ** 2, axis=-1))

    def final_gradient(self, state: Float[np.ndarray, "*batch states"]) -> Float[np.ndarray, "*batch states"]:
        return 2 * np.array(self.state_weight) * (state - np.array(self.goal))
