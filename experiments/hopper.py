"""A one-legged hopper that lands on its foot through MuJoCo's default contact and shall move forward.

A task in one file, as docs/extending.md describes; docs/in-the-wild.md trains it as `experiments.hopper:hopper`.
"""

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Key

import mjx_study as study

MJCF = """
<mujoco model="hopper">
  <option timestep="0.005" iterations="20" ls_iterations="10" tolerance="1e-10"/>
  <default>
    <joint axis="0 1 0" damping="1" armature="0.02" limited="true"/>
    <geom type="capsule" size="0.04" contype="0" conaffinity="0"/>
  </default>
  <worldbody>
    <geom name="floor" type="plane" size="10 1 1" contype="1"/>
    <body name="torso" pos="0 0 0.9">
      <joint name="x" type="slide" axis="1 0 0" limited="false" damping="0" armature="0"/>
      <joint name="z" type="slide" axis="0 0 1" limited="false" damping="0" armature="0"/>
      <joint name="pitch" type="hinge" limited="false" damping="0" armature="0"/>
      <geom name="torso" fromto="0 0 0 0 0 0.3" size="0.06" mass="5" conaffinity="1"/>
      <body name="thigh">
        <joint name="hip" range="-90 60"/>
        <geom fromto="0 0 0 0 0 -0.4" mass="2"/>
        <body name="shin" pos="0 0 -0.4">
          <joint name="knee" range="0 130"/>
          <geom fromto="0 0 0 0 0 -0.4" mass="1"/>
          <body name="foot" pos="0 0 -0.4">
            <joint name="ankle" range="-60 60"/>
            <geom name="foot" fromto="-0.08 0 -0.03 0.16 0 -0.03" mass="0.5" conaffinity="1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="hip" gear="60"/>
    <motor joint="knee" gear="60"/>
    <motor joint="ankle" gear="30"/>
  </actuator>
</mujoco>"""
BENT = jnp.array([-0.4, 0.8, -0.4])
"""Hip, knee and ankle in the air [rad]."""


def hopper(horizon: int = 100) -> study.Task:
    """Half a second from a random fall; the cost is minus the distance, and of leaning, crouching and torque."""
    scene = study.put_scene(mujoco.MjModel.from_xml_string(MJCF), "hopper")
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
