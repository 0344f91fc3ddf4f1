"""Scenes on which contact laws are compared, each a task of one number with noise on it."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp

import mjx_study as study
from experiments.quadruped import HEIGHT, MODEL
from experiments.starts import Cost, Start, task_of_start
from mjx_study.claims.thrown import BALL, box, throw
from mjx_study.simulation.dynamics import State
from mjx_study.tasks import make_task
from mjx_study.tasks.task import Task

TIMESTEP, GAP, SPREAD, WIDE = 0.005, 0.05, 0.005, 0.05  # [s], [m], [m], [m]
TOSSED: Final = (0.005, 0.002, 0.0005)  # timesteps of `toss` [s]
SPEED, RADIUS = 1.0, 0.1  # [m/s], [m]
CROUCH: Final = 0.05  # noise of a standing robot's posture [rad]
PLANE: Final = """<mujoco><option timestep="{}"/><worldbody><geom name="floor" type="plane" size="20 20 1" condim="3"/>
  {}</worldbody></mujoco>"""
THROWN: Final = """<body pos="0 0 {}"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>{}</body>"""
PITCH: Final = '<joint axis="0 1 0"/>'
SLAB: Final = '<geom name="{}" type="box" size="{} {} 0.1" mass="1" condim="3"/>'
GEOMS: Final = {
    "ball": BALL,
    "rolling": PITCH + BALL,
    "corners": PITCH
    + '<inertial pos="0 0 0" mass="1" diaginertia="0.0167 0.0167 0.0267"/>'
    + "".join(
        f'<geom name="{name}" size="0.001" pos="{x} {y} -0.099" condim="3"/>'
        for name, x, y in (("thrown", 0.199, 0.199), ("b", -0.199, 0.199), ("c", 0.199, -0.199), ("d", -0.199, -0.199))
    ),
}
"""The corners are spheres in place of the lower four of `box`."""


def on_plane(name: str, bodies: str, *numbers: Any) -> Task:
    """Return a task of one number that sets the start of bodies on a plane: `task_of_start` with these `numbers`."""
    return task_of_start(name, PLANE.format(TIMESTEP, bodies), *numbers)


def thrown(name: str, geom: str, horizon: int, start: Start, at: float, sigma: float, cost: Cost) -> Task:
    """Return a task of one number that sets the start of a ball on the ground."""
    return on_plane(name, THROWN.format(RADIUS, GEOMS[geom]), horizon, start, at, sigma, cost, ("thrown", "floor"))


def skid(geom: str = "ball") -> Task:
    """A ball that cannot turn slides to rest from a speed [m/s], or one that can until it rolls; the cost is its way
    [m]."""
    start = lambda rest, speed: State(rest.qpos, rest.qvel.at[0].set(speed[0]), rest.act, rest.warmstart)  # noqa: E731
    name = "roll" if geom == "rolling" else "skid"
    return thrown(name, geom, 60, start, SPEED, 0.1 * SPEED, lambda last: last.qpos[0])


def toss(timestep: float) -> Task:
    """A ball that can turn falls through 0.25 m, with noise of 5 cm, at 1 m/s down and along, for 0.4 s; heights in the
    cost, whose target is 0.1 m, are those above 0.3 m, where the body is in the model."""

    def start(rest: State, height: jax.Array) -> State:
        return State(rest.qpos.at[1].set(height[0]), jnp.array([SPEED, -SPEED, 0.0]), rest.act, rest.warmstart)

    cost = lambda last: 100 * (last.qpos[1] - 0.1) ** 2 + last.qpos[0] + last.qpos[1]  # noqa: E731
    mjcf = PLANE.format(timestep, THROWN.format(3 * RADIUS, GEOMS["rolling"]))
    return task_of_start("toss", mjcf, round(0.4 / timestep), start, GAP, WIDE, cost, ("thrown", "floor"))


def stack(name: str = "stack") -> Task:
    """A slab that cannot turn falls through a gap [m] at 1 m/s down and along, onto another that rests; or what falls
    has small spheres in place of its lower corners."""
    lower, upper = SLAB.format("lower", 0.3, 0.3), SLAB.format("thrown", 0.2, 0.2)
    if name != "stack":
        upper = GEOMS["corners"].removeprefix(PITCH)
    model = THROWN.format(RADIUS, lower) + THROWN.format(3 * RADIUS, upper)

    def start(rest: State, gap: jax.Array) -> State:
        moving = jnp.array([0.0, 0.0, SPEED, -SPEED])
        return State(rest.qpos.at[3].set(gap[0]), moving, rest.act, rest.warmstart)

    cost = lambda last: 100 * last.qpos[3] ** 2 + last.qpos.sum()  # noqa: E731
    return on_plane(name, model, 80, start, GAP, SPREAD, cost, ("thrown", "lower"))


@dataclasses.dataclass(frozen=True)
class Held(study.InitialStatePolicy):
    """An initial-state policy of one number whose servos hold `targets` + number * `along` [rad]."""

    targets: tuple[float, ...] = ()
    along: tuple[float, ...] = ()
    at_start: bool = dataclasses.field(default=False, init=False)

    def feedforward(self, theta: Any, noise: Any) -> jax.Array:
        held = jnp.array(self.targets) + (theta + noise[0])[0] * jnp.array(self.along)
        return jnp.broadcast_to(held, (self.horizon, self.controls))


def quadruped(posture: str) -> Task:
    """A quadruped of 13 kg whose servos hold a stance: `standing`, the number bends its legs [rad]; or `landing`, it is
    the height [m] of a fall at half a metre per second along."""
    scene = study.load_scene(MODEL)
    key = scene.host.key("stand")
    stance, targets = jnp.array(key.qpos), tuple(map(float, key.ctrl))
    falls = posture == "landing"

    def start(rest: State, number: jax.Array) -> State:
        moved = stance.at[2].add(number[0]) if falls else stance
        return State(moved, rest.qvel.at[0].set(falls * SPEED / 2), rest.act, rest.warmstart)

    horizon = 100 if falls else 200  # of 4 ms
    along = tuple(0.0 if falls else each for each in (0.0, 1.0, -2.0) * 4)
    return study.Task(
        name=f"quadruped {posture}",
        scene=scene,
        horizon=horizon,
        policy=Held(1, horizon, scene.host.nu, start, targets=targets, along=along),
        theta=jnp.full(1, GAP if falls else 0.0),
        sigma=2 * SPREAD if falls else CROUCH,
        start=study.initial_state(scene, stance),
        final_cost=lambda last: 100 * (last.qpos[2] - HEIGHT) ** 2 + last.qpos[0] + last.qpos[2],
        contact_pair=("front_left_foot", "floor"),
    )


SCENES: Final[dict[str, Callable[[], Task]]] = {
    **{
        "throw": throw,
        "skid": skid,
        "roll": partial(skid, "rolling"),
        "box": box,
        "corners": partial(box, "corners", GEOMS["corners"]),
    },
    **{f"toss {1e3 * each:g} ms": partial(toss, each) for each in TOSSED},
    **{
        "stack": stack,
        "stacked_corners": partial(stack, "stacked_corners"),
        "ball_wall": partial(make_task, "ball_wall"),
    },
    **{f"quadruped {posture}": partial(quadruped, posture) for posture in ("standing", "landing")},
}
