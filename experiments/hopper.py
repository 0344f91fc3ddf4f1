"""A one-legged hopper that must land on its foot, through MuJoCo's default contact, and move forward.

A task of a user, as docs/extending.md describes; docs/in-the-wild.md trains it as `experiments.hopper:hopper`.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

import mjx_study as study
from experiments import DATA

BENT = jnp.array([-0.4, 0.8, -0.4])  # angles of hip, knee and ankle in the air [rad]


def hopper(horizon: int = 100) -> study.Task:
    """Return half a second from a random fall; the cost is minus the distance, plus leaning, crouching and torque."""
    scene = study.load_scene(DATA / "hopper.xml")
    step = scene.timestep

    def start(key: Key[Array, ""]) -> study.State:
        low = jnp.array([0.0, -0.06, -0.1, -0.1, -0.1, -0.1, 0.0, -1.0, -0.5, 0.0, 0.0, 0.0])
        high = jnp.array([0.0, 0.04, 0.1, 0.1, 0.1, 0.1, 1.0, 0.0, 0.5, 0.0, 0.0, 0.0])
        drawn = jax.random.uniform(key, (12,), minval=low, maxval=high)
        return study.initial_state(scene, drawn[:6].at[3:].add(BENT), drawn[6:])

    def running_cost(state: study.State, control: Array) -> Array:
        leaning, sinking = state.qpos[2], jnp.minimum(state.qpos[1] + 0.1, 0.0)
        return step * (-state.qvel[0] + 2 * leaning**2 + 10 * sinking**2 + 0.05 * jnp.sum(control**2))

    features = lambda state: jnp.concatenate([state.qpos[1:], state.qvel])  # noqa: E731
    return study.Task(
        name="hopper",
        description="move forward after a fall onto one leg",
        scene=scene,
        horizon=horizon,
        policy=study.LinearFeedback(horizon, 3, 11, features),
        theta=jnp.zeros(3 * 11),
        sigma=0.3,
        start=start,
        running_cost=running_cost,
        final_cost=lambda state: jnp.zeros(()),
        contact_pair=None,
        defaults=study.StudyDefaults(families=("mjcf",), recipe=study.Recipe(0.003, 300, 64)),
    )
