"""Bodies thrown at a plane, whose height is the parameter: what touches is a point, or the corners of a box."""

import dataclasses
from collections.abc import Callable
from typing import Final

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import put_scene
from mjx_study.tasks.policy import InitialStatePolicy
from mjx_study.tasks.task import Task

MJCF: Final = """<mujoco><option timestep="0.005"/><worldbody>
  <geom name="floor" type="plane" size="20 20 1" condim="3"/>
  <body pos="0 0 0.1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>{}</body>
</worldbody></mujoco>"""
BALL: Final = '<geom name="thrown" size="0.1" mass="1" condim="3"/>'
BOX: Final = '<joint axis="0 1 0"/><geom name="thrown" type="box" size="0.2 0.2 0.1" mass="1" condim="3"/>'
HORIZON: Final = 80
GAP, SIGMA, SPEED, TILT = 0.05, 0.005, 1.0, 0.2  # [m], [m], [m/s], [rad]


def throw() -> Task:
    """A ball of 1 kg that cannot turn falls through a gap [m] at 1 m/s down and along, for 0.4 s."""
    return _thrown("throw", BALL, [0.0], [SPEED, -SPEED])


def box(name: str = "box", body: str = BOX) -> Task:
    """A box of 1 kg, tilted by 0.2 rad, falls through a gap [m] below its lower edge, which lands before the other, at
    1 m/s down and 0.5 m/s along; or another body of that size."""
    above = 0.2 * np.sin(TILT) + 0.1 * np.cos(TILT) - 0.1
    return _thrown(name, body, [above, TILT], [SPEED / 2, -SPEED, 0.0])


def _thrown(name: str, body: str, rest: list[float], velocity: list[float]) -> Task:
    """A body at a height above `rest`; its cost is its way, its height and a hundred times the square of that."""
    scene = put_scene(mujoco.MjModel.from_xml_string(MJCF.format(body)), name)
    lowest = jnp.asarray([0.0, *rest])

    def start_at(start: State, gap: Float[Array, " params"]) -> State:
        return dataclasses.replace(start, qpos=lowest.at[1].add(gap[0]), qvel=jnp.asarray(velocity))

    return Task(
        name=name,
        scene=scene,
        horizon=HORIZON,
        policy=InitialStatePolicy(1, HORIZON, 0, start_at, "m"),
        theta=jnp.full(1, GAP),
        sigma=SIGMA,
        start=initial_state(scene),
        final_cost=lambda last: 100 * last.qpos[1] ** 2 + last.qpos.sum(),
        contact_pair=("thrown", "floor"),
    )


THROWN: Final[dict[str, Callable[[], Task]]] = {"throw": throw, "box": box}  # tasks of the ledger alone, by name
