"""Steps of more degrees of freedom than XLA unrolls, in native code: the engine's, with their derivatives."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from experiments.values import EDGES, compared
from mjx_study.graph import operation, scalars
from mjx_study.graph.build import known_libraries
from mjx_study.graph.native import SWITCH, native_identity, native_summary
from mjx_study.simulation import dynamics
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.drop_in import step
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.linear_algebra import MOST_UNROLLED
from mjx_study.simulation.observation import observed
from mjx_study.simulation.scene import Scene, put_scene
from tests.scenes import compiled

pytestmark = pytest.mark.skipif(native_identity() is None, reason="there is no C compiler")

# A trunk on one leg of three joints, with a servo, a limit, and a spherical foot on the floor: nine degrees of freedom.
ONE_LEG = """<mujoco><option timestep=".004" integrator="implicitfast" iterations="{}" ls_iterations="50"
tolerance="1e-15"/><default><joint armature=".01" damping=".1"/><geom friction=".7" conaffinity="0"/></default>
<worldbody><geom type="plane" size="2 2 .1" contype="0" conaffinity="1"/><body pos="0 0 .4"><freejoint/>
<geom type="box" size=".1 .05 .04" mass="2" contype="0"/><site name="trunk"/>
<body pos="0 0 -.04"><joint axis="1 0 0" range="-40 2"/><geom size=".03" mass=".2" contype="0"/>
<body><joint name="hip" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.15" size=".015" mass=".3" contype="0"/>
<body pos="0 0 -.15"><joint name="knee" axis="0 1 0"/><geom pos="0 0 -.15" size=".02" mass=".1"/>
</body></body></body></body></worldbody>
<actuator><position joint="hip" kp="20" kv=".5"/><position joint="knee" kp="20" kv=".5"/></actuator>
<sensor><framelinvel objtype="site" objname="trunk"/></sensor></mujoco>"""
BALL = """<mujoco><option timestep=".004" iterations="50" tolerance="1e-15"/><worldbody>
<geom type="plane" size="1 1 .1" condim="1"/><body pos="0 0 .09"><joint type="slide" axis="0 0 1"/>
<geom size=".1" condim="1" solimp=".5 .95 .1"/></body></worldbody></mujoco>"""
FIELD = """<mujoco><option timestep=".004" iterations="50" ls_iterations="50" tolerance="1e-15"/>
<asset><hfield name="h" nrow="9" ncol="8" size="1 1 .2 .1" elevation="{}"/></asset>
<worldbody><geom type="hfield" hfield="h"/><body><freejoint/><geom size=".12" mass="1"/></body></worldbody></mujoco>"""
SAMPLES = 11


@cache
def one_leg(iterations: int = 100) -> Scene:
    return put_scene(mujoco.MjModel.from_xml_string(ONE_LEG.format(iterations)), "one leg")


@cache
def states(host: mujoco.MjModel, count: int = SAMPLES) -> list[np.ndarray]:
    """States of the engine after drops from random poses, most in contact, with controls: (samples, ...)."""
    draw, data, found = np.random.default_rng(0), mujoco.MjData(host), []
    while len(found) < count:
        mujoco.mj_resetData(host, data)
        if host.nkey:
            mujoco.mj_resetDataKeyframe(host, data, 0)
        data.qvel = 0.5 * draw.normal(size=host.nv)
        data.ctrl += 0.3 * draw.normal(size=host.nu)
        mujoco.mj_step(host, data, int(draw.integers(20, 120)))
        found.append((data.qpos.copy(), data.qvel.copy(), data.ctrl.copy(), data.qacc_warmstart.copy(), data.ncon))
    *arrays, contacts = (np.stack(each) for each in zip(*found, strict=True))
    assert np.sum(contacts > 0) > count / 2
    return arrays


def advanced(scene: Scene, qpos: Any, qvel: Any, control: Any, warmstart: Any) -> tuple[State, Any]:
    state = State(qpos, qvel, jnp.zeros(0), warmstart)
    return dynamics.step(scene, scene.model, state, control)


def pulled(scene: Scene, adjoints: Any, *point: Any) -> Any:
    def after(qpos, qvel, control):
        following, _ = advanced(scene, qpos, qvel, control, point[3])
        return following.qpos, following.qvel

    return jax.vjp(after, *point[:3])[1](tuple(adjoints))


def by_engine(host: mujoco.MjModel, qpos: Any, qvel: Any, control: Any, steps: int = 1) -> mujoco.MjData:
    data = mujoco.MjData(host)
    data.qpos, data.qvel, data.ctrl = qpos, qvel, control
    mujoco.mj_step(host, data, steps)
    return data


def test_steps_are_the_engines_and_derivatives_those_of_the_values() -> None:
    """In contact; reverse mode builds two libraries: the solved step, and the transpose of its derivative."""
    scene, point = one_leg(), states(one_leg().host)
    assert scene.host.nv > MOST_UNROLLED and scene.uses_graph and not scene.forms_matrix
    draw, before = np.random.default_rng(1), set(known_libraries())
    adjoints = [draw.normal(size=each.shape) for each in point[:2]]
    values = compiled(jax.vmap(lambda *point: advanced(scene, *point)), *point)
    pull = compiled(jax.vmap(lambda adjoints, *point: pulled(scene, adjoints, *point)), adjoints, *point)
    assert len(set(known_libraries()) - before) == 2
    after, residual = values(*point)
    assert np.max(residual) < 1e-12
    for at in range(SAMPLES):
        engine = by_engine(scene.host, *(each[at] for each in point[:3]))
        np.testing.assert_allclose(after.qvel[at], engine.qvel, rtol=0, atol=1e-8)
        np.testing.assert_allclose(after.qpos[at], engine.qpos, rtol=0, atol=1e-10)
    for place, found in enumerate(pull(adjoints, *point)):
        direction, size = draw.normal(size=found.shape), 1e-6
        ends = [list(point), list(point)]
        for end, sign in zip(ends, (1, -1), strict=True):
            end[place] = point[place] + sign * size * direction
        high, low = (values(*end)[0] for end in ends)
        slopes = sum(
            np.sum(adjoint * (np.asarray(one) - other), axis=1) / (2 * size)
            for adjoint, one, other in zip(adjoints, (high.qpos, high.qvel), (low.qpos, low.qvel), strict=True)
        )
        np.testing.assert_allclose(np.sum(direction * found, axis=1), slopes, rtol=1e-5, atol=1e-6)


def test_what_costs_ask_for_is_computed_natively() -> None:
    """Through XLA, every quantity that a cost reads would bring MJX's whole kinematics into a rollout's program."""
    scene, (qpos, qvel, *_) = one_leg(), states(one_leg().host)

    def seen(qpos, qvel):
        state = observed(scene, State(qpos, qvel, jnp.zeros(0), jnp.zeros_like(qvel)))
        return state.xpos, state.geom_xlinvel

    program = str(jax.make_jaxpr(seen)(qpos[0], qvel[0]))
    assert program.count("native[") == 2 and "dot_general" not in program
    positions, velocities = jax.jit(jax.vmap(seen))(qpos, qvel)
    for at in range(SAMPLES):
        data = mujoco.MjData(scene.host)
        data.qpos, data.qvel, velocity = qpos[at], qvel[at], np.zeros(6)
        mujoco.mj_forward(scene.host, data)
        np.testing.assert_allclose(positions[at], data.xpos, rtol=0, atol=1e-12)
        for geom, found in enumerate(velocities[at]):
            mujoco.mj_objectVelocity(scene.host, data, mujoco.mjtObj.mjOBJ_GEOM, geom, velocity, 0)
            np.testing.assert_allclose(found, velocity[3:], rtol=0, atol=1e-10)


def last(qvel: Any, control: Any, qpos: Any) -> mjx.Data:
    """Data after two drop-in steps."""
    scene = one_leg()
    start = scene.template.replace(qpos=qpos, qvel=qvel, ctrl=control)
    return jax.lax.scan(lambda data, _: (step(scene.model, data), None), start, length=2)[0]


def test_the_drop_in_step_computes_natively_and_fills_every_field() -> None:
    qpos, qvel, control, _ = states(one_leg().host)
    point = qvel, control, qpos
    program = str(jax.make_jaxpr(jax.vmap(last))(*point))
    assert program.count("native[") == 1 and "while[" not in program
    data = compiled(jax.vmap(last), *point)(*point)
    for at in range(SAMPLES):
        engine = by_engine(one_leg().host, *(each[at] for each in (qpos, qvel, control)), steps=2)
        for name in ("qpos", "qvel", "qacc", "time", "xpos", "sensordata", "qfrc_constraint", "qacc_warmstart"):
            expected = getattr(engine, name)
            scale = np.max(np.abs(expected), initial=1.0)
            np.testing.assert_allclose(getattr(data, name)[at], expected, rtol=0, atol=1e-7 * scale, err_msg=name)


@pytest.mark.parametrize("fields", ["state", pytest.param("others", marks=pytest.mark.slow)])
def test_gradients_of_the_drop_in_step_are_those_of_its_values(fields: str) -> None:
    """Through the state, natively, without MJX's matrix products; and through what MJX computes from it."""

    def cost(*point):
        data = last(*point)
        others = jnp.sum(data.sensordata) + jnp.sum(data.xpos[-1] ** 2) if fields == "others" else 0.0
        return jnp.sum(data.qpos**2) + others

    qpos, qvel, control, _ = states(one_leg().host)
    slope = jax.vmap(jax.grad(cost, (0, 1)))
    found = compiled(slope, qvel, control, qpos)(qvel, control, qpos)
    if fields == "state":
        assert "dot_general" not in jax.jit(slope).lower(qvel, control, qpos).as_text()
    draw = np.random.default_rng(0)
    ways = [1e-6 * draw.normal(size=each.shape) for each in (qvel, control)]
    values = compiled(jax.vmap(cost), qvel, control, qpos)
    high, low = (values(qvel + sign * ways[0], control + sign * ways[1], qpos) for sign in (1, -1))
    along = sum(np.sum(way * each, axis=1) for way, each in zip(ways, found, strict=True))
    np.testing.assert_allclose(along / 1e-6, (high - low) / 2e-6, rtol=1e-5, atol=1e-6)


def test_applied_forces_have_derivatives() -> None:
    """Of a ball in the air: h / m, along the joint and in the world."""
    host = mujoco.MjModel.from_xml_string(BALL.replace('pos="0 0 .09"', 'pos="0 0 .5"'))
    model, data = mjx.put_model(host), mjx.make_data(host)

    def speed(along, world):
        applied = data.replace(qfrc_applied=along, xfrc_applied=data.xfrc_applied.at[1, 2].set(world))
        return step(model, applied).qvel[0]

    point = jnp.array([0.3]), jnp.array(0.2)
    assert str(jax.make_jaxpr(speed)(*point)).count("native[") == 1
    along, world = compiled(jax.grad(speed, (0, 1)), *point)(*point)
    np.testing.assert_allclose([along[0], world], host.opt.timestep / host.body_mass[1], rtol=1e-12)


@pytest.mark.parametrize("why", ["budget", "model", "switch", "size"])
def test_what_is_not_solved_natively_is_left_to_mjx(monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    """A small budget of the solver, which native code would exceed; a traced model; by choice; beyond the limit."""
    scene = one_leg(3 if why == "budget" else 100)
    if why == "switch":
        monkeypatch.setenv(SWITCH, "xla")
    if why == "size":
        monkeypatch.setattr(scalars, "MOST_NATIVE", dict.fromkeys(scalars.MOST_NATIVE, 5000))
    one = lambda data, model=scene.model: step(model, data).qpos  # noqa: E731
    program = jax.make_jaxpr(one)(scene.template, *([scene.model] if why == "model" else []))
    assert "native[" not in str(program) and "while[" in str(program)
    if why in ("switch", "size"):
        program = jax.make_jaxpr(lambda *point: pulled(scene, [point[0], point[1]], *point))(
            *(each[0] for each in states(scene.host))
        )
        assert "native[" not in str(program) and "while[" in str(program)
    assert why != "size" or ": more than 5000 operations" in native_summary()


@pytest.mark.parametrize("most", [0, operation.MOST_DIFFERENTIATED])
@pytest.mark.parametrize("outer", [jax.jacfwd, pytest.param(jax.jacrev, marks=pytest.mark.slow)])
def test_second_derivatives_of_large_maps_are_those_of_jax(
    monkeypatch: pytest.MonkeyPatch, most: int, outer: Any
) -> None:
    """A ball in the floor, whose stiffness varies with depth; of first derivatives in either mode."""
    monkeypatch.setattr(operation, "MOST_DIFFERENTIATED", most)
    scene = put_scene(mujoco.MjModel.from_xml_string(BALL), "ball")

    def speed(depth):
        return jnp.sum(step(scene.model, scene.template.replace(qpos=-depth)).qvel)

    depth, size = jnp.array([0.02]), 1e-5
    found = [compiled(outer(inner(speed)), depth)(depth).item() for inner in (jax.jacfwd, jax.jacrev)]
    slope = compiled(jax.jacfwd(speed), depth)
    expected = (slope(depth + size) - slope(depth - size)).item() / (2 * size)
    assert abs(expected) > 1
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_a_ball_on_a_height_field(monkeypatch: pytest.MonkeyPatch) -> None:
    """Values and gradients are those through XLA, all over the field and beyond its edges, in and out of contact.

    But for a few samples: where the contacts of several prisms coincide, rounding decides how many of them MJX counts.
    """
    draw = np.random.default_rng(0)
    host = mujoco.MjModel.from_xml_string(FIELD.format(" ".join(map(str, draw.uniform(size=72).round(3)))))
    model, data = mjx.put_model(host), mjx.make_data(host)
    qpos = np.zeros((200, 7))
    qpos[:, :3], qpos[:, 3] = draw.uniform((-1.4, -1.4, 0), (1.4, 1.4, 0.4), (200, 3)), 1

    def speed(qpos):
        qvel = step(model, data.replace(qpos=qpos)).qvel
        return jnp.sum(qvel**2), qvel

    found = []
    for switch in ("1", "xla"):
        monkeypatch.setenv(SWITCH, switch)
        found.append(jax.jit(jax.vmap(jax.value_and_grad(speed, has_aux=True)))(qpos))
    ((_, qvel), slopes), ((_, expected), expected_slopes) = found
    touching = np.abs(expected[:, 2] + 9.81 * host.opt.timestep) > 1e-9
    assert 20 < np.sum(touching) < 180
    same = np.max(np.abs(qvel - expected), axis=1) < 1e-10 * np.max(np.abs(expected))
    assert np.mean(same[touching]) > 0.9 and np.all(same[~touching])
    scale = np.max(np.abs(expected_slopes))
    np.testing.assert_allclose(slopes[same], expected_slopes[same], rtol=0, atol=1e-8 * scale)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "to_engine"),
    [("quadruped", 1e-11), ("arm", 1e-11), ("humanoid", 1e-11), ("barkour_v0", 2e-5), (EDGES, 1e-11)],
)
def test_steps_and_derivatives_are_those_of_stock_mjx(name: str, to_engine: float) -> None:
    """From states in contact, and in the C engine's distance, which MJX's edges of height fields make larger."""
    found = compared(name, 8, path=0)
    assert np.mean(np.array(found["contacts"]["ours"]) > 0) > 0.5
    assert found["contacts"]["ours"] == found["contacts"]["stock"] == found["contacts"]["engine"]
    assert max(found["step"]["ours - stock"]) < 1e-11 and max(found["slopes"]) < 1e-6
    assert max(found["step"]["ours - engine"]) < to_engine
    assert name != "barkour_v0" or max(found["step"]["ours - engine"]) > 1e-8
