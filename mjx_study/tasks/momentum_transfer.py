"""Hit a pivoting bar with a ball so that it turns as fast as possible; theta is the launch angle.

The lever arm grows with the angle up to 45 degrees, beyond which the ball misses: the best angle lies at the edge of a
cliff. The bar's angular momentum is in units of m v d, so a rigid bar and an inelastic impact give the -sin^2 theta of
Suh et al. 2022. An undamped spring is elastic, which doubles the momentum, and the simulated bar yields slightly:
`MomentumTransfer` models both. The bar points up only, so below 0 the ball misses here but not in `MomentumTransfer`.
"""

import dataclasses
from pathlib import Path
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_study.reference import MomentumTransfer, function_objective
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import SceneOption, load_scene, require
from mjx_study.tasks.policy import InitialStatePolicy
from mjx_study.tasks.task import Published, Recipe, StudyDefaults, Task

HORIZON: Final = 400
SPEED: Final = 2.0  # [m/s]
DISTANCE: Final = 0.7  # travel of the ball's centre to the bar [m]
ANGLE: Final = 0.1  # [rad]
SIGMA: Final = 0.02  # [rad]
GAMMA: Final = 0.2  # per unit of the published cost, -sin^2
RADIUS: Final = 1.0  # likewise
RECIPE: Final = Recipe(0.01, 500, 50)


def momentum_transfer(
    *, horizon: int = HORIZON, model: str | Path = "momentum_transfer", **scene_options: SceneOption
) -> Task:
    """Cost -(I omega / (m v d))^2, with I omega the bar's final angular momentum.

    Args:
        horizon: number of 2 ms steps; the ball arrives within 250.
        model: name or path of a replacement MJCF, with the slide joints `x`, `y` and the hinge `pivot` in this order,
            and the geoms `ball`, `bar`; the cost uses its mass and inertia.
    """
    scene = load_scene(model, **scene_options)
    require(scene, joints=("x", "y", "pivot"), geoms=("ball", "bar"))
    dtype = scene.template.qpos.dtype
    mass, _, inertia = (float(entry) for entry in scene.host.dof_M0)  # [kg], [kg], about the pivot [kg m^2]
    unit = mass * SPEED * DISTANCE  # [kg m^2/s]

    def start_at(start: State, parameters: Float[Array, " params"]) -> State:
        velocity = SPEED * jnp.stack([jnp.cos(parameters[0]), jnp.sin(parameters[0]), jnp.zeros_like(parameters[0])])
        return dataclasses.replace(start, qvel=velocity)

    elastic = MomentumTransfer(restitution=1.0, inertia_ratio=mass * DISTANCE**2 / inertia)
    edge = np.array([elastic.edge])
    scale = float(elastic.value(edge) / MomentumTransfer().value(edge))  # of this cost at its best, 4 / 1.1^2

    return Task(
        name="momentum_transfer",
        scene=scene,
        horizon=horizon,
        policy=InitialStatePolicy(1, horizon, scene.host.nu, start_at, "rad"),
        theta=jnp.full(1, ANGLE, dtype),
        sigma=SIGMA,
        start=initial_state(scene),
        final_cost=lambda state: -((inertia * state.qvel[2] / unit) ** 2),
        contact_pair=("ball", "bar"),
        reference=lambda stiffness: function_objective(elastic, SIGMA),
        defaults=StudyDefaults(
            gamma=scale * GAMMA,
            published=Published(scale * GAMMA, scale * RADIUS),
            recipe=RECIPE,
            span=(0.0, 1.0),
            stiffnesses=(3000.0, 10000.0, 30000.0),
        ),
    )
