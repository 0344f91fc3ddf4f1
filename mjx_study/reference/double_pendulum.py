r"""Two point masses on massless rods, without friction or actuation; chaotic but smooth.

With c, s = cos q_2, sin q_2 and k = g / l (the masses are equal and cancel),

    [3 + 2 c, 1 + c; 1 + c, 1] a = (s v_2 (2 v_1 + v_2) - k (2 sin q_1 + sin(q_1 + q_2)),
                                    -s v_1^2 - k sin(q_1 + q_2)),

integrated by the classical fourth-order Runge-Kutta method.

Reference: Suh et al. 2022, chaos example; equations of motion from the Lagrangian, so that energy is conserved.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_study.reference.system import ControlJacobians, Controls, FinalQuadraticCost, StateJacobians, States


@dataclasses.dataclass(frozen=True)
class DoublePendulum(FinalQuadraticCost):
    """State (q1, q2, v1, v2) [rad, rad/s]; no control; final cost |(q1, q2)|^2 [rad^2].

    q1 is the first rod's angle from hanging straight down, q2 the second's relative to the first (MuJoCo's joint
    coordinate), so both are 0 at rest. Angles are never wrapped: the final state is smooth in the initial state.

    Attributes:
        timestep: h [s].
        mass: mass of each point [kg].
        length: length of each rod [m].
        gravity: g [m/s^2].
        goal, state_weight, control_weight: as in `QuadraticCost`.
    """

    timestep: float = 0.001
    mass: float = 0.1
    length: float = 1.0
    gravity: float = 9.81
    goal: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    state_weight: tuple[float, ...] = (1.0, 1.0, 0.0, 0.0)
    control_weight: float = 0.0
    num_states: int = 4
    num_controls: int = 0

    def step(self, state: States, control: Controls) -> States:
        h = self.timestep
        first = self._rate(state)
        second = self._rate(state + h / 2 * first)
        third = self._rate(state + h / 2 * second)
        fourth = self._rate(state + h * third)
        return state + h / 6 * (first + 2 * second + 2 * third + fourth)

    def jacobians(self, state: States, control: Controls) -> tuple[StateJacobians, ControlJacobians]:
        """Derivatives of `step`, by the chain rule through its four stages."""
        h, identity = self.timestep, np.eye(4)
        rate, slope = self._rate(state), self._rate_jacobian(state)
        total = slope
        for fraction, weight in ((0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
            stage = state + fraction * h * rate
            slope = self._rate_jacobian(stage) @ (identity + fraction * h * slope)
            rate = self._rate(stage)
            total = total + weight * slope
        return identity + h / 6 * total, np.zeros((*state.shape, 0))

    def accelerations(self, state: States) -> Float[np.ndarray, "*batch 2"]:
        return self._solve(state, self._torques(state)[..., None])[..., 0]

    def acceleration_jacobian(self, state: States) -> Float[np.ndarray, "*batch 2 4"]:
        """Derivative of `accelerations`: M da = dr - dM a, with r the right side above."""
        q1, q2, v1, v2 = np.moveaxis(state, -1, 0)
        sine, cosine, pull = np.sin(q2), np.cos(q2), self.gravity / self.length
        a1, a2 = np.moveaxis(self.accelerations(state), -1, 0)
        lower = -pull * np.cos(q1 + q2)
        rows = (
            (
                lower - 2 * pull * np.cos(q1),
                lower + cosine * v2 * (2 * v1 + v2) + sine * (2 * a1 + a2),
                2 * sine * v2,
                2 * sine * (v1 + v2),
            ),
            (lower, lower - cosine * v1**2 + sine * a1, -2 * sine * v1, np.zeros_like(v1)),
        )
        return self._solve(state, np.stack([np.stack(row, axis=-1) for row in rows], axis=-2))

    def _rate(self, state):
        return np.concatenate([state[..., 2:], self.accelerations(state)], axis=-1)

    def _rate_jacobian(self, state):
        slope = self.acceleration_jacobian(state)
        return np.concatenate([np.broadcast_to(np.eye(2, 4, 2), slope.shape), slope], axis=-2)

    def _torques(self, state):
        q1, q2, v1, v2 = np.moveaxis(state, -1, 0)
        sine, pull = np.sin(q2), self.gravity / self.length
        outer = pull * np.sin(q1 + q2)
        return np.stack([sine * v2 * (2 * v1 + v2) - 2 * pull * np.sin(q1) - outer, -sine * v1**2 - outer], axis=-1)

    def _inertia(self, state):
        """Entries 11, 22 and 12 of the joint inertia over m l^2."""
        cosine = np.cos(state[..., 1])
        return 3 + 2 * cosine, np.ones_like(cosine), 1 + cosine

    def _solve(self, state, right):
        """Inverse inertia times (..., 2, columns); the determinant is 2 - cos^2 q_2, never below 1."""
        first, second, mixed = (entry[..., None] for entry in self._inertia(state))
        upper, lower = right[..., 0, :], right[..., 1, :]
        rows = [second * upper - mixed * lower, first * lower - mixed * upper]
        return np.stack(rows, axis=-2) / (first * second - mixed**2)[..., None]
