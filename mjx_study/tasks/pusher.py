"""Push through stiff contact with an open-loop force on the first of two touching bodies.

Numbers are those of Suh et al. 2022 and its published example: two bodies of 0.1 kg, 5 ms steps, velocity factor 0.99
per step, 200 forces; only the contact model varies. First-order gradients win at K = 10 N/m and lose from about
1000 N/m upwards.
"""

from pathlib import Path
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_study.reference import Pusher, ReferenceObjective
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import Scene, SceneOption, load_scene, require
from mjx_study.tasks.policy import OpenLoop
from mjx_study.tasks.task import Published, Recipe, StudyDefaults, Task

HORIZON: Final = 200
START: Final = (0.0, 1.0)  # positions [m]: touching, at rest
GOAL: Final = (1.0, 2.0, 0.0, 0.0)  # positions [m], velocities [m/s]
STATE_WEIGHT: Final = (0.1, 10.0, 0.1, 0.1)
CONTROL_WEIGHT: Final = 1.0  # [1/N^2]
FORCE: Final = 0.1  # [N] at every step
SIGMA: Final = 0.1  # [N]
GAMMA: Final = 1e8
RADIUS: Final = 100.0
RECIPE: Final = Recipe(1e-3, 500, 10)


def pusher(*, horizon: int = HORIZON, model: str | Path = "pusher", **scene_options: SceneOption) -> Task:
    """Cost sum_h e_h^T Q e_h + R u_h^2 + e_{H+1}^T Q e_{H+1}, with e the state minus the goal.

    Args:
        model: name or path of a replacement MJCF, with the slide joints `pusher`, `slider` in this order, geoms of
            these names, and a motor on `pusher`.
    """
    scene = load_scene(model, **scene_options)
    require(scene, joints=("pusher", "slider"), geoms=("pusher", "slider"), driven=("pusher",))
    weight, goal = np.array(STATE_WEIGHT), np.array(GOAL)

    def state_cost(state: State) -> Float[Array, ""]:
        error = jnp.concatenate([state.qpos, state.qvel]) - goal.astype(state.qpos.dtype)
        return jnp.sum(weight.astype(error.dtype) * error**2)

    def running_cost(state: State, control: Float[Array, " nu"]) -> Float[Array, ""]:
        return state_cost(state) + CONTROL_WEIGHT * jnp.sum(control**2)

    return Task(
        name="pusher",
        scene=scene,
        horizon=horizon,
        policy=OpenLoop(horizon, scene.host.nu),
        theta=jnp.full(horizon * scene.host.nu, FORCE, scene.template.qpos.dtype),
        sigma=SIGMA,
        start=initial_state(scene, qpos=jnp.array(START)),
        running_cost=running_cost,
        final_cost=state_cost,
        contact_pair=("pusher", "slider"),
        reference=lambda stiffness: ReferenceObjective(_system(scene, stiffness), (*START, 0.0, 0.0), horizon, SIGMA),
        defaults=StudyDefaults(gamma=GAMMA, published=Published(GAMMA, RADIUS), recipe=RECIPE),
    )


def _system(scene: Scene, stiffness: float) -> Pusher:
    """The analytic system with the scene's timestep and its first body's mass and damping."""
    mass = float(scene.host.dof_M0[0])
    damping = 1 - scene.timestep * float(scene.host.dof_damping[0]) / mass
    return Pusher(stiffness, timestep=scene.timestep, mass=mass, damping=damping)
