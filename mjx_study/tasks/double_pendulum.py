"""A double pendulum let go from an initial state: chaos in place of contact.

The gradient of where it ends with respect to the initial angles and velocities grows with the horizon as trajectories
separate. No contact takes part, so contact families do not apply. The equations of motion are MuJoCo's, with RK4 of
1 ms (Suh et al. 2022 print others, which do not conserve energy). The published start is kept; the goal is to hang.
"""

from pathlib import Path
from typing import Final

import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_study.dynamics import State, initial_state
from mjx_study.policy import Launch
from mjx_study.reference import DoublePendulum, ReferenceObjective
from mjx_study.scene import load_scene, require
from mjx_study.task import Recipe, Task

HORIZON: Final = 1000
START: Final = (1.5707963267948966, 0.0, 5.0, -5.0)  # angles [rad], velocities [rad/s]
SIGMA: Final = 0.5  # on each entry of the initial state [rad or rad/s]
RECIPE: Final = Recipe(1e-3, 200, 100)


def double_pendulum(
    *, horizon: int = HORIZON, model: str | Path = "double_pendulum", **scene_options: str | float
) -> Task:
    """|q|^2 with q [rad] the angles at the end, not wrapped: wrapping would add jumps of its own.

    Args:
        horizon: number of 1 ms steps.
        model: another MJCF in its place, with the hinges `first` and `second`.
        **scene_options: see `load_scene`.
    """
    scene = load_scene(model, **scene_options)
    require(scene, joints=("first", "second"), geoms=(), sizes=(2, 2, 0))
    dtype = scene.template.qpos.dtype

    def launched(start: State, decision: Float[Array, " params"]) -> State:
        return State(decision[:2], decision[2:], start.act, start.warmstart)

    return Task(
        name="double_pendulum",
        description="chaos without contact; four numbers of the initial state",
        scene=scene,
        horizon=horizon,
        policy=Launch(4, horizon, scene.host.nu, launched),
        theta=jnp.array(START, dtype),
        sigma=SIGMA,
        start=initial_state(scene),
        running_cost=lambda state, control: jnp.zeros((), dtype),
        final_cost=lambda state: jnp.sum(state.qpos**2),
        contact_pair=None,
        gamma=float("inf"),
        recipe=RECIPE,
        reference=lambda stiffness: ReferenceObjective(
            DoublePendulum(timestep=scene.timestep), None, horizon, SIGMA, decision="start"
        ),
        families=("mjcf",),
    )
