r"""A driven block on a box, coupled by regularised friction until it slides off; semi-implicit Euler.

    f = clip(mu (v_2 - v_1), -mu v_s, mu v_s) while |x_2 - x_1| < width, else 0,
    v' = v + (h / m) (u + f, -f),   x' = x + h v'

Friction is continuous, with slope mu within the slip tolerance v_s; leaving the box is a true jump of the dynamics.

Reference: Suh et al. 2022, friction example, with its published example's numbers.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_study.reference.quadratic_cost import QuadraticCost


@dataclasses.dataclass(frozen=True)
class SlidingBox(QuadraticCost):
    """State (x1, x2, v1, v2) of block and box [m, m/s]; control: force on the block [N].

    Attributes:
        viscosity: slope mu of the friction within the slip tolerance [N s/m].
        slip_tolerance: slip v_s at which the friction saturates at mu v_s [m/s].
        width: distance of the centres at which the block leaves the box [m].
        timestep: h [s].
        mass: mass of each body [kg].
        goal: target state.
        state_weight: diagonal of Q.
        control_weight: R [1/N^2].
    """

    viscosity: float = 1.8
    slip_tolerance: float = 0.1
    width: float = 0.1
    timestep: float = 0.005
    mass: float = 0.1
    goal: tuple[float, ...] = (2.0, 2.0, 0.0, 0.0)
    state_weight: tuple[float, ...] = (0.1, 10.0, 0.1, 0.1)
    control_weight: float = 1.0
    num_states: int = 4
    num_controls: int = 1

    def step(
        self, state: Float[np.ndarray, "*batch 4"], control: Float[np.ndarray, "*batch 1"]
    ) -> Float[np.ndarray, "*batch 4"]:
        slip = np.clip(state[..., 3] - state[..., 2], -self.slip_tolerance, self.slip_tolerance)
        friction = self.viscosity * slip * self.on_box(state)
        force = np.stack([control[..., 0] + friction, -friction], axis=-1)
        velocity = state[..., 2:] + self.timestep / self.mass * force
        return np.concatenate([state[..., :2] + self.timestep * velocity, velocity], axis=-1)

    def jacobians(
        self, state: Float[np.ndarray, "*batch 4"], control: Float[np.ndarray, "*batch 1"]
    ) -> tuple[Float[np.ndarray, "*batch 4 4"], Float[np.ndarray, "*batch 4 1"]]:
        """Derivatives of `step`; at the slip tolerance the friction counts as saturated."""
        h, gain = self.timestep, self.timestep / self.mass
        sticking = self.on_box(state) & (np.abs(state[..., 3] - state[..., 2]) < self.slip_tolerance)
        friction = gain * self.viscosity * np.array([[-1.0, 1.0], [1.0, -1.0]]) * sticking[..., None, None]
        velocity_rows = np.concatenate([np.zeros(friction.shape), np.eye(2) + friction], axis=-1)
        over_state = np.concatenate([np.eye(2, 4) + h * velocity_rows, velocity_rows], axis=-2)
        over_control = np.array([h * gain, 0.0, gain, 0.0])[:, None]
        return over_state, np.broadcast_to(over_control, (*state.shape, 1))

    def on_box(self, state: Float[np.ndarray, "*batch 4"]):
        """Whether the block is still on the box."""
        return np.abs(state[..., 1] - state[..., 0]) < self.width
