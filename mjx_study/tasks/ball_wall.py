"""Throw a ball as far as possible with a wall in the way; theta is the launch angle.

Lengths are ten times those of Suh et al. 2022 and speeds sqrt(10) times, which preserves the shape of the flight; the
cost is in the paper's lengths. In the paper the ball drops at the wall and stays where it lands; here floor and wall
have friction 5, and the contact is strongly damped in families without a damping ratio. The wall is a `box`, or a box
with a round top, the `dome`, on which the bounce angle varies continuously; the landing point still jumps there, since
friction holds a ball that grazes the top.
"""

import dataclasses
from pathlib import Path
from typing import Final

import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjx_study.choices import unknown
from mjx_study.reference import BallWall, function_objective
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import SceneError, SceneOption, load_model, put_scene, require
from mjx_study.tasks.policy import InitialStatePolicy
from mjx_study.tasks.task import Published, Recipe, StudyDefaults, Task

HORIZON: Final = 400
LENGTH_SCALE: Final = 10.0
SPEED: Final = 1.0  # [m/s], in the paper's lengths
ANGLE: Final = 0.1  # [rad]
SIGMA: Final = 0.1  # [rad]
DAMPING: Final = 100.0  # [N s/m]
GAMMA: Final = 0.01
RADIUS: Final = 1.0
RECIPE: Final = Recipe(0.1, 1000, 50)
VARIANTS: Final = ("box", "dome")


def ball_wall(
    variant: str = "box",
    *,
    horizon: int = HORIZON,
    model: str | Path = "ball_wall",
    adjoint: str = "auto",
    **scene_options: SceneOption,
) -> Task:
    """Cost -(x / 10)^2, with x [m] the ball's final position.

    Args:
        variant: shape of the wall: box or dome; another is a ValueError.
        horizon: number of 2 ms steps; the highest flight takes 330.
        model: name or path of a replacement MJCF, with the slide joints `x`, `z` in this order and the geoms `ball`,
            `wall`, `dome`.
    """
    if variant not in VARIANTS:
        raise ValueError(unknown("variant of ball_wall", variant, VARIANTS))
    host = load_model(model, **scene_options)
    if variant == "dome":
        _raise_dome(host)
    scene = put_scene(host, "ball_wall", adjoint=adjoint)
    require(scene, joints=("x", "z"), geoms=("ball", "wall", "dome"))
    dtype = scene.template.qpos.dtype
    speed = SPEED * LENGTH_SCALE**0.5

    def start_at(start: State, parameters: Float[Array, " params"]) -> State:
        direction = jnp.stack([jnp.cos(parameters[0]), jnp.sin(parameters[0])])
        return dataclasses.replace(start, qvel=speed * direction)

    name = "ball_wall" if variant == "box" else f"ball_wall:{variant}"
    return Task(
        name=name,
        scene=scene,
        horizon=horizon,
        policy=InitialStatePolicy(1, horizon, scene.host.nu, start_at, "rad"),
        theta=jnp.full(1, ANGLE, dtype),
        sigma=SIGMA,
        start=initial_state(scene),
        final_cost=lambda state: -((state.qpos[0] / LENGTH_SCALE) ** 2),
        contact_pair=("ball", "wall"),
        reference=lambda stiffness: function_objective(BallWall(), SIGMA),
        defaults=StudyDefaults(
            gamma=GAMMA,
            published=Published(GAMMA, RADIUS),
            recipe=RECIPE,
            damping=DAMPING,
            span=(0.0, 1.5),
            stiffnesses=(1000.0, 3000.0, 10000.0),
        ),
    )


def _raise_dome(host: mujoco.MjModel) -> None:
    """Lower the wall by the dome's radius and make the dome solid and visible."""
    wall, dome = (mujoco.mj_name2id(host, mujoco.mjtObj.mjOBJ_GEOM, name) for name in ("wall", "dome"))
    if min(wall, dome) < 0:
        raise SceneError("the model of ball_wall needs the geoms wall and dome")
    radius = host.geom_size[dome, 0]
    host.geom_size[wall, 2] -= radius / 2
    host.geom_pos[wall, 2] -= radius / 2
    host.geom_contype[dome] = host.geom_conaffinity[dome] = 1
    host.geom_rgba[dome, 3] = 1
