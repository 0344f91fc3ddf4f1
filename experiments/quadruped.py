"""A quadruped that must walk, through MuJoCo's default contact: a task of a user, as docs/extending.md describes.

docs/robots.md trains it as `experiments.quadruped:walk`; its model is models/quadruped.xml.
"""

import dataclasses
from pathlib import Path
from typing import Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

import mjx_study as study
from mjx_study.simulation.observation import ObservedState
from mjx_study.tasks.network import Network

MODEL: Final = Path(__file__).parents[1] / "models" / "quadruped.xml"
FEET: Final = tuple(f"{end}_{side}_foot" for end in ("front", "hind") for side in ("left", "right"))
PACE: Final = 0.5  # speed to walk at [m/s]
HEIGHT: Final = 0.3  # height of the trunk to keep [m]
SCALE: Final = 0.3  # change of a servo's target per unit of the network's output [rad]
HIDDEN: Final = (64, 32)


@dataclasses.dataclass(frozen=True)
class Servos(Network):
    """A network that changes the targets of the position servos.

    Attributes:
        stand: targets [rad] of a network with zero output.
        scale: change of a target per unit of the network's output [rad].
    """

    stand: tuple[float, ...]
    scale: float

    def feedback(self, theta: Array, state: study.State) -> Float[Array, " nu"]:
        return jnp.array(self.stand) + self.scale * super().feedback(theta, state)


def rotation(quaternion: Float[Array, " 4"]) -> Float[Array, "3 3"]:
    """Rotation from the trunk's frame to the world's; its last row is the vertical in the trunk's frame."""
    w, x, y, z = quaternion
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def walk(horizon: int = 256, seed: int = 0) -> study.Task:
    """Return a second of walking from a disturbed stance.

    The cost is the time integral of the squared deviation from `PACE` straight ahead, plus leaning, sinking, turning,
    and leaving the stance; 1 is the cost of a second at rest.

    Args:
        horizon: steps of 4 ms.
        seed: of the network's initial weights.
    """
    scene = study.load_scene(MODEL)
    key = scene.host.key("stand")
    stance, targets = jnp.array(key.qpos), jnp.array(key.ctrl)
    step = scene.timestep

    def start(key: Key[Array, ""]) -> study.State:
        drawn = jax.random.normal(key, (36,))
        qpos = stance.at[3:].add(0.05 * drawn[:16]).at[2].add(0.02 * jnp.abs(drawn[16]))
        qpos = qpos.at[3:7].divide(jnp.linalg.norm(qpos[3:7]))
        return study.initial_state(scene, qpos, 0.1 * drawn[18:])

    def features(state: study.State) -> Float[Array, " 34"]:
        turn = rotation(state.qpos[3:7])
        parts = state.qpos[2:3] - HEIGHT, turn[2], state.qvel[:3] @ turn, state.qvel[3:6] / 5
        return jnp.concatenate([*parts, state.qpos[7:] - targets, state.qvel[6:] / 10])

    def running_cost(state: ObservedState, control: Array) -> Array:
        vertical, velocity = rotation(state.qpos[3:7])[2], state.qvel
        pace = ((velocity[0] - PACE) ** 2 + velocity[1] ** 2 + 0.1 * velocity[5] ** 2) / PACE**2
        leaning, sinking = jnp.sum(vertical[:2] ** 2), (state.qpos[2] - HEIGHT) ** 2
        stance = jnp.mean((control - targets) ** 2)
        return step * (pace + 5 * leaning + 50 * sinking + 0.2 * stance)

    def metrics(states: ObservedState) -> dict[str, Array]:
        feet = states.geom_xpos[:, jnp.array([scene.geom(foot) for foot in FEET])]
        return {
            "distance": states.qpos[-1, 0] - states.qpos[0, 0],
            "lowest_trunk": jnp.min(states.qpos[:, 2]),
            "highest_foot": jnp.max(feet[..., 2]),
        }

    policy = Servos(horizon, scene.host.nu, 34, features, HIDDEN, tuple(map(float, key.ctrl)), SCALE)
    return study.Task(
        name="walk",
        description="walk with a quadruped",
        scene=scene,
        horizon=horizon,
        policy=policy,
        theta=policy.initial(jax.random.key(seed), scene.template.qpos.dtype),
        sigma=0.1,
        start=start,
        running_cost=running_cost,
        contact_pair=None,
        metrics=metrics,
        defaults=study.StudyDefaults(families=("mjcf",), recipe=study.Recipe(0.003, 200, 128)),
    )
