"""A double pendulum released from an initial state: chaos instead of contact.

The gradient of the final state with respect to the initial state grows with the horizon as trajectories diverge. There
is no contact, so contact families do not apply. The equations of motion are MuJoCo's, integrated by RK4 with 1 ms steps
(those printed by Suh et al. 2022 do not conserve energy); the goal is the hanging rest position.

Angles are relative, the second rod's to the first; those of the published example are absolute. Its initial state in
these coordinates is the variant `published`; the default uses the same four numbers as relative angles.
"""

import dataclasses
import math
from pathlib import Path
from typing import Final

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_study.choices import unknown
from mjx_study.reference import DoublePendulum, ReferenceObjective
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import SceneOption, load_scene, require
from mjx_study.tasks.policy import InitialStatePolicy
from mjx_study.tasks.task import Recipe, StudyDefaults, Task

HORIZON: Final = 1000
STARTS: Final = {  # relative angles [rad], velocities [rad/s]
    "default": (math.pi / 2, 0.0, 5.0, -5.0),
    "published": (math.pi / 2, -math.pi / 2, 5.0, -10.0),
}
SIGMA: Final = 0.5  # on each entry of the initial state [rad or rad/s]
RECIPE: Final = Recipe(1e-3, 200, 100)


def double_pendulum(
    start: str = "default",
    *,
    horizon: int = HORIZON,
    model: str | Path = "double_pendulum",
    **scene_options: SceneOption,
) -> Task:
    """Cost |q|^2, with q [rad] the final angles, not wrapped, since wrapping would add jumps.

    Args:
        start: initial state: default or published; another is a ValueError.
        model: name or path of a replacement MJCF, with the hinges `first` and `second` in this order.
    """
    if start not in STARTS:
        raise ValueError(unknown("start of double_pendulum", start, STARTS))
    scene = load_scene(model, **scene_options)
    require(scene, joints=("first", "second"), geoms=())
    dtype = scene.template.qpos.dtype

    def start_at(rest: State, parameters: Float[Array, " params"]) -> State:
        return dataclasses.replace(rest, qpos=parameters[:2], qvel=parameters[2:])

    name = "double_pendulum" if start == "default" else f"double_pendulum:{start}"
    return Task(
        name=name,
        scene=scene,
        horizon=horizon,
        policy=InitialStatePolicy(4, horizon, scene.host.nu, start_at),
        theta=jnp.array(STARTS[start], dtype),
        sigma=SIGMA,
        start=initial_state(scene),
        final_cost=lambda state: jnp.sum(state.qpos**2),
        contact_pair=None,
        reference=lambda stiffness: ReferenceObjective(
            DoublePendulum(timestep=scene.timestep), None, horizon, SIGMA, parametrises="start"
        ),
        defaults=StudyDefaults(recipe=RECIPE, families=("mjcf",)),
    )
