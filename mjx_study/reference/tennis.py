r"""A ball in the plane and a paddle moved by commanded velocities; impacts at their exact times inside the step.

During a step h, the ball flies straight with velocity v, and the paddle moves with its commanded velocity u and spin w;
at an impact the ball's velocity relative to the paddle's surface is mirrored, and both continue for the rest of the
step. Then the ball's velocity is multiplied by `damping`. There is no gravity.

Paddle centre p, angle a, tangent t = (cos a, sin a), normal n = (-sin a, cos a). With q the ball's centre relative to
p, the ball touches the face on side s = +-1 when the clearance s n.q - reach falls to 0, where reach = half-height +
radius, and when |t.q| is at most the half-width. Both faces are solid; edges and corners are not: a ball passing beyond
them is not hit, and one that gets between the planes of the faces that way passes through. The paddle is infinitely
heavy and smooth:

    m = n.(v - u) - w t.q,   v' = v - 2 m n,   and the clearance changes at the rate s m before, -s m after.

The Jacobian of a step with an impact includes the derivative of the impact time. With the motion y' = f before and f_+
after, the reflection R and the clearance g, it is the saltation matrix DR + (f_+ - DR f) Dg / (Dg f).

The rollout jumps where an impact moves from one step to the next: the paddle's command changes abruptly there, and with
it the ball's velocity, by twice the change along the normal (and by twice 1 - damping of the paddle's speed, because
the damping then acts on the other side of the impact). A first-order estimate misses this and the paddle's edges.

Reference: Suh et al. 2022, tennis example, with its published numbers; the impact there is elastic too.
"""

import dataclasses
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from mjx_study.reference.system import ControlJacobians, Controls, FinalQuadraticCost, StateJacobians, States

MAX_TURNED: Final = 1e-3  # bound on the deviation of a velocity that was not reflected [rad]
MAX_IMPACTS: Final = 4
"""Maximum number of impacts per step; a ball still approaching the paddle afterwards passes through."""
CONTROL_SLOPE: Final = np.eye(3, 10, 7)  # derivative of the control with respect to (state, control)
SUBDIVISIONS: Final = 8
"""Number of parts of a flight searched for a crossing; entry and exit within one part (a graze) are missed."""
BISECTIONS: Final = 60  # bisections of such a part, down to adjacent floating-point numbers
TOUCHING_DEPTH: Final = 1e-9
"""Depth inside a face that still counts as outside [m], for rounding after an impact at the end of a step."""

Rows = Float[np.ndarray, "samples 7"]
Commands = Float[np.ndarray, "samples 3"]
Slopes = Float[np.ndarray, "samples 7 inputs"]


@dataclasses.dataclass(frozen=True)
class Tennis(FinalQuadraticCost):
    """State (ball x, y, vx, vy, paddle x, y, angle) [m, m/s, rad]; control: the paddle's velocities [m/s, rad/s].

    Attributes:
        timestep: h [s].
        radius: radius of the ball [m].
        half_width: half-width of the paddle's faces [m].
        half_height: distance from the paddle's middle to its faces [m].
        damping: velocity factor of the ball per step.
        goal, state_weight, control_weight: as in `QuadraticCost`.
    """

    timestep: float = 0.05
    radius: float = 0.15
    half_width: float = 0.8
    half_height: float = 0.05
    damping: float = 0.999
    goal: tuple[float, ...] = (0.0, 2.5, 0.0, 0.0, 0.0, 0.0, 0.0)
    state_weight: tuple[float, ...] = (100.0, 100.0, 10.0, 10.0, 0.0, 0.0, 0.0)
    control_weight: float = 0.001
    num_states: int = 7
    num_controls: int = 3

    def step(self, state: States, control: Controls) -> States:
        after, _, _ = self._move(state, control, differentiate=False)
        return after

    def jacobians(self, state: States, control: Controls) -> tuple[StateJacobians, ControlJacobians]:
        """Derivatives of `step` for a fixed sequence of impacts, including the derivatives of impact times."""
        _, slope, _ = self._move(state, control, differentiate=True)
        assert slope is not None
        return slope[..., :7], slope[..., 7:]

    def impacts(self, state: States, control: Controls) -> np.ndarray:
        """Number of impacts within the step."""
        _, _, count = self._move(state, control, differentiate=False)
        return count

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
            hits, time = _first_impact(now[flying], control[flying], left[flying], reach, self.half_width)
            flying = flying[hits]
            if len(flying) == 0:
                break
            count[flying] += 1
            before, command = now[flying], control[flying]
            touch = before + time[:, None] * _motion(before, command)
            if slope is not None:
                at_fixed_time = slope[flying] + time[:, None, None] * _motion_slope(slope[flying])
                over_time = _time_slope(touch, command, at_fixed_time)
                touch_slope = at_fixed_time + _motion(before, command)[..., None] * over_time[:, None]
                touch_slope[:, 2:4] = _reflected_slope(touch, command, touch_slope)
                slope[flying] = touch_slope
                left_slope[flying] -= over_time
            touch[:, 2:4] = _reflected(touch, command)
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
    turned = (abs(across) > MAX_TURNED * abs(along)) | (along < 0)
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


def draw_start(key: Key[Array, ""]) -> Float[Array, " 7"]:
    """Draw ball x, y, vx, vy and paddle x, y, angle [m, m/s, rad] of one game.

    x ~ U(-2, 2), y ~ N(2, 0.2^2), vx ~ N(-0.2 x, 0.03^2), vy ~ N(-0.2 y, 0.03^2): the ball comes from above, roughly
    towards the origin. Paddle ~ N(0, diag(0.5, 0.05, 0.05)^2).

    Reference: Suh et al. 2022, tennis example.
    """
    position_key, normal_key = jax.random.split(key)
    x = jax.random.uniform(position_key, minval=-2.0, maxval=2.0)
    normal = jax.random.normal(normal_key, (6,))
    y = 2.0 + 0.2 * normal[0]
    ball = jnp.stack([x, y, -0.2 * x + 0.03 * normal[1], -0.2 * y + 0.03 * normal[2]])
    return jnp.concatenate([ball, jnp.array([0.5, 0.05, 0.05]) * normal[3:]])


def _frame(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tangent and normal of the paddle."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([cosine, sine], axis=-1), np.stack([-sine, cosine], axis=-1)


def _dot(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.asarray(left[..., 0] * right[..., 0] + left[..., 1] * right[..., 1])


def _first_impact(
    state: Rows, control: Commands, duration: Float[np.ndarray, " samples"], reach: float, half_width: float
) -> tuple[Int[np.ndarray, " hits"], Float[np.ndarray, " hits"]]:
    """Row indices of the balls that cross a face from outside and within its width, and the first time they do [s]."""
    offset, velocity = state[:, :2] - state[:, 4:6], state[:, 2:4] - control[:, :2]
    nearest = np.hypot(*offset.T) - duration * np.hypot(*velocity.T)
    near = np.flatnonzero(nearest <= np.hypot(half_width, reach) + TOUCHING_DEPTH)  # others cannot reach the paddle
    if len(near) < len(state):
        hits, time = _first_impact(state[near], control[near], duration[near], reach, half_width)
        return near[hits], time
    side = np.where(_dot(_frame(state[:, 6])[1], offset) >= 0, 1.0, -1.0)

    def clearance(rows, times):
        shape = (slice(None),) + (None,) * (times.ndim - 1)
        normal = _frame(state[rows, 6][shape] + control[rows, 2][shape] * times)[1]
        at = offset[rows][(*shape, slice(None))] + velocity[rows][(*shape, slice(None))] * times[..., None]
        return side[rows][shape] * _dot(normal, at) - reach

    every = np.arange(len(state))
    fractions = np.linspace(0, 1, SUBDIVISIONS + 1)[1:]
    inside = clearance(every, duration[:, None] * fractions) < 0
    rows = np.flatnonzero((clearance(every, np.zeros(len(state))) >= -TOUCHING_DEPTH) & inside.any(axis=1))
    if len(rows) == 0:
        return rows, duration[rows]
    late = duration[rows] * fractions[np.argmax(inside[rows], axis=1)]
    early = late - duration[rows] / SUBDIVISIONS
    for _ in range(BISECTIONS):
        middle = (early + late) / 2
        entered = clearance(rows, middle) < 0
        early, late = np.where(entered, early, middle), np.where(entered, middle, late)
    tangent, normal = _frame(state[rows, 6] + control[rows, 2] * late)
    along = _dot(tangent, offset[rows] + velocity[rows] * late[:, None])
    speed = side[rows] * (_dot(normal, velocity[rows]) - control[rows, 2] * along)
    # A ball just hit may seem to enter by rounding, but it is leaving.
    hit = (np.abs(along) <= half_width) & (speed < 0)
    return rows[hit], late[hit]


def _reflected(state: Rows, control: Commands) -> Float[np.ndarray, "samples 2"]:
    """The ball's velocity after an impact at this state, v - 2 m n."""
    _, normal = _frame(state[:, 6])
    return state[:, 2:4] - 2 * _approach(state, control)[:, None] * normal


def _approach(state: Rows, control: Commands) -> Float[np.ndarray, " samples"]:
    """m, the ball's velocity relative to the paddle's surface along n [m/s]."""
    tangent, normal = _frame(state[:, 6])
    along = _dot(tangent, state[:, :2] - state[:, 4:6])
    return _dot(normal, state[:, 2:4] - control[:, :2]) - control[:, 2] * along


def _time_slope(state: Rows, control: Commands, slope: Slopes) -> Float[np.ndarray, "samples inputs"]:
    """Derivative of the impact time, given the derivative `slope` of `state` at fixed time.

    The clearance stays 0: m dT + n.dq - (t.q) da = 0.
    """
    tangent, normal = _frame(state[:, 6])
    along = _dot(tangent, state[:, :2] - state[:, 4:6])
    change = np.einsum("sk,ski->si", normal, slope[:, :2] - slope[:, 4:6]) - along[:, None] * slope[:, 6]
    return -change / _approach(state, control)[:, None]


def _reflected_slope(state: Rows, control: Commands, slope: Slopes) -> Float[np.ndarray, "samples 2 inputs"]:
    """Derivative of `_reflected` by the chain rule, with dn = -t da and dt = n da."""
    tangent, normal = _frame(state[:, 6])
    offset, velocity = state[:, :2] - state[:, 4:6], state[:, 2:4] - control[:, :2]
    along, across, angle = _dot(tangent, offset), _dot(normal, offset), slope[:, 6]
    along_slope = np.einsum("sk,ski->si", tangent, slope[:, :2] - slope[:, 4:6]) + across[:, None] * angle
    speed = _approach(state, control)
    speed_slope = (
        np.einsum("sk,ski->si", normal, slope[:, 2:4] - CONTROL_SLOPE[:2])
        - _dot(tangent, velocity)[:, None] * angle
        - along[:, None] * CONTROL_SLOPE[2]
        - control[:, 2, None] * along_slope
    )
    turned = speed_slope[:, None] * normal[..., None] - (speed[:, None] * tangent)[..., None] * angle[:, None]
    return slope[:, 2:4] - 2 * turned
