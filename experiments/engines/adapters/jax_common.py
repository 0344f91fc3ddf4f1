"""Rollouts of engines written in JAX: one compiled program for many parameters."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from experiments.engines.scenes import Rollout, Scene, Simulate, mjcf_index

CHUNK = 100  # parameters per call of the program


def started(jax: Any, scene: Scene, state: tuple[np.ndarray, np.ndarray], theta: Any) -> tuple[Any, Any]:
    """Return positions and velocities of a state of `scenes.mjcf` with the parameter in its place."""
    is_velocity, index = mjcf_index(scene)
    parts = [jax.numpy.asarray(part) for part in state]
    parts[is_velocity] = parts[is_velocity].at[index].set(theta)
    return parts[0], parts[1]


def batched(scene: Scene, final_positions: Callable[[Any, Any], Any], *, forward: bool = False) -> Simulate:
    """Return rollouts by a function of JAX's module and the parameter that returns the bodies' final positions.

    Args:
        forward: whether to differentiate in forward mode.
    """
    jax.config.update("jax_enable_x64", True)

    def cost(theta):
        positions = final_positions(jax, theta)
        return scene.cost(positions), positions

    def one(theta):
        if forward:
            value, derivative, positions = jax.jvp(cost, (theta,), (jax.numpy.ones_like(theta),), has_aux=True)
        else:
            (value, positions), derivative = jax.value_and_grad(cost, has_aux=True)(theta)
        return value, derivative, positions

    program = jax.jit(jax.vmap(one))

    def simulate(thetas: np.ndarray) -> Rollout:
        padded = np.resize(thetas, -(-len(thetas) // CHUNK) * CHUNK)
        parts = [program(part) for part in padded.reshape(-1, CHUNK)]
        return Rollout(*(np.concatenate([np.asarray(part[i]) for part in parts])[: len(thetas)] for i in range(3)))

    return simulate
