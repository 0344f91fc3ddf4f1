"""Return balls to a target with a paddle: linear feedback from random initial states.

Numbers are those of Suh et al. 2022 and its published example, but time runs ten times as fast: 200 steps of 5 ms
instead of 50 ms resolve the contact. Policy, commands, noise and cost use the paper's slow time, so that parameters and
costs are comparable. A paddle of 1000 times the ball's mass stands for an unstoppable one.
"""

from pathlib import Path
from typing import Final

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from mjx_study.reference import ReferenceObjective, Tennis, draw_start, tennis_metrics
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import SceneOption, load_model, put_scene, require
from mjx_study.tasks.policy import LinearFeedback
from mjx_study.tasks.task import Published, Recipe, StudyDefaults, Task

HORIZON: Final = 200
TIME_SCALE: Final = 10.0
FINAL_WEIGHT: Final = (100.0, 100.0, 10.0, 10.0)  # on the ball's position and velocity
TARGET: Final = (0.0, 2.5, 0.0, 0.0)  # position [m], velocity [m/s]
CONTROL_WEIGHT: Final = 0.001
SIGMA: Final = 0.01
GAMMA: Final = 1000.0
RADIUS: Final = 1000.0
RECIPE: Final = Recipe(1e-6, 200, 1000, decay=0.1)
FEATURES: Final = 7


def tennis(
    *, horizon: int = HORIZON, model: str | Path = "tennis", adjoint: str = "auto", **scene_options: SceneOption
) -> Task:
    """Cost 0.001 sum_h |u_h|^2 + 100 (|position - target|^2 + |velocity|^2 / 10), the latter of the ball at the end.

    Args:
        model: name or path of a replacement MJCF, with the joints `ball_x`, `ball_y`, `paddle_x`, `paddle_y`,
            `paddle_angle` in this order and a motor for each of the paddle's, in the same order.
    """
    host = load_model(model, **scene_options)
    for actuator, joint in enumerate(host.actuator_trnid[:, 0]):
        # The commanded velocity is reached in one step; commands are in slow time.
        gain = host.dof_M0[host.jnt_dofadr[joint]] / host.opt.timestep
        host.actuator_gainprm[actuator, 0] = TIME_SCALE * gain
        host.actuator_biasprm[actuator, 2] = -gain
    scene = put_scene(host, "tennis", adjoint=adjoint)
    joints = ("ball_x", "ball_y", "paddle_x", "paddle_y", "paddle_angle")
    require(scene, joints=joints, geoms=("ball", "paddle"), driven=joints[2:])
    dtype = scene.template.qpos.dtype
    weight, target = np.array(FINAL_WEIGHT, dtype), np.array(TARGET, dtype)
    damping = 1 - scene.timestep * float(host.dof_damping[0] / host.dof_M0[0])
    system = Tennis(timestep=TIME_SCALE * scene.timestep, damping=damping)

    def features(state: State) -> Float[Array, " features"]:
        """Ball position and slow velocity, paddle position and angle."""
        return jnp.concatenate([state.qpos[:2], state.qvel[:2] / TIME_SCALE, state.qpos[2:]])

    def start(key: Key[Array, ""]) -> State:
        drawn = draw_start(key).astype(dtype)
        qpos = jnp.concatenate([drawn[:2], drawn[4:]])
        qvel = jnp.concatenate([TIME_SCALE * drawn[2:4], jnp.zeros(3, dtype)])
        return initial_state(scene, qpos, qvel)

    return Task(
        name="tennis",
        scene=scene,
        horizon=horizon,
        policy=LinearFeedback(horizon, scene.host.nu, FEATURES, features),
        theta=jnp.zeros(scene.host.nu * FEATURES, dtype),
        sigma=SIGMA,
        start=start,
        running_cost=lambda state, control: CONTROL_WEIGHT * jnp.sum(control**2),
        final_cost=lambda state: jnp.sum(weight * (features(state)[:4] - target) ** 2),
        contact_pair=("ball", "paddle"),
        metrics=lambda states: tennis_metrics(states.qpos[:, :2], states.qvel[:, :2]),
        reference=lambda stiffness: ReferenceObjective(
            system,
            draw_start,
            horizon,
            SIGMA,
            parametrises="feedback",
            metrics=lambda states: tennis_metrics(states[..., :2], states[..., 2:4]),
        ),
        defaults=StudyDefaults(
            gamma=GAMMA,
            published=Published(GAMMA, RADIUS),
            recipe=RECIPE,
            stiffnesses=(1000.0, 2000.0, 5000.0, 10000.0),
        ),
    )
