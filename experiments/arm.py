"""An arm that must push a box to a place, through MuJoCo's default contact: a task of a user, with costs on bodies.

docs/robots.md measures its gradients as `experiments.arm:push`; its model is models/arm.xml.
"""

from pathlib import Path
from typing import Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

import mjx_study as study
from experiments.quadruped import Servos
from mjx_study.simulation.observation import ObservedState
from mjx_study.simulation.scene import SceneOption

MODEL: Final = Path(__file__).parents[1] / "models" / "arm.xml"
GOAL: Final = (0.54, 0.06)  # where the box's centre should come to rest [m]; it starts near (0.42, 0)
LENGTH: Final = 0.1  # distance from the goal that costs 1 [m]
SPEED: Final = 0.2  # final speed that costs 1 [m/s]
SPREAD: Final = (0.01, 0.02)  # half-widths of the uniform distribution of the box's start [m]
TURN: Final = 0.2  # half-width of its heading's [rad]
SCALE: Final = 0.3  # change of a servo's target per unit of the network's output [rad]
HIDDEN: Final = (32, 32)
COMMAND: Final = (0.0, 0.1, 0.0, -1.0, 0.0, 0.9, 0.0)
"""Output at the start of an optimisation: the hand moves forward and knocks against the box."""


def push(horizon: int = 160, model: str | Path = MODEL, seed: int = 0, **options: SceneOption) -> study.Task:
    """Return 0.8 s of pushing a box that starts at a random place and heading, 2.5 cm in front of the knuckle.

    The final cost is the squared distance of the box from its goal, plus its squared speed; a running cost keeps the
    knuckle near the box and the servos' targets near the keyframe's.

    Args:
        horizon: steps of 5 ms.
        model: name or path of a replacement MJCF.
        seed: of the network's initial weights.
        **options: of `load_scene`.
    """
    scene = study.load_scene(model, **options)
    host, dtype = scene.host, scene.template.qpos.dtype
    key = host.key("behind")
    pose, targets = jnp.array(key.qpos, dtype), jnp.array(key.ctrl, dtype)
    box, knuckle, goal = scene.body("box"), scene.geom("knuckle"), jnp.array(GOAL, dtype)

    def start(key: Key[Array, ""]) -> study.State:
        x, y, turn = jax.random.uniform(key, (3,), dtype, -1.0, 1.0) * jnp.array([*SPREAD, TURN], dtype)
        heading = jnp.stack([jnp.cos(turn / 2), jnp.zeros_like(x), jnp.zeros_like(x), jnp.sin(turn / 2)])
        return study.initial_state(scene, pose.at[7].add(x).at[8].add(y).at[10:].set(heading))

    def features(state: study.State) -> Float[Array, " 25"]:
        seen = study.observed(scene, state)
        heading = seen.xmat[box, :2, 0]
        reach, miss = (seen.geom_xpos[knuckle] - seen.xpos[box]) / LENGTH, (seen.xpos[box, :2] - goal) / LENGTH
        of_box, of_arm = (state.qvel[7:10], state.qvel[12:] / 5), (state.qpos[:7] - targets, state.qvel[:7] / 5)
        return jnp.concatenate([reach, miss, heading, *of_box, *of_arm])

    def running_cost(state: ObservedState, control: Array) -> Array:
        reach = jnp.sum((state.geom_xpos[knuckle] - state.xpos[box]) ** 2) / LENGTH**2
        return scene.timestep * (0.1 * reach + 0.2 * jnp.mean((control - targets) ** 2))

    def final_cost(state: ObservedState) -> Array:
        miss = jnp.sum((state.xpos[box, :2] - goal) ** 2) / LENGTH**2
        return miss + jnp.sum(state.xlinvel[box] ** 2) / SPEED**2

    def metrics(states: ObservedState) -> dict[str, Array]:
        return {
            "miss": jnp.linalg.norm(states.xpos[-1, box, :2] - goal),
            "lowest_upright": jnp.min(states.xmat[:, box, 2, 2]),
        }

    policy = Servos(horizon, host.nu, 25, features, HIDDEN, tuple(map(float, key.ctrl)), SCALE)
    theta = policy.initial(jax.random.key(seed), dtype)
    return study.Task(
        name="push",
        description="push a box to a place with an arm",
        scene=scene,
        horizon=horizon,
        policy=policy,
        theta=theta.at[-host.nu :].set(jnp.array(COMMAND, dtype)),
        sigma=0.05,
        start=start,
        running_cost=running_cost,
        final_cost=final_cost,
        contact_pair=("knuckle", "box"),
        metrics=metrics,
        defaults=study.StudyDefaults(families=("mjcf",), recipe=study.Recipe(0.003, 100, 64)),
    )
