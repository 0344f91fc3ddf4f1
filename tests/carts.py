"""Tasks of a cart, a mass on a slide that meets nothing: each kind of policy, compiled in a third of the pusher's time.

A horizon is an option, as in the package's own tasks: `tests.carts:cart` is a task of the command line, too.
"""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco

from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import put_scene
from mjx_study.tasks.policy import InitialStatePolicy, LinearFeedback, OpenLoop
from mjx_study.tasks.task import StudyDefaults, Task

CART = """<mujoco model="cart">
  <option timestep="0.01" integrator="Euler"><flag eulerdamp="disable"/></option>
  <worldbody><body>
    <joint name="x" type="slide" axis="1 0 0" damping="0.1"/><geom name="cart" size="0.1" mass="1"/>
  </body>{wall}</worldbody>
  <actuator><motor joint="x"/></actuator>
</mujoco>"""
WALL = '<geom name="wall" size="0.1" pos="9 0 0" condim="1"/>'
"""Out of reach."""


def cart(
    running_cost=lambda state, control: jnp.sum(state.qpos**2) + jnp.sum(control**2),
    horizon: int = 5,
    adjoint: str = "auto",
    wall: str = "",
) -> Task:
    """An open loop."""
    scene = put_scene(mujoco.MjModel.from_xml_string(CART.format(wall=wall)), "cart", adjoint=adjoint)
    return Task(
        name="cart",
        description="a mass on a slide",
        scene=scene,
        horizon=horizon,
        policy=OpenLoop(horizon, 1),
        theta=jnp.linspace(0.0, 0.2, horizon),
        sigma=0.1,
        start=initial_state(scene, qpos=jnp.array([1.0])),
        running_cost=running_cost,
        final_cost=lambda state: jnp.sum(state.qvel**2),
        contact_pair=("cart", "wall") if wall else None,
        defaults=StudyDefaults(gamma=1.0) if wall else StudyDefaults(gamma=1.0, families=("mjcf",)),
    )


def walled_cart(horizon: int = 5) -> Task:
    """A cart for what needs a contact whose stiffness can be set."""
    return cart(horizon=horizon, wall=WALL)


def steered_cart() -> Task:
    """Feedback, from a start that every sample draws."""
    task = cart()

    def start(key: jax.Array) -> State:
        return initial_state(task.scene, qpos=1.0 + 0.1 * jax.random.normal(key, (1,)))

    policy = LinearFeedback(task.horizon, 1, 2, lambda state: jnp.concatenate([state.qpos, state.qvel]))
    return task.replace(name="steered cart", policy=policy, theta=jnp.array([-0.3, 0.1]), start=start)


def launched_cart() -> Task:
    """Two parameters, place and speed, before the simulation."""
    task = cart()

    def start_at(start: State, theta: jax.Array) -> State:
        return dataclasses.replace(start, qpos=theta[:1], qvel=theta[1:])

    policy = InitialStatePolicy(2, task.horizon, 1, start_at)
    return task.replace(name="launched cart", policy=policy, theta=jnp.array([1.0, -0.2]))
