"""Brax's own pipelines: variants `spring`, `positional` and `generalized`."""

from importlib import import_module
from typing import Any

from experiments.engines.adapters.jax_common import batched
from experiments.engines.scenes import Scene, Simulate, mjcf, mjcf_index, mjcf_state

SPIN = 1e-6
"""Angular velocity of every body at the start of `generalized` [rad/s], whose derivative at rest is NaN."""


def build(scene: Scene, timestep: float, variant: str) -> Simulate:
    """Return rollouts by one of the pipelines, with their own elasticity in place of a restitution."""
    pipeline: Any = import_module(f"brax.{variant}.pipeline")
    loader: Any = import_module("brax.io.mjcf")
    is_velocity, index = mjcf_index(scene)
    qpos, qvel = mjcf_state(scene, scene.center)
    if variant == "generalized" and len(qpos) > 1:
        qvel.reshape(-1, 6)[:, 3:] = SPIN

    def final_positions(jax, theta):
        jnp = jax.numpy
        system = loader.loads(mjcf(scene, timestep))
        system = system.replace(elasticity=jnp.full_like(system.elasticity, scene.restitution))
        position, velocity = jnp.asarray(qpos), jnp.asarray(qvel)
        if is_velocity:
            velocity = velocity.at[index].set(theta)
        else:
            position = position.at[index].set(theta)
        start = pipeline.init(system, position, velocity)

        def advance(state, _):
            return pipeline.step(system, state, jnp.zeros(system.act_size())), None

        last, _ = jax.lax.scan(advance, start, length=scene.steps(timestep))
        inertia = system.link.inertia.transform
        return jax.vmap(lambda x, inner: x.do(inner).pos)(last.x, inertia)

    return batched(scene, final_positions)
