"""Drag a box by friction with an open-loop force on a block that stands on it.

In Suh et al. 2022, friction is clip(1.8 v, +-0.18) N for a slip v while the block is above the box, and zero past the
edge. Here it is MuJoCo's Coulomb cone with the same limit, mu m g = 0.18 N, and the contact's damping as the slope,
1.8 N s/m in families without a damping ratio. The block's height is a coordinate: the block rests on the box by its
weight alone and really falls past the edge. Numbers and horizon are those of the published example.
"""

from pathlib import Path
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_study.reference import ReferenceObjective, SlidingBox
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import SceneOption, load_scene, require
from mjx_study.tasks.policy import OpenLoop
from mjx_study.tasks.task import Published, Recipe, StudyDefaults, Task

HORIZON: Final = 400
GOAL: Final = (2.0, 2.0, 0.0, 0.0)  # block and box: positions [m], velocities [m/s]
STATE_WEIGHT: Final = (0.1, 10.0, 0.1, 0.1)
CONTROL_WEIGHT: Final = 1.0  # [1/N^2]
SIGMA: Final = 0.1  # [N]
SLIP_DAMPING: Final = 1.8  # [N s/m]
GAMMA: Final = 2e4
RADIUS: Final = 100.0
RECIPE: Final = Recipe(1e-4, 100, 10)
BLOCK, BOX = 0, 2  # indices among the coordinates block, height, box


def sliding_box(*, horizon: int = HORIZON, model: str | Path = "sliding_box", **scene_options: SceneOption) -> Task:
    """Cost sum_h e_h^T Q e_h + R u_h^2 + e_{H+1}^T Q e_{H+1}, with e the horizontal state minus the goal.

    Args:
        model: name or path of a replacement MJCF, with the slide joints `block`, `height`, `box` in this order, the
            geoms `foot`, `box`, and a motor on `block`.
    """
    scene = load_scene(model, **scene_options)
    require(scene, joints=("block", "height", "box"), geoms=("foot", "box"), driven=("block",))
    dtype = scene.template.qpos.dtype
    edge = float(scene.host.geom_size[scene.geom("box")][0])
    system = SlidingBox(width=edge, timestep=scene.timestep, mass=float(scene.host.dof_M0[BLOCK]))
    weight, goal = np.array(STATE_WEIGHT, dtype), np.array(GOAL, dtype)

    def state_cost(state: State) -> Float[Array, ""]:
        kept = np.array([BLOCK, BOX])
        error = jnp.concatenate([state.qpos[kept], state.qvel[kept]]) - goal
        return jnp.sum(weight * error**2)

    def running_cost(state: State, control: Float[Array, " nu"]) -> Float[Array, ""]:
        return state_cost(state) + CONTROL_WEIGHT * jnp.sum(control**2)

    return Task(
        name="sliding_box",
        scene=scene,
        horizon=horizon,
        policy=OpenLoop(horizon, scene.host.nu),
        theta=jnp.zeros(horizon * scene.host.nu, dtype),
        sigma=SIGMA,
        start=initial_state(scene),
        running_cost=running_cost,
        final_cost=state_cost,
        contact_pair=("foot", "box"),
        metrics=lambda states: {
            "aboard": jnp.where(jnp.abs(states.qpos[-1, BLOCK] - states.qpos[-1, BOX]) < edge, 1.0, 0.0)
        },
        reference=lambda stiffness: ReferenceObjective(
            system,
            (0.0, 0.0, 0.0, 0.0),
            horizon,
            SIGMA,
            metrics=lambda states: {"aboard": system.on_box(states[..., -1, :]) * 1.0},
        ),
        defaults=StudyDefaults(
            gamma=GAMMA,
            published=Published(GAMMA, RADIUS),
            recipe=RECIPE,
            damping=SLIP_DAMPING,
            stiffnesses=(100.0, 200.0, 500.0, 1000.0),
        ),
    )
