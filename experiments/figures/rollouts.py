"""Rollouts without noise of the tasks, and colours of the figures."""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

from mjx_study.objective import rollout_cost
from mjx_study.render.drawing import PALETTE
from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task

BLUE, ORANGE, GREEN, PINK, SKY, YELLOW = PALETTE
GREY, INK, WALL = "0.45", "0.2", "#B4B4B4"
TARGET = (0.0, 2.5)  # of tennis [m]
CRITICAL = math.exp(-2)  # restitution of a critically damped spring that lets go when its force ends
SLOW = 10.0  # tennis: a second of MJX is ten of the paper's and the reference's


class Runs(NamedTuple):
    """A batch of rollouts without noise; axes (rollout, time, coordinate)."""

    qpos: Any
    qvel: Any
    cost: Any


@cache
def task_of(name: str, **options: float) -> Task:
    """Return a task; one object per set of options, so that each compiles once."""
    return make_task(name, **options)


@cache
def program(task: Task) -> Callable[..., Runs]:
    """Return compiled rollouts of a batch of (theta, start); the contact model is an argument too."""

    def one(theta, start, contact):
        cost, (states, *_) = rollout_cost(task, theta, contact, start, jnp.zeros(task.policy.noise_shape))
        return Runs(states.qpos, states.qvel, cost)

    return jax.jit(jax.vmap(one, in_axes=(0, 0, None)), compiler_options={"xla_backend_optimization_level": "0"})


def run(task: Task, thetas: np.ndarray, contact: ContactModel | None, starts: State | None = None) -> Runs:
    """Roll out a batch of thetas, from the task's start by default."""
    if starts is None:
        assert isinstance(task.start, State)
        starts = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(thetas), *leaf.shape)), task.start)
    return jax.device_get(program(task)(jnp.asarray(thetas, float), starts, contact))


def contact_of(task: Task, family: str, stiffness: float) -> ContactModel:
    """Return a contact model as `mjx-study compare` makes it."""
    ((cell,), _) = family_grid(task, [family], [stiffness])
    assert cell.contact is not None
    return cell.contact


def tennis_starts(task: Task, slow: np.ndarray) -> State:
    """Return start states from (ball x, y, vx, vy, paddle x, y, angle), with velocities in slow time."""

    def one(drawn):
        qvel = jnp.concatenate([SLOW * drawn[2:4], jnp.zeros(3)])
        return initial_state(task.scene, jnp.concatenate([drawn[:2], drawn[4:]]), qvel)

    return jax.vmap(one)(jnp.asarray(slow))


def returning_gains() -> np.ndarray:
    """Return a policy written by hand: the paddle follows the ball and turns a little."""
    gains = np.zeros((3, 7))
    gains[0, 0], gains[0, 4], gains[2, 0] = 1.5, -1.5, 0.05
    return gains


def note(axes: Axes, x: float, y: float, text: str, colour: str = INK, **options) -> None:
    """Write text, with its colour darkened until it is legible."""
    shade = tuple(0.8 * part for part in to_rgb(colour))
    axes.text(x, y, text, color=shade, fontsize=8.5, **{"ha": "center", "va": "center", "zorder": 6} | options)
