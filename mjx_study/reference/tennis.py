r"""A ball in the plane and a paddle moved by commanded velocities; impacts at their exact times inside the step.

During a step h, the ball flies straight and the paddle moves with its commanded velocity; at an impact the ball's
velocity relative to the paddle's surface is mirrored (see `paddle`), and both continue for the rest of the step. Then
the ball's velocity is multiplied by `damping`. There is no gravity.

The Jacobian of a step with an impact includes the derivative of the impact time. With the motion y' = f before and f_+
after, the reflection R and the clearance g, it is the saltation matrix DR + (f_+ - DR f) Dg / (Dg f).

The rollout jumps where an impact moves from one step to the next: the paddle's command changes abruptly there, and with
it the ball's velocity, by twice the change along the normal (and by twice 1 - damping of the paddle's speed, because
the damping then acts on the other side of the impact). A first-order estimate misses this and the paddle's edges.

Reference: Suh et al. 2022, tennis example, with its published numbers; the impact there is elastic too.
"""

import dataclasses
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from mjx_study.reference.paddle import first_impact, reflected, reflected_slope, time_slope

TURNED: Final = 1e-3
"""Bound on the deviation of a velocity that was not reflected [rad]."""
MAX_IMPACTS: Final = 4
"""Maximum number of impacts per step; a ball still approaching the paddle afterwards passes through."""
CONTROL_SLOPE: Final = np.eye(3, 10, 7)
"""Derivative of the control with respect to (state, control)."""


@dataclasses.dataclass(frozen=True)
class Tennis:
    """State (ball x, y, vx, vy, paddle x, y, angle) [m, m/s, rad]; control: the paddle's velocities [m/s, rad/s].

    Running cost R |u|^2, final cost e^T Q e with e = x - goal.

    Attributes:
        timestep: h [s].
        radius: radius of the ball [m].
        half_width: half-width of the paddle's faces [m].
        half_height: distance from the paddle's middle to its faces [m].
        damping: velocity factor of the ball per step.
        goal: target state.
        final_weight: diagonal of Q.
        control_weight: R.
    """

    timestep: float = 0.05
    radius: float = 0.15
    half_width: float = 0.8
    half_height: float = 0.05
    damping: float = 0.999
    goal: tuple[float, ...] = (0.0, 2.5, 0.0, 0.0, 0.0, 0.0, 0.0)
    final_weight: tuple[float, ...] = (100.0, 100.0, 10.0, 10.0, 0.0, 0.0, 0.0)
    control_weight: float = 0.001
    num_states: int = 7
    num_controls: int = 3

    def step(
        self, state: Float[np.ndarray, "*batch 7"], control: Float[np.ndarray, "*batch 3"]
    ) -> Float[np.ndarray, "*batch 7"]:
        after, _, _ = self._move(state, control, differentiate=False)
        return after

    def jacobians(
        self, state: Float[np.ndarray, "*batch 7"], control: Float[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 7 7"], Float[np.ndarray, "*batch 7 3"]]:
        """Derivatives of `step` for a fixed sequence of impacts, including the derivatives of impact times."""
        _, slope, _ = self._move(state, control, differentiate=True)
        assert slope is not None
        return slope[..., :7], slope[..., 7:]

    def impacts(self, state: Float[np.ndarray, "*batch 7"], control: Float[np.ndarray, "*batch 3"]) -> np.ndarray:
        """Number of impacts within the step."""
        _, _, count = self._move(state, control, differentiate=False)
        return count

    def cost(
        self, state: Float[np.ndarray, "*batch 7"], control: Float[np.ndarray, "*batch 3"]
    ) -> Float[np.ndarray, "*batch"]:
        return np.asarray(self.control_weight * np.sum(control**2, axis=-1))

    def cost_gradients(
        self, state: Float[np.ndarray, "*batch 7"], control: Float[np.ndarray, "*batch 3"]
    ) -> tuple[Float[np.ndarray, "*batch 7"], Float[np.ndarray, "*batch 3"]]:
        return np.zeros(state.shape), 2 * self.control_weight * control

    def final_cost(self, state: Float[np.ndarray, "*batch 7"]) -> Float[np.ndarray, "*batch"]:
        return np.asarray(np.sum(np.array(self.final_weight) * (state - np.array(self.goal)) ** 2, axis=-1))

    def final_gradient(self, state: Float[np.ndarray, "*batch 7"]) -> Float[np.ndarray, "*batch 7"]:
        return 2 * np.array(self.final_weight) * (state - np.array(self.goal))

    def _move(self, state, control, *, differentiate: bool):
        """State after a step; on request, its Jacobian (..., 7, 10) over (state, control); impact counts."""
        batch = state.shape[:-1]
        now, control = np.array(state, float).reshape(-1, 7), np.asarray(control, float).reshape(-1, 3)
        samples = len(now)
        left, count, flying = np.full(samples, self.timestep), np.zeros(samples, int), np.arange(samples)
        slope = np.tile(np.eye(7, 10), (samples, 1, 1)) if differentiate else None
        left_slope = np.zeros((samples, 10))
        reach = self.half_height + self.radius
        for _ in range(MAX_IMPACTS):
            hits, time, _ = first_impact(now[flying], control[flying], left[flying], reach, self.half_width)
            flying = flying[hits]
            if len(flying) == 0:
                break
            count[flying] += 1
            before, command = now[flying], control[flying]
            touch = before + time[:, None] * _motion(before, command)
            if slope is not None:
                at_fixed_time = slope[flying] + time[:, None, None] * _motion_slope(slope[flying])
                over_time = time_slope(touch, command, at_fixed_time)
                touch_slope = at_fixed_time + _motion(before, command)[..., None] * over_time[:, None]
                touch_slope[:, 2:4] = reflected_slope(touch, command, touch_slope, CONTROL_SLOPE)
                slope[flying] = touch_slope
                left_slope[flying] -= over_time
            touch[:, 2:4] = reflected(touch, command)
            now[flying] = touch
            left[flying] -= time
        motion = _motion(now, control)
        if slope is not None:
            slope = slope + left[:, None, None] * _motion_slope(slope) + motion[..., None] * left_slope[:, None]
            slope[:, 2:4] *= self.damping
            slope = slope.reshape(*batch, 7, 10)
        now = now + left[:, None] * motion
        now[:, 2:4] *= self.damping
        return now.reshape(*batch, 7), slope, count.reshape(batch)


def tennis_metrics(
    position: Float[Any, "*batch steps 2"], velocity: Float[Any, "*batch steps 2"]
) -> dict[str, Float[Any, "*batch"]]:
    """Whether the ball was hit, and its final distance from the target [m], from NumPy or JAX trajectories.

    Only the paddle turns the ball's velocity.
    """
    first = velocity[..., :1, :]
    across = first[..., 0] * velocity[..., 1] - first[..., 1] * velocity[..., 0]
    along = first[..., 0] * velocity[..., 0] + first[..., 1] * velocity[..., 1]
    turned = (abs(across) > TURNED * abs(along)) | (along < 0)
    away = position[..., -1, :] - np.array(Tennis.goal[:2])
    return {"hit": turned.any(-1) * 1.0, "distance [m]": (away**2).sum(-1) ** 0.5}


def _motion(state, control):
    """Time derivative of the state between impacts."""
    return np.concatenate([state[:, 2:4], np.zeros((len(state), 2)), control], axis=-1)


def _motion_slope(slope):
    """Derivative of `_motion`, given the derivative `slope` of the state."""
    still = np.zeros((len(slope), 2, 10))
    commanded = np.broadcast_to(CONTROL_SLOPE, (len(slope), 3, 10))
    return np.concatenate([slope[:, 2:4], still, commanded], axis=-2)
