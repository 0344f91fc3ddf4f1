r"""Two bodies on a line, the first of them driven, in closed form: semi-implicit Euler, x' = x + h v'.

References: Suh et al. 2022, "Pushing with stiff contact" and friction example, with their published examples' numbers.
"""

import dataclasses

import numpy as np

from mjx_study.reference.system import ControlJacobians, Controls, QuadraticCost, StateJacobians, States

ACTION_AND_REACTION = np.array([[-1.0, 1.0], [1.0, -1.0]])


@dataclasses.dataclass(frozen=True)
class Pusher(QuadraticCost):
    """Two point masses and a one-sided spring.

        f = K max(0, distance - (x_2 - x_1)),   v' = damping v + (h / m) (u - f, f)

    State (x1, x2, v1, v2) [m, m/s]; control: force on the first mass [N].

    Attributes:
        stiffness: contact stiffness K [N/m].
        timestep: h [s].
        mass: mass of each body [kg].
        damping: velocity factor per step.
        distance: distance of the centres at first touch [m].
        goal, state_weight, control_weight: as in `QuadraticCost`; the last in 1/N^2.
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

    def step(self, state: States, control: Controls) -> States:
        position, velocity = state[..., :2], state[..., 2:]
        penetration = self.distance - (position[..., 1] - position[..., 0])
        spring = self.stiffness * np.maximum(penetration, 0.0)
        force = np.stack([control[..., 0] - spring, spring], axis=-1)
        velocity = self.damping * velocity + self.timestep / self.mass * force
        return np.concatenate([position + self.timestep * velocity, velocity], axis=-1)

    def jacobians(self, state: States, control: Controls) -> tuple[StateJacobians, ControlJacobians]:
        """Derivatives of `step`; at first touch the spring counts as slack."""
        touching = (state[..., 1] - state[..., 0]) < self.distance
        gain = self.timestep / self.mass
        spring = gain * self.stiffness * ACTION_AND_REACTION * touching[..., None, None]
        over_velocity = np.broadcast_to(self.damping * np.eye(2), spring.shape)
        return _jacobians(np.concatenate([spring, over_velocity], axis=-1), self.timestep, gain)


@dataclasses.dataclass(frozen=True)
class SlidingBox(QuadraticCost):
    """A driven block on a box, coupled by regularised friction until it slides off.

        f = clip(mu (v_2 - v_1), -mu v_s, mu v_s) while |x_2 - x_1| < width, else 0,   v' = v + (h / m) (u + f, -f)

    Friction is continuous, with slope mu within the slip tolerance v_s; leaving the box is a true jump of the dynamics.
    State (x1, x2, v1, v2) of block and box [m, m/s]; control: force on the block [N].

    Attributes:
        viscosity: slope mu of the friction within the slip tolerance [N s/m].
        slip_tolerance: slip v_s at which the friction saturates at mu v_s [m/s].
        width: distance of the centres at which the block leaves the box [m].
        timestep: h [s].
        mass: mass of each body [kg].
        goal, state_weight, control_weight: as in `QuadraticCost`; the last in 1/N^2.
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

    def step(self, state: States, control: Controls) -> States:
        slip = np.clip(state[..., 3] - state[..., 2], -self.slip_tolerance, self.slip_tolerance)
        friction = self.viscosity * slip * self.on_box(state)
        force = np.stack([control[..., 0] + friction, -friction], axis=-1)
        velocity = state[..., 2:] + self.timestep / self.mass * force
        return np.concatenate([state[..., :2] + self.timestep * velocity, velocity], axis=-1)

    def jacobians(self, state: States, control: Controls) -> tuple[StateJacobians, ControlJacobians]:
        """Derivatives of `step`; at the slip tolerance the friction counts as saturated."""
        sticking = self.on_box(state) & (np.abs(state[..., 3] - state[..., 2]) < self.slip_tolerance)
        gain = self.timestep / self.mass
        friction = gain * self.viscosity * ACTION_AND_REACTION * sticking[..., None, None]
        rows = np.concatenate([np.zeros(friction.shape), np.eye(2) + friction], axis=-1)
        return _jacobians(rows, self.timestep, gain)

    def on_box(self, state: States):
        """Whether the block is still on the box."""
        return np.abs(state[..., 1] - state[..., 0]) < self.width


def _jacobians(velocity_rows: np.ndarray, timestep: float, gain: float) -> tuple[np.ndarray, np.ndarray]:
    """Jacobians of a step, given the rows of its velocities, and the velocity that a unit of force adds."""
    over_state = np.concatenate([np.eye(2, 4) + timestep * velocity_rows, velocity_rows], axis=-2)
    over_control = np.array([timestep * gain, 0.0, gain, 0.0])[:, None]
    return over_state, np.broadcast_to(over_control, (*velocity_rows.shape[:-2], 4, 1))
