r"""A linear system with quadratic cost of any size and units, where every expectation has a closed form.

    x' = A x + B u,   V = sum_h x_h^T Q x_h + u_h^T R u_h + x_{H+1}^T P x_{H+1}

For an open loop U = theta + w, with any noise w of covariance sigma^2 I, V = U^T M U + 2 b^T U + c is a quadratic form:

    F = V(theta) + sigma^2 tr M,   grad F = 2 (M theta + b),   Cov[FoBG sample] = 4 sigma^2 M^2.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_study.reference.function import Smoothed
from mjx_study.reference.system import ControlJacobians, Controls, Costs, StateJacobians, States


@dataclasses.dataclass(frozen=True, eq=False)
class LinearQuadratic:
    """The matrices A, B, Q, R and P, the last three symmetric."""

    transition: Float[np.ndarray, "states states"]
    control: Float[np.ndarray, "states controls"]
    state_weight: Float[np.ndarray, "states states"]
    control_weight: Float[np.ndarray, "controls controls"]
    final_weight: Float[np.ndarray, "states states"]

    @property
    def num_states(self) -> int:
        return self.control.shape[0]

    @property
    def num_controls(self) -> int:
        return self.control.shape[1]

    def step(self, state: States, control: Controls) -> States:
        return state @ self.transition.T + control @ self.control.T

    def jacobians(self, state: States, control: Controls) -> tuple[StateJacobians, ControlJacobians]:
        batch = state.shape[:-1]
        over_state = np.broadcast_to(self.transition, (*batch, *self.transition.shape))
        return over_state, np.broadcast_to(self.control, (*batch, *self.control.shape))

    def cost(self, state: States, control: Controls) -> Costs:
        return np.asarray(_form(self.state_weight, state) + _form(self.control_weight, control))

    def cost_gradients(self, state: States, control: Controls) -> tuple[States, Controls]:
        return 2 * state @ self.state_weight, 2 * control @ self.control_weight

    def final_cost(self, state: States) -> Costs:
        return np.asarray(_form(self.final_weight, state))

    def final_gradient(self, state: States) -> States:
        return 2 * state @ self.final_weight

    def smoothed(
        self, start: Float[np.ndarray, " states"], controls: Float[np.ndarray, "horizon controls"], sigma: float
    ) -> Smoothed:
        """The exact F and grad F of an open loop; theta is `controls`, flattened."""
        theta = controls.reshape(-1)
        square, linear, constant = self.quadratic_form(start, len(controls))
        value = theta @ square @ theta + 2 * linear @ theta + constant + sigma**2 * np.trace(square)
        return Smoothed(float(value), 2 * (square @ theta + linear), np.zeros(len(theta)))

    def first_order_variance(self, horizon: int, sigma: float) -> float:
        """Variance E|g - E g|^2 = 4 sigma^2 tr(M^2) of an open loop's first-order sample, for any theta and start."""
        square, _, _ = self.quadratic_form(np.zeros(self.num_states), horizon)
        return float(4 * sigma**2 * np.sum(square**2))

    def quadratic_form(
        self, start: Float[np.ndarray, " states"], horizon: int
    ) -> tuple[Float[np.ndarray, "params params"], Float[np.ndarray, " params"], float]:
        """M, b and c of V = U^T M U + 2 b^T U + c, with U the flattened control sequence."""
        size = horizon * self.num_controls
        square = np.kron(np.eye(horizon), self.control_weight)
        linear, constant = np.zeros(size), 0.0
        free, response = np.asarray(start, float), np.zeros((self.num_states, size))  # x_h = free + response U
        for step in range(horizon + 1):
            weight = self.final_weight if step == horizon else self.state_weight
            square = square + response.T @ weight @ response
            linear, constant = linear + response.T @ weight @ free, constant + free @ weight @ free
            if step < horizon:
                free, response = self.transition @ free, self.transition @ response
                response[:, step * self.num_controls : (step + 1) * self.num_controls] += self.control
        return square, linear, float(constant)


def _form(weight, vector):
    return np.einsum("...i,ij,...j->...", vector, weight, vector)
