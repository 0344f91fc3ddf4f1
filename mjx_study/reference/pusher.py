r"""The pusher in closed form: two point masses and a one-sided spring, semi-implicit Euler.

    f = K max(0, distance - (x_2 - x_1)),   v' = damping v + (h / m) (u - f, f),   x' = x + h v'

Reference: Suh et al. 2022, "Pushing with stiff contact", with its published example's numbers.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_study.reference.quadratic_cost import QuadraticCost


@dataclasses.dataclass(frozen=True)
class Pusher(QuadraticCost):
    """State (x1, x2, v1, v2) [m, m/s]; control: force on the first mass [N].

    Attributes:
        stiffness: contact stiffness K [N/m].
        timestep: h [s].
        mass: mass of each body [kg].
        damping: velocity factor per step.
        distance: distance of the centres at first touch [m].
        goal: target state.
        state_weight: diagonal of Q.
        control_weight: R [1/N^2].
    """

    stiffness: float
    timestep: float = 0.005
    mass: float = 0.1
    damping: float = 0.99
    distance: float = 1.0
    goal: tuple[float, ...] = (1.0, 2.0, 0.0, 0.0)
    state_weight: tuple[float, ...] = (0.1, 10.0, 0.1, 0.1)
    control_weight: float = 1.0
    num_states: int = 4
    num_controls: int = 1

    def step(
        self, state: Float[np.ndarray, "*batch 4"], control: Float[np.ndarray, "*batch 1"]
    ) -> Float[np.ndarray, "*batch 4"]:
        position, velocity = state[..., :2], state[..., 2:]
        penetration = self.distance - (position[..., 1] - position[..., 0])
        spring = self.stiffness * np.maximum(penetration, 0.0)
        force = np.stack([control[..., 0] - spring, spring], axis=-1)
        velocity = self.damping * velocity + self.timestep / self.mass * force
        return np.concatenate([position + self.timestep * velocity, velocity], axis=-1)

    def jacobians(
        self, state: Float[np.ndarray, "*batch 4"], control: Float[np.ndarray, "*batch 1"]
    ) -> tuple[Float[np.ndarray, "*batch 4 4"], Float[np.ndarray, "*batch 4 1"]]:
        """Derivatives of `step`; at first touch the spring counts as slack."""
        h, gain = self.timestep, self.timestep / self.mass
        touching = (state[..., 1] - state[..., 0]) < self.distance
        spring = gain * self.stiffness * np.array([[-1.0, 1.0], [1.0, -1.0]]) * touching[..., None, None]
        over_velocity = np.broadcast_to(self.damping * np.eye(2), spring.shape)
        velocity_rows = np.concatenate([spring, over_velocity], axis=-1)
        identity = np.broadcast_to(np.eye(2, 4), velocity_rows.shape)
        over_state = np.concatenate([identity + h * velocity_rows, velocity_rows], axis=-2)
        over_control = np.array([h * gain, 0.0, gain, 0.0])[:, None]
        return over_state, np.broadcast_to(over_control, (*state.shape, 1))
