"""Position integration with the true derivative for free and ball joints at rest.

MJX normalises the angular velocity and branches at zero, so its derivative of the orientation over a zero angular
velocity is silently zero; the true one is half a timestep per component. Here the quaternion is a smooth function of
the squared angle, with a series at small angles. Values agree with MJX to rounding, except for turns below
1e-8 rad, which MJX leaves out.
"""

import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjx_study.simulation._mjx import mjx

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_SMALL = 1e-4  # [rad^2]; the series' first omitted term is below 1e-16 of the result


def integrate_position(
    host: mujoco.MjModel | mjx.Model,
    qpos: Float[Array, " nq"],
    qvel: Float[Array, " nv"],
    timestep: Float[Array, ""] | float,
) -> Float[Array, " nq"]:
    """Integrate positions [m or rad; unit quaternions] over a timestep [s] at constant velocity [m/s or rad/s].

    Angular velocities are in the body frame, as in MuJoCo.
    """
    parts = []
    for kind, start, velocity in zip(host.jnt_type, host.jnt_qposadr, host.jnt_dofadr, strict=True):
        if kind == _FREE:
            parts.append(qpos[start : start + 3] + timestep * qvel[velocity : velocity + 3])
            start, velocity = start + 3, velocity + 3
        if kind in (_FREE, _BALL):
            rotation = timestep * qvel[velocity : velocity + 3]
            parts.append(rotate_quaternion(qpos[start : start + 4], rotation))
        else:
            parts.append(qpos[start : start + 1] + timestep * qvel[velocity : velocity + 1])
    return jnp.concatenate(parts) if parts else qpos


def difference_position(
    host: mujoco.MjModel | mjx.Model, start: Float[Array, " nq"], end: Float[Array, " nq"]
) -> Float[Array, " nv"]:
    """Velocity that moves from `start` to `end` in unit time, the inverse of `integrate_position`.

    Quaternions may have any length.
    """
    parts = []
    for kind, first in zip(host.jnt_type, host.jnt_qposadr, strict=True):
        if kind == _FREE:
            parts.append(end[first : first + 3] - start[first : first + 3])
            first = first + 3
        if kind in (_FREE, _BALL):
            parts.append(rotation_between(start[first : first + 4], end[first : first + 4]))
        else:
            parts.append(end[first : first + 1] - start[first : first + 1])
    return jnp.concatenate(parts) if parts else end


def rotation_between(start: Float[Array, " 4"], end: Float[Array, " 4"]) -> Float[Array, " 3"]:
    """Return the body-frame rotation vector [rad] with which `rotate_quaternion` turns `start` into `end`.

    With (w, u) = start^-1 end and sign w >= 0, it is 2 atan2(|u|, w) u / |u|, a smooth function of u / w below pi.
    """
    a, b = start, end
    real = jnp.sum(a * b)
    axis = a[0] * b[1:] - b[0] * a[1:] - jnp.cross(a[1:], b[1:])
    real, axis = jnp.where(real < 0, -real, real), jnp.where(real < 0, -axis, axis)
    ratio = jnp.sum(axis**2) / real**2
    small = ratio < _SMALL / 4
    square = jnp.where(small, 1.0, jnp.sum(axis**2))
    length = jnp.sqrt(square)
    # 2 atan(t) / t, in powers of t^2, with t = |u| / w
    series = (2 - ratio * (2 / 3) + ratio**2 * (2 / 5) - ratio**3 * (2 / 7)) / real
    return axis * jnp.where(small, series, 2 * jnp.arctan2(length, real) / length)


def rotate_quaternion(quaternion: Float[Array, " 4"], rotation: Float[Array, " 3"]) -> Float[Array, " 4"]:
    """Apply a body-frame rotation vector [rad] to a unit quaternion: q exp(rotation / 2), normalised."""
    square = jnp.sum(rotation**2)
    small = square < _SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    # sin(angle / 2) / angle and cos(angle / 2), in powers of angle^2
    sine = jnp.where(small, 0.5 - square / 48 + square**2 / 3840, jnp.sin(angle / 2) / angle)
    cosine = jnp.where(small, 1 - square / 8 + square**2 / 384 - square**3 / 46080, jnp.cos(angle / 2))
    w, x, y, z = quaternion
    a, b, c = sine * rotation
    product = jnp.stack(
        [
            w * cosine - x * a - y * b - z * c,
            w * a + x * cosine + y * c - z * b,
            w * b - x * c + y * cosine + z * a,
            w * c + x * b - y * a + z * cosine,
        ]
    )
    return product / jnp.sqrt(jnp.sum(product**2))
