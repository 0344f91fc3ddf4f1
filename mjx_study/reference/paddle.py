r"""Time and effect of the collision of a ball with a flat, moving, turning paddle.

Paddle centre p, angle a, tangent t = (cos a, sin a), normal n = (-sin a, cos a). During a step the paddle moves with
constant velocity u and spin w, the ball with constant velocity v. With q the ball's centre relative to p, the ball
touches the face on side s = +-1 when the clearance s n.q - reach falls to 0, where reach = half-height + radius, and
when |t.q| is at most the half-width. Both faces are solid; edges and corners are not: a ball passing beyond them is
not hit, and one that gets between the planes of the faces that way passes through. The paddle is infinitely heavy and
smooth, so the ball's velocity relative to its surface at the contact point is mirrored:

    m = n.(v - u) - w t.q,   v' = v - 2 m n,   and the clearance changes at the rate s m before, -s m after.
"""

from typing import Final

import numpy as np
from jaxtyping import Float, Int

SUBDIVISIONS: Final = 8
"""Number of parts of a flight searched for a crossing; entry and exit within one part (a graze) are missed."""
BISECTIONS: Final = 60
"""Bisections of such a part, down to adjacent floating-point numbers."""
TOUCHING: Final = 1e-9
"""Depth inside a face that still counts as outside [m], for rounding after an impact at the end of a step."""


def frame(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tangent and normal of the paddle."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([cosine, sine], axis=-1), np.stack([-sine, cosine], axis=-1)


def dot(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return np.asarray(left[..., 0] * right[..., 0] + left[..., 1] * right[..., 1])


def first_impact(
    state: Float[np.ndarray, "samples 7"],
    control: Float[np.ndarray, "samples 3"],
    duration: Float[np.ndarray, " samples"],
    reach: float,
    half_width: float,
) -> tuple[Int[np.ndarray, " hits"], Float[np.ndarray, " hits"], Float[np.ndarray, " hits"]]:
    """Find the first time within `duration` at which a ball crosses a face from outside, within its width.

    Returns:
        Row indices of the balls hit, time until impact [s], and the side hit, +-1.
    """
    offset, velocity = state[:, :2] - state[:, 4:6], state[:, 2:4] - control[:, :2]
    nearest = np.hypot(*offset.T) - duration * np.hypot(*velocity.T)
    near = np.flatnonzero(nearest <= np.hypot(half_width, reach) + TOUCHING)  # others cannot reach the paddle
    if len(near) < len(state):
        hits, time, side = first_impact(state[near], control[near], duration[near], reach, half_width)
        return near[hits], time, side
    side = np.where(dot(frame(state[:, 6])[1], offset) >= 0, 1.0, -1.0)

    def clearance(rows, times):
        shape = (slice(None),) + (None,) * (times.ndim - 1)
        normal = frame(state[rows, 6][shape] + control[rows, 2][shape] * times)[1]
        at = offset[rows][(*shape, slice(None))] + velocity[rows][(*shape, slice(None))] * times[..., None]
        return side[rows][shape] * dot(normal, at) - reach

    every = np.arange(len(state))
    fractions = np.linspace(0, 1, SUBDIVISIONS + 1)[1:]
    inside = clearance(every, duration[:, None] * fractions) < 0
    rows = np.flatnonzero((clearance(every, np.zeros(len(state))) >= -TOUCHING) & inside.any(axis=1))
    if len(rows) == 0:
        return rows, duration[rows], side[rows]
    late = duration[rows] * fractions[np.argmax(inside[rows], axis=1)]
    early = late - duration[rows] / SUBDIVISIONS
    for _ in range(BISECTIONS):
        middle = (early + late) / 2
        entered = clearance(rows, middle) < 0
        early, late = np.where(entered, early, middle), np.where(entered, middle, late)
    tangent, normal = frame(state[rows, 6] + control[rows, 2] * late)
    along = dot(tangent, offset[rows] + velocity[rows] * late[:, None])
    speed = side[rows] * (dot(normal, velocity[rows]) - control[rows, 2] * along)
    # A ball just hit may seem to enter by rounding, but it is leaving.
    hit = (np.abs(along) <= half_width) & (speed < 0)
    return rows[hit], late[hit], side[rows][hit]


def reflected(
    state: Float[np.ndarray, "samples 7"], control: Float[np.ndarray, "samples 3"]
) -> Float[np.ndarray, "samples 2"]:
    """The ball's velocity after an impact at this state, v - 2 m n."""
    _, normal = frame(state[:, 6])
    return state[:, 2:4] - 2 * approach(state, control)[:, None] * normal


def approach(
    state: Float[np.ndarray, "samples 7"], control: Float[np.ndarray, "samples 3"]
) -> Float[np.ndarray, " samples"]:
    """m, the ball's velocity relative to the paddle's surface along n [m/s]."""
    tangent, normal = frame(state[:, 6])
    along = dot(tangent, state[:, :2] - state[:, 4:6])
    return dot(normal, state[:, 2:4] - control[:, :2]) - control[:, 2] * along


def time_slope(
    state: Float[np.ndarray, "samples 7"],
    control: Float[np.ndarray, "samples 3"],
    slope: Float[np.ndarray, "samples 7 inputs"],
) -> Float[np.ndarray, "samples inputs"]:
    """Derivative of the impact time, given the derivative `slope` of `state` at fixed time.

    The clearance stays 0: m dT + n.dq - (t.q) da = 0.
    """
    tangent, normal = frame(state[:, 6])
    along = dot(tangent, state[:, :2] - state[:, 4:6])
    change = np.einsum("sk,ski->si", normal, slope[:, :2] - slope[:, 4:6]) - along[:, None] * slope[:, 6]
    return -change / approach(state, control)[:, None]


def reflected_slope(
    state: Float[np.ndarray, "samples 7"],
    control: Float[np.ndarray, "samples 3"],
    slope: Float[np.ndarray, "samples 7 inputs"],
    control_slope: Float[np.ndarray, "3 inputs"],
) -> Float[np.ndarray, "samples 2 inputs"]:
    """Derivative of `reflected` by the chain rule, with dn = -t da and dt = n da."""
    tangent, normal = frame(state[:, 6])
    offset, velocity = state[:, :2] - state[:, 4:6], state[:, 2:4] - control[:, :2]
    along, across, angle = dot(tangent, offset), dot(normal, offset), slope[:, 6]
    along_slope = np.einsum("sk,ski->si", tangent, slope[:, :2] - slope[:, 4:6]) + across[:, None] * angle
    speed = approach(state, control)
    speed_slope = (
        np.einsum("sk,ski->si", normal, slope[:, 2:4] - control_slope[:2])
        - dot(tangent, velocity)[:, None] * angle
        - along[:, None] * control_slope[2]
        - control[:, 2, None] * along_slope
    )
    turned = speed_slope[:, None] * normal[..., None] - (speed[:, None] * tangent)[..., None] * angle[:, None]
    return slope[:, 2:4] - 2 * turned
