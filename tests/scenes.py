"""Small scenes that the simulation's tests share: one table, each with a state in generic, active contact.

Compiled at XLA's lowest optimisation level: most of a test's time is compilation, and rounding does not matter here.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Generator
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_study.simulation import constraint, dynamics, patches
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.onset import corrected
from mjx_study.simulation.scene import Scene, load_scene, put_scene

# Budgets that leave MJX's solver to stop where its cost no longer falls: converged to rounding.
OPTION: Final = 'tolerance="1e-30" iterations="100" ls_iterations="50"'


def corrected_rollout(
    scene: Scene, model: mjx.Model, start: dynamics.State, control_law: Any, horizon: int, **options: Any
) -> tuple[dynamics.State, jax.Array, jax.Array, Any]:
    """`dynamics.rollout` with the same values, but derivatives that include an onset term, and its counts."""
    law = control_law, jnp.arange(horizon)
    last, (states, controls, residuals, _), counts = corrected(scene, model, start, *law, lambda *_: None, **options)
    return dynamics.trajectory(states, last), controls, residuals, counts


def option(timestep: float = 0.002, extra: str = "", flag: str = "") -> str:
    """An <option> with converged budgets."""
    return f'<option timestep="{timestep}" {OPTION} {extra}><flag {flag}/></option>'


def floor_scene(body: str, options: str | None = None, floor: str = "") -> str:
    """Bodies over a plane."""
    plane = f'<geom name="floor" type="plane" size="1 1 .1" {floor}/>'
    return f"<mujoco>{options or option()}<worldbody>{plane}{body}</worldbody></mujoco>"


def slider(condim: int = 3, friction: float = 0.5, mass: float = 1.0, height: float = 0.1) -> str:
    """A sphere of radius 0.1 m that translates without turning; touches the plane at z = 0.1 m."""
    axes = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    return (
        f'<body pos="0 0 {height}">{axes}<geom name="ball" size=".1" mass="{mass}" condim="{condim}" '
        f'friction="{friction} .01 .002"/></body>'
    )


DROP: Final = '<body pos="0 0 .1"><joint type="slide" axis="0 0 1"/><geom size=".1" mass="1" condim="1"/></body>'
"""A ball above the floor, or in it, that can only move up and down; without friction."""
FALLING: Final = floor_scene(DROP, option(5e-4), 'condim="1"')

FREE_BOX: Final = '<body pos="0 0 .0998"><freejoint/><geom name="box" type="box" size=".1 .12 .1" mass="1"/></body>'

CAPSULE: Final = """
<body pos="0 0 .0995" euler="0 88 0"><joint type="free" damping=".3"/>
  <geom name="capsule" type="capsule" size=".1 .15" mass="1" condim="4" friction=".6 .02 .01"/></body>"""

# A free sphere that rolls and spins on a fixed one: condim 6.
ROLLING: Final = f"""
<mujoco>{option(extra='cone="elliptic" integrator="implicitfast" impratio="2"')}
<worldbody><geom name="lower" size=".1" condim="6" friction=".7 .03 .02"/>
  <body pos=".03 .01 .1888"><joint type="slide" axis="1 0 0" damping=".4"/><joint type="slide" axis="0 1 0"/>
    <joint type="slide" axis="0 0 1"/><joint type="ball" damping=".01"/>
    <geom name="upper" size=".1" mass=".5" condim="6" friction=".7 .03 .02"/></body>
</worldbody></mujoco>"""

# Every row kind that is not a contact: limits of slide and hinge, equality of two joints, friction loss of a joint and
# a tendon, a limited tendon; actuators with activation; and a pyramidal contact.
MECHANISM: Final = f"""
<mujoco>{option()}
<worldbody><geom name="wall" type="plane" size="1 1 .1" pos="-.11 0 0" euler="0 90 0"/>
  <body><joint name="cart" type="slide" axis="1 0 0" range="-.005 .1" limited="true" damping=".5"/>
    <joint name="lift" type="slide" axis="0 0 1" frictionloss=".1"/>
    <geom name="cart" size=".1" mass="1"/>
    <body><joint name="arm" axis="0 1 0" range="-.2 .2" limited="true" damping=".05"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".3" contype="0" conaffinity="0"/></body></body>
  <body pos="0 .5 0"><joint name="follower" axis="0 0 1" frictionloss=".02"/><geom size=".05" mass=".2"/></body>
</worldbody>
<tendon><fixed name="tendon" limited="true" range="-1 .1" frictionloss=".2" damping=".1">
  <joint joint="arm" coef=".5"/><joint joint="lift" coef="1"/></fixed></tendon>
<equality><joint joint1="follower" joint2="arm" polycoef="0 1.5 .2 0 0"/></equality>
<actuator>
  <general joint="cart" dyntype="filter" dynprm=".05" gainprm="3"/>
  <general joint="arm" dyntype="integrator" gainprm="1" biastype="affine" biasprm="0 -1 -.1"
           actlimited="true" actrange="-1 1"/>
  <motor joint="lift"/>
</actuator></mujoco>"""

# Ball joint with a limit, a connect equality and an elliptic contact, by conjugate gradients.
CHAIN: Final = f"""
<mujoco>{option(extra='cone="elliptic" solver="CG"')}
<worldbody>
  <geom name="floor" type="plane" size="1 1 .1" pos="0 0 -.293"/>
  <body><joint name="ball" type="ball" range="0 .2" limited="true" damping=".02"/>
    <geom name="foot" pos="0 0 -.2" size=".1" mass=".4" friction=".4 .01 .01"/></body>
  <body name="bob" pos="0 .1 -.2"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <geom size=".05" mass=".3" contype="0" conaffinity="0"/></body>
</worldbody>
<equality><connect body1="bob" body2="world" anchor="0 .05 -.01"/></equality></mujoco>"""


def condims(cone: str, dims: tuple[int, ...]) -> str:
    """One free sphere on the plane for each condim; they do not touch each other."""
    bodies = "".join(
        f'<body pos="{i} 0 .0997"><freejoint/>'
        f'<geom size=".1" condim="{dim}" friction=".6 .03 .02" contype="1" conaffinity="2"/></body>'
        for i, dim in enumerate(dims)
    )
    floor = f'condim="{min(dims)}" contype="2" conaffinity="1"'
    return floor_scene(bodies, option(extra=f'cone="{cone}" impratio="1.5"'), floor)


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene, and a state in generic contact: penetrating, sliding, no two quantities at a tie.

    Attributes:
        source: MJCF, or the name of a shipped model.
        move: small motion added to the reference pose before anything else, in the tangent space [m or rad].
        qvel: velocities [m/s or rad/s].
        act: activations.
        control: controls.
    """

    source: str
    move: tuple[float, ...]
    qvel: tuple[float, ...]
    act: tuple[float, ...] = ()
    control: tuple[float, ...] = ()


_FREE_MOVE: Final = (0.0, 0.0, -0.001, 0.003, 0.005, 0.2)
_FREE_SPEED: Final = (0.4, 0.3, -0.1, 0.2, -0.1, 0.6)
CASES: Final = {
    "sphere-sphere condim 1": Case("pusher", (0.003, 0.0), (0.4, -0.1), control=(0.3,)),
    "capsule-plane pyramidal CG implicitfast": Case(
        floor_scene(CAPSULE, option(extra='solver="CG" integrator="implicitfast"')),
        (0.0, 0.0, 0.0, 0.01, 0.005, 0.02),
        (0.3, 0.2, -0.1, 0.3, -0.2, 0.5),
    ),
    "box-plane pyramidal": Case(floor_scene(FREE_BOX), _FREE_MOVE, _FREE_SPEED),
    "box-plane elliptic": Case(floor_scene(FREE_BOX, option(extra='cone="elliptic"')), _FREE_MOVE, _FREE_SPEED),
    "sphere-sphere condim 6 elliptic implicitfast": Case(
        ROLLING, (0.0, 0.0, 0.0, 0.1, 0.2, -0.1), (0.1, 0.3, -0.2, 0.5, -0.4, 0.3)
    ),
    "mechanism": Case(
        MECHANISM, (-0.012, 0.02, 0.23, 0.3), (-0.3, 0.2, 0.4, -0.7), act=(0.3, -0.2), control=(0.5, -0.6, 0.8)
    ),
    "chain elliptic CG": Case(CHAIN, (0.15, 0.18, 0.02, 0.01, 0.005), (0.4, -0.3, 0.6, 0.1, 0.2)),
}


def scene_of(source: str, name: str = "test", **options: Any) -> Scene:
    """A scene from an MJCF string or a shipped model's name."""
    if not source.lstrip().startswith("<"):
        return load_scene(source, tolerance=1e-30, iterations=100, ls_iterations=50, **options)
    return put_scene(mujoco.MjModel.from_xml_string(source), name, **options)


def compiled(function: Callable[..., Any], *examples: Any) -> Callable[..., Any]:
    """The function compiled for these arguments with the least optimisation."""
    return jax.jit(function).lower(*examples).compile(compiler_options={"xla_backend_optimization_level": "0"})


def run(function: Callable[..., Any], *arguments: Any) -> Any:
    """What the function gives, compiled for these arguments alone."""
    return jax.device_get(compiled(function, *arguments)(*arguments))


def in_both_modes(function: Callable[[Any], Any]) -> Callable[[Any], tuple[Any, Any, Any]]:
    """A function's value at a vector, and its Jacobian by forward and by reverse mode; linearised once."""

    def at(point: Any) -> tuple[Any, Any, Any]:
        value, push = jax.linearize(function, point)
        pull = jax.linear_transpose(push, point)
        forward = jax.vmap(push, out_axes=-1)(jnp.eye(point.shape[0]))
        return value, forward, jax.vmap(lambda row: pull(row)[0])(jnp.eye(value.shape[0]))

    return at


_PLAIN: Final = jax.make_user_context(False)


@contextlib.contextmanager
def plain_warm_start() -> Generator[None]:
    """What is traced inside is MJX's own: its solver, too.

    Its terms are MJX's, too, not those that round otherwise and have derivatives. JAX traces again what it has traced
    outside.
    """
    with pytest.MonkeyPatch.context() as patch, _PLAIN(True):
        patch.setattr(constraint, "OWN_SOLVER", False)
        patch.setattr(patches, "_REPLACED", {})
        yield


def sizes(scene: Scene) -> tuple[int, int, int, int]:
    """nq, nv, na, nu."""
    host = scene.host
    return host.nq, host.nv, host.na, host.nu


def split(scene: Scene, point: Any) -> list[Any]:
    """qpos, qvel, act, control of a flat vector."""
    return jnp.split(point, np.cumsum(sizes(scene))[:-1])


def step_flat(scene: Scene, model: mjx.Model, point: jax.Array, warmstart: jax.Array) -> tuple[jax.Array, ...]:
    """Our step on flat vectors: ((qpos, qvel, act) after it, acceleration, residual)."""
    qpos, qvel, act, control = split(scene, point)
    state, residual = dynamics.step(scene, model, dynamics.State(qpos, qvel, act, warmstart), control)
    return jnp.concatenate([state.qpos, state.qvel, state.act]), state.warmstart, residual


def stock_step_flat(scene: Scene, model: mjx.Model, point: jax.Array, warmstart: jax.Array) -> tuple[jax.Array, ...]:
    """MJX's own step on flat vectors: ((qpos, qvel, act) after it, acceleration)."""
    qpos, qvel, act, control = split(scene, point)
    data = scene.template.replace(qpos=qpos, qvel=qvel, act=act, ctrl=control, qacc_warmstart=warmstart)
    data = mjx.step(model, data)
    return jnp.concatenate([data.qpos, data.qvel, data.act]), data.qacc


def start_point(case: Case, scene: Scene) -> np.ndarray:
    """The case's state and control as a flat vector."""
    qpos = np.array(scene.template.qpos)
    mujoco.mj_integratePos(scene.host, qpos, np.array(case.move), 1.0)
    return np.concatenate([qpos, case.qvel, case.act, case.control])


def central_jacobian(function: Callable[[np.ndarray], Any], point: np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """Jacobian by central differences with one Richardson step, error O(step^4); columns over the last axis."""
    columns = []
    for index, size in enumerate(np.broadcast_to(step, point.shape)):

        def difference(distance: float, index: int = index) -> np.ndarray:
            shift = np.zeros_like(point)
            shift[index] = distance
            return (np.asarray(function(point + shift)) - np.asarray(function(point - shift))) / (2 * distance)

        columns.append((4 * difference(size / 2) - difference(size)) / 3)
    return np.stack(columns, axis=-1)


def assert_close_by_rows(actual: Any, expected: Any, tolerance: float) -> None:
    """Each row agrees relative to its own largest entry, so that small outputs count as much as large ones."""
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert np.all(np.isfinite(actual)), f"not finite: {np.argwhere(~np.isfinite(actual)).tolist()}"
    scale = np.maximum(np.abs(expected).max(axis=1, keepdims=True), 1e-12)
    worst = np.abs(actual - expected) / scale
    assert worst.max() <= tolerance, f"{worst.max():.2e} at {np.unravel_index(worst.argmax(), worst.shape)}"
