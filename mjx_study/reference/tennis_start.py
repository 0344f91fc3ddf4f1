"""Initial states of tennis; shared with the simulated task, so that samples agree key by key."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key


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
