"""Tasks of one number, which sets how bodies start."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

import mjx_study as study
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.scene import put_scene
from mjx_study.tasks.task import Task

Start = Callable[[State, jax.Array], State]
Cost = Callable[[Any], jax.Array]


def task_of_start(
    name: str,
    mjcf: str,
    horizon: int,
    start: Start,
    at: float,
    sigma: float,
    cost: Cost,
    pair: tuple[str, str] | None = None,
) -> Task:
    """Return the task of a start (state at rest, (1,) number) -> state, with noise sigma on the number.

    Args:
        mjcf: text of the model.
        at: the number.
        cost: final cost.
        pair: geoms whose contact is swept.
    """
    scene = put_scene(mujoco.MjModel.from_xml_string(mjcf), name)
    return study.Task(
        name=name,
        scene=scene,
        horizon=horizon,
        policy=study.InitialStatePolicy(1, horizon, 0, start),
        theta=jnp.full(1, at),
        sigma=sigma,
        start=study.initial_state(scene),
        final_cost=cost,
        contact_pair=pair,
    )
