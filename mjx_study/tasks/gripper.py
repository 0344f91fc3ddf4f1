"""Push and turn a box with a two-finger gripper; a neural network commands servos.

The 0.5 kg palm moves on a gantry in the plane of a table, and each 8 cm finger turns about a hinge. The 0.3 kg box
starts out of reach, at a random pose in every sample, with dry friction on the table. At the start of an optimisation
the network's output is constant: the palm advances, the fingers close to less than the box's width and knock it away.
"""

from pathlib import Path
from typing import Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import SceneOption, load_scene, require
from mjx_study.tasks.network import Network
from mjx_study.tasks.task import Recipe, StudyDefaults, Task

HORIZON: Final = 100
HIDDEN: Final = (16,)
GOAL: Final = (0.04, 0.07, 0.3)  # box displacement from its mean start [m], and its angle [rad]
LENGTHS: Final = (0.1, 0.1, 1.0)  # box errors that cost 1 each [m, m, rad]
SPREAD: Final = (0.015, 0.005, 0.15)  # half-widths of the box's uniform start distribution [m, m, rad]
SPEED: Final = 0.2  # final box speed that costs 1 [m/s]; its angular speed is SPEED / 0.1 m
CONTROL_WEIGHT: Final = 0.001
COMMAND: Final = (0.0, 1.0, 0.4, 0.4)  # at the start of an optimisation [0.1 m, 0.1 m, rad, rad]
SIGMA: Final = 0.05  # [0.1 m and rad]
RECIPE: Final = Recipe(0.01, 200, 50)


def gripper(*, horizon: int = HORIZON, model: str | Path = "gripper", **scene_options: SceneOption) -> Task:
    """Cost |box - goal|^2 + |its velocity|^2 at the end, in the units above, plus 0.001 sum_h |u_h|^2.

    Args:
        model: name or path of a replacement MJCF, with the joints `palm_x`, `palm_y`, `left`, `right`, `box_x`,
            `box_y`, `box_angle` in this order, the geoms `left_tip`, `box`, and a servo for each of the first four.
    """
    scene = load_scene(model, **scene_options)
    joints = ("palm_x", "palm_y", "left", "right", "box_x", "box_y", "box_angle")
    require(scene, joints=joints, geoms=("left_tip", "box"), driven=joints[:4])
    dtype = scene.template.qpos.dtype
    goal, lengths = np.array(GOAL, dtype), np.array(LENGTHS, dtype)

    def features(state: State) -> Float[Array, " features"]:
        """Positions (the box's relative to the goal) and velocities, all of order 1."""
        error = (state.qpos[4:] - goal) / lengths
        return jnp.concatenate([10 * state.qpos[:2], state.qpos[2:4], error, state.qvel[:2], state.qvel[2:] / 10])

    def final_cost(state: State) -> Float[Array, ""]:
        error = jnp.concatenate([(state.qpos[4:] - goal) / lengths, 0.1 / SPEED * state.qvel[4:] / lengths])
        return jnp.sum(error**2)

    def start(key: Key[Array, ""]) -> State:
        box = np.array(SPREAD, dtype) * jax.random.uniform(key, (3,), dtype, -1.0, 1.0)
        return initial_state(scene, jnp.concatenate([jnp.zeros(4, dtype), box]))

    policy = Network(horizon, scene.host.nu, 14, features, HIDDEN)
    return Task(
        name="gripper",
        scene=scene,
        horizon=horizon,
        policy=policy,
        theta=policy.initial(jax.random.key(0), dtype).at[-len(COMMAND) :].set(jnp.array(COMMAND, dtype)),
        sigma=SIGMA,
        start=start,
        running_cost=lambda state, control: CONTROL_WEIGHT * jnp.sum(control**2),
        final_cost=final_cost,
        contact_pair=("left_tip", "box"),
        defaults=StudyDefaults(recipe=RECIPE, damping=5.0, stiffnesses=(100.0, 300.0, 1000.0, 3000.0)),
    )
