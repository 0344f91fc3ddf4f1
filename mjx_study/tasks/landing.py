"""Land on two legs; a neural network commands the servos of a dog-sized robot dropped onto a floor.

The 7.8 kg robot is planar: a trunk with a front and a hind leg of two 0.2 m links, each standing for a pair. It falls
about 0.1 m onto its feet, at up to 1 m/s forward, and must come to rest softly, upright and at crouch height. Initial
height, tilt and velocities are drawn for every sample. At the start of an optimisation the network's output is zero:
the servos hold the crouch.
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

HORIZON: Final = 120
HIDDEN: Final = (16,)
LOW: Final = (0.0, 0.08, -0.1, 0.0, -0.5, -0.5)  # x, z [m], pitch [rad], and their velocities at the start
HIGH: Final = (0.0, 0.12, 0.1, 1.0, 0.0, 0.5)
ERRORS: Final = (0.05, 0.2, 0.5, 0.5, 2.0)  # height [m], pitch [rad], velocities [m/s, m/s, rad/s]: one costs 1 each
TORQUE: Final = 10.0  # constant torque [N m] at one joint that costs 1
SIGMA: Final = 0.05  # [rad]
RECIPE: Final = Recipe(0.003, 200, 50)


def landing(*, horizon: int = HORIZON, model: str | Path = "landing", **scene_options: SceneOption) -> Task:
    """Cost |trunk's height, pitch and velocities|^2 at the end, plus the mean over steps of the joints' |torque|^2.

    Joint torques measure the impact, since they carry the feet's forces.

    Args:
        model: name or path of a replacement MJCF, with the joints `x`, `z`, `pitch`, `front_hip`, `front_knee`,
            `hind_hip`, `hind_knee` in this order, the geoms `front_foot`, `floor`, and a servo for each of the last
            four.
    """
    scene = load_scene(model, **scene_options)
    joints = ("x", "z", "pitch", "front_hip", "front_knee", "hind_hip", "hind_knee")
    require(scene, joints=joints, geoms=("front_foot", "floor"), driven=joints[3:])
    host, dtype = scene.host, scene.template.qpos.dtype
    errors = np.array(ERRORS, dtype)
    gain, stiffness, damping = (host.actuator_gainprm[:, 0], host.actuator_biasprm[:, 1], host.actuator_biasprm[:, 2])

    def features(state: State) -> Float[Array, " features"]:
        """All coordinates except the horizontal position: height in 0.1 m, velocities in 1 m/s and 10 rad/s."""
        velocities = state.qvel / jnp.array([1.0, 1.0] + 5 * [10.0], dtype)
        return jnp.concatenate([10 * state.qpos[1:2], state.qpos[2:], velocities])

    def running_cost(state: State, control: Float[Array, " nu"]) -> Float[Array, ""]:
        torque = gain * control + stiffness * state.qpos[3:] + damping * state.qvel[3:]
        return jnp.sum((torque / TORQUE) ** 2) / horizon

    def final_cost(state: State) -> Float[Array, ""]:
        return jnp.sum((jnp.concatenate([state.qpos[1:3], state.qvel[:3]]) / errors) ** 2)

    def start(key: Key[Array, ""]) -> State:
        low, high = np.array(LOW, dtype), np.array(HIGH, dtype)
        drawn = low + (high - low) * jax.random.uniform(key, (6,), dtype)
        still = jnp.zeros(4, dtype)
        return initial_state(scene, jnp.concatenate([drawn[:3], still]), jnp.concatenate([drawn[3:], still]))

    policy = Network(horizon, host.nu, 13, features, HIDDEN)
    return Task(
        name="landing",
        scene=scene,
        horizon=horizon,
        policy=policy,
        theta=policy.initial(jax.random.key(0), dtype),
        sigma=SIGMA,
        start=start,
        running_cost=running_cost,
        final_cost=final_cost,
        contact_pair=("front_foot", "floor"),
        defaults=StudyDefaults(recipe=RECIPE, damping=30.0, stiffnesses=(1000.0, 2000.0, 5000.0, 10000.0)),
    )
