"""The step against `mjx.step`, and its derivatives against central differences, over a table of scenes."""

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_study.graph.native import native_summary
from mjx_study.simulation import constraint, dynamics
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import ContactModel, apply_contact, contact_model
from mjx_study.simulation.engine import engine_model
from mjx_study.simulation.integration import integrate_position
from mjx_study.simulation.scene import Scene
from tests.scenes import (
    CASES,
    assert_close_by_rows,
    central_jacobian,
    compiled,
    floor_scene,
    in_both_modes,
    option,
    plain_warm_start,
    run,
    scene_of,
    sizes,
    slider,
    split,
    start_point,
    step_flat,
    stock_step_flat,
)

# What the other cases already cover is left to `make test-all`.
SLOW = ("capsule-plane pyramidal CG implicitfast", "box-plane pyramidal", "box-plane elliptic", "chain elliptic CG")
MARKED = [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in CASES]


@dataclasses.dataclass(frozen=True, eq=False)
class Prepared:
    """A scene in generic contact and its compiled step."""

    scene: Scene
    step: Callable[..., Any]
    point: np.ndarray
    warmstart: np.ndarray

    def run(self, point: Any) -> np.ndarray:
        """State after one step."""
        return np.asarray(self.step(self.scene.model, jnp.asarray(point), self.warmstart)[0])


@cache
def prepare(name: str) -> Prepared:
    """A case, two steps after its start."""
    case = CASES[name]
    scene = scene_of(case.source)
    point, warmstart = start_point(case, scene), np.zeros(scene.host.nv)
    step = compiled(lambda *args: step_flat(scene, *args), scene.model, point, warmstart)
    for _ in range(2):
        after, warmstart, _ = step(scene.model, point, warmstart)
        point = np.concatenate([after, case.control])
    return Prepared(scene, step, point, np.asarray(warmstart))


@cache
def jacobian(name: str) -> np.ndarray:
    """The graph's, in reverse mode."""
    case = prepare(name)
    scene = case.scene
    assert scene.uses_graph

    def after(point):
        return step_flat(scene, scene.model, point, jnp.asarray(case.warmstart))[0]

    return np.asarray(compiled(jax.jacrev(after), case.point)(case.point))


def polished_step(scene: Scene, model, point: jax.Array, nearby: np.ndarray) -> jax.Array:
    """A step whose acceleration solves the constraints to rounding, by Newton's method from one nearby.

    MJX stops where its cost no longer falls, which with cones or conjugate gradients leaves an acceleration 1e-8 off:
    harmless, but not to differences of 3e-6. Newton's method on the equation itself has no such floor.
    """
    qpos, qvel, act, control = split(scene, point)
    data = dynamics.force_stage(model, dynamics.position_stage(scene, model, qpos), qvel, act, control)

    def newton(qacc, _):
        gap = lambda qacc: constraint.imbalance(model, data, qacc)  # noqa: E731
        return qacc - jnp.linalg.solve(jax.jacfwd(gap)(qacc), gap(qacc)), None

    qacc, _ = jax.lax.scan(newton, jnp.asarray(nearby), length=3)
    qvel, act = dynamics.advance_velocity(model, data, qacc)
    return jnp.concatenate([integrate_position(scene.host, qpos, qvel, model.opt.timestep), qvel, act])


@cache
def numeric_jacobian(name: str) -> np.ndarray:
    """By central differences of a step converged to rounding.

    The shortest length is the 1 mm over which the impedance rises; 3e-6 of differences leave (3e-3)^4 of curvature
    and 1e-16 / 3e-6 of rounding.
    """
    case = prepare(name)
    _, solved, _ = case.step(case.scene.model, case.point, case.warmstart)
    program = compiled(lambda point: polished_step(case.scene, case.scene.model, point, solved), case.point)
    np.testing.assert_allclose(program(case.point), case.run(case.point), atol=1e-7)
    return central_jacobian(program, case.point, 3e-6)


def test_a_velocity_servo_is_implicit_under_implicitfast() -> None:
    """f = kv (u - v), taken at the end of the step: v' = v + h f / (m + h kv). Euler would leave h kv out."""
    body = (
        '<body><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="2" contype="0" conaffinity="0"/></body>'
    )
    servo = '<actuator><velocity joint="x" kv="300"/></actuator>'
    options = option(0.01, 'integrator="implicitfast" gravity="0 0 0"')
    scene = scene_of(f"<mujoco>{options}<worldbody>{body}</worldbody>{servo}</mujoco>")
    start = dynamics.initial_state(scene, qvel=jnp.array([0.5]))
    after, _ = dynamics.step(scene, scene.model, start, jnp.array([2.0]))
    np.testing.assert_allclose(after.qvel, [0.5 + 0.01 * 300 * 1.5 / (2 + 0.01 * 300)], rtol=1e-12)


@pytest.mark.parametrize("name", MARKED)
def test_the_step_is_mjxs(name: str) -> None:
    """Over 25 steps, each from the same state, so that each step is compared and not how errors grow.

    From the same warm start the step is MJX's to rounding. With the improved one, ours may lie nearer the solution
    than MJX's: the solver's cost is as convex as M, so two accelerations are at most |G| apart each, in the norms of M.
    """
    case = prepare(name)
    scene, (nq, nv, na, _) = case.scene, sizes(case.scene)

    def compare(model, point, warmstart, qacc):
        qpos, qvel, act, control = split(scene, point)
        data = dynamics.force_stage(model, dynamics.position_stage(scene, model, qpos), qvel, act, control)

        inertia = mjx.full_m(model, data)

        def distance(qacc):
            gap = constraint.imbalance(model, data, qacc)
            return jnp.sqrt(gap @ jnp.linalg.solve(inertia, gap))

        stock, stock_qacc = stock_step_flat(scene, model, point, warmstart)
        plain, plain_qacc, _ = step_flat(scene, model, point, warmstart)
        apart = qacc - stock_qacc
        apart = jnp.sqrt(apart @ inertia @ apart)
        return stock, plain, stock_qacc - plain_qacc, apart, distance(qacc) + distance(stock_qacc)

    point, warmstart = start_point(CASES[name], scene), np.zeros(nv)
    with plain_warm_start():
        program = compiled(compare, scene.model, point, warmstart, warmstart)
    for _ in range(25):
        after, qacc, residual = case.step(scene.model, point, warmstart)
        stock, plain, gap, apart, allowed = program(scene.model, point, warmstart, qacc)
        np.testing.assert_allclose(plain, stock, rtol=0, atol=1e-12)
        np.testing.assert_allclose(scene.timestep * gap, 0, atol=1e-12)
        assert float(apart) <= float(allowed) + 1e-12 * np.abs(qacc).max()
        assert float(residual) < 1e-6
        point, warmstart = np.concatenate([after, CASES[name].control]), qacc
    assert after.shape == (nq + nv + na,)


@pytest.mark.parametrize("name", MARKED)
def test_the_state_is_in_contact(name: str) -> None:
    """Without its constraints the step would end elsewhere; the tests below are of contact."""
    case = prepare(name)
    host = case.scene.host
    free = case.scene.model.replace(
        geom_margin=case.scene.model.geom_margin - 10.0, jnt_margin=case.scene.model.jnt_margin - 10.0
    )
    nq, nv = host.nq, host.nv
    without = np.asarray(case.step(free, case.point, case.warmstart)[0])
    assert np.abs(case.run(case.point) - without)[nq : nq + nv].max() > 1e-3


@pytest.mark.parametrize("name", MARKED)
def test_reverse_mode_is_the_central_difference(name: str) -> None:
    # the derivative is taken where MJX's solver stopped, 1e-8 from the solution; with cones it differs there by as much
    assert_close_by_rows(jacobian(name), numeric_jacobian(name), 1e-6)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "sphere-sphere condim 1" else [pytest.mark.slow]) for name in CASES]
)
def test_both_programs_and_both_modes_agree(name: str) -> None:
    """The tape, forwards and backwards, and the graph's matrix equal the graph in reverse mode."""
    case, expected = prepare(name), jacobian(name)
    scene = dataclasses.replace(case.scene, adjoint="tape")
    assert not scene.uses_graph

    def after(point):
        return step_flat(scene, scene.model, point, jnp.asarray(case.warmstart))[0]

    _, forward, reverse = compiled(in_both_modes(after), case.point)(case.point)
    assert_close_by_rows(forward, expected, 1e-10)
    assert_close_by_rows(reverse, expected, 1e-10)

    def matrix(point):
        _, qacc, _ = step_flat(case.scene, case.scene.model, point, jnp.asarray(case.warmstart))
        qpos, qvel, act, control = split(case.scene, point)
        return dynamics.step_jacobian(case.scene, case.scene.model, qpos, qvel, act, control, qacc)[0]

    found = compiled(matrix, case.point)(case.point)
    assert_close_by_rows(found, expected[case.scene.host.nq :], 1e-12)


# A sphere that slides on the plane: cheap enough for what needs several programs.

SPEED = np.array([0.3, 0.2, -0.1])


def sliding(extra: str = "", **scene_options: str) -> Scene:
    return scene_of(floor_scene(slider(3), option(extra=extra)), **scene_options)


def at(height: float, qvel: np.ndarray = SPEED) -> np.ndarray:
    return np.concatenate([[0.01, -0.02, height], qvel])


def sliding_step(scene: Scene) -> Callable[..., Any]:
    return lambda point: step_flat(scene, scene.model, point, jnp.zeros(3))[0]


@cache
def elliptic() -> Callable[[Any], Any]:
    """The step with an elliptic cone, and its Jacobian."""
    step = sliding_step(sliding('cone="elliptic"'))
    return compiled(lambda point: (step(point), jax.jacfwd(step)(point)), jnp.zeros(6))


def test_elliptic_contact_without_tangential_velocity() -> None:
    """The cone's axis, where a norm has no derivative; friction sticks there and the step is smooth."""
    for qvel in (np.array([0.0, 0.0, -0.1]), np.zeros(3)):
        point = at(-0.0004, qvel)
        derivative = elliptic()(point)[1]
        assert_close_by_rows(derivative, central_jacobian(lambda x: elliptic()(x)[0], point, 3e-6), 1e-6)
        # the tangential velocity is braked, at the rate of its own row
        assert 0 < derivative[3, 3] < 1


@pytest.mark.parametrize("missing", ["native code", "graph"])
def test_what_is_missing_leaves_the_derivative_as_it_is(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """In both modes: by the graph's matrix, which XLA computes, or by MJX's operations.

    Small models keep forward mode, in which cases not taken do not count.
    """
    expected = elliptic()(at(-0.0004))[1]
    if missing == "graph":
        monkeypatch.setattr(dynamics, "by_graph", lambda *arguments: None)
    monkeypatch.setenv("MJX_STUDY_NATIVE", "xla")
    point = jnp.asarray(at(-0.0004))
    traced = jax.jit(in_both_modes(sliding_step(sliding('cone="elliptic"')))).trace(point)
    assert missing != "graph" or "remat" not in str(traced.jaxpr)
    for found in traced.lower().compile()(point)[1:]:
        assert_close_by_rows(found, expected, 1e-12)


def test_without_contact_the_derivative_is_free_fall() -> None:
    expected = np.eye(6) + 0.002 * np.eye(6, k=3)
    np.testing.assert_allclose(elliptic()(at(0.1))[1], expected, rtol=0, atol=1e-15)


def test_activation_and_control_each_have_their_column() -> None:
    """A mass on a slide with a filter and a motor: v' = v + h (3 a + 5 u_2) / m, a' = a + h (u_1 - a) / tau."""
    h, mass, tau = 0.01, 2.0, 0.05
    scene = scene_of(
        f"""<mujoco><option timestep="{h}" gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
        <geom size=".1" mass="{mass}" contype="0"/></body></worldbody><actuator>
        <general joint="x" dyntype="filter" dynprm="{tau}" gainprm="3"/><motor joint="x" gear="5"/>
        </actuator></mujoco>"""
    )
    assert scene.uses_graph
    point = jnp.array([0.1, 0.2, 0.3, 0.4, 0.5])
    after = compiled(jax.jacfwd(lambda x: step_flat(scene, scene.model, x, jnp.zeros(1))[0]), point)(point)
    speed = np.array([0, 1, 3 * h / mass, 0, 5 * h / mass])
    activation = np.array([0, 0, 1 - h / tau, h / tau, 0])
    np.testing.assert_allclose(after, [np.eye(5)[0] + h * speed, speed, activation], rtol=0, atol=1e-15)


# Derivatives with respect to contact parameters.

PARAMETERS = ("stiffness", "damping", "d_0", "d_width", "width", "midpoint", "power", "sliding", "torsional", "rolling")
POWER = PARAMETERS.index("power")


@cache
def over_parameters(cone: str) -> Callable[..., Any]:
    """(parameters, point) -> (velocity after a step, its Jacobian over the parameters, reverse mode)."""
    scene = sliding(f'cone="{cone}"')

    def velocity(parameters, point):
        contact = ContactModel(parameters[:2], parameters[2:7], parameters[7:])
        return step_flat(scene, apply_contact(scene.model, contact), point, jnp.zeros(3))[0][3:]

    def both(parameters, point):
        return velocity(parameters, point), jax.jacrev(velocity)(parameters, point)

    program = compiled(both, jnp.zeros(10), jnp.zeros(6))
    return lambda parameters, point: tuple(map(np.asarray, program(jnp.asarray(parameters), jnp.asarray(point))))


def parameters(solref: tuple[float, float], power: float = 2.0) -> np.ndarray:
    return np.array([*solref, 0.3, 0.9, 0.001, 0.4, power, 0.5, 0.02, 0.003])


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("solref", [(-3000.0, -40.0), (0.03, 0.8)], ids=["direct", "time"])
@pytest.mark.parametrize("height", [-0.0002, -0.0007, -0.003], ids=["below-midpoint", "above-midpoint", "beyond-width"])
def test_derivatives_over_contact_parameters(cone: str, solref: tuple[float, float], height: float) -> None:
    program, values = over_parameters(cone), parameters(solref)
    _, derivative = program(values, at(height))
    # per relative change of a parameter, so that all have the unit of the velocity
    numeric = central_jacobian(lambda log: program(values * np.exp(log), at(height))[0], np.zeros(10), 1e-3)
    scaled = derivative * values
    if height == -0.003:  # beyond the width, where MJX's derivative by the power is NaN
        np.testing.assert_array_equal(scaled[:, POWER], 0)
    assert np.abs(numeric[:, :4]).max() > 1e-4
    # Richardson at 1e-3: (1e-3)^4 of a few derivatives; rounding and the solver's 1e-8 of a velocity change over 1e-3
    np.testing.assert_allclose(scaled, numeric, rtol=1e-6, atol=1e-8 if cone == "elliptic" else 1e-10)


def test_derivative_over_stiffness_without_damping() -> None:
    """With solref (-k, 0), where MJX's derivative is NaN."""
    program = over_parameters("pyramidal")
    values, point = parameters((-3000.0, 0.0)), at(-0.0004)

    def by_stiffness(shift):
        return program(values + np.array([shift[0], *np.zeros(9)]), point)[0]

    derivative = program(values, point)[1]
    assert np.isfinite(derivative).all()
    numeric = central_jacobian(by_stiffness, np.zeros(1), 1.0)
    np.testing.assert_allclose(derivative[:, 0], numeric[:, 0], rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize("ends", [(0.6, 0.6), (0.9, 0.3)], ids=["constant", "falling"])
def test_an_impedance_that_does_not_rise(ends: tuple[float, float]) -> None:
    """Where MJX clips it: a constant one has one-sided slopes there, and a falling one another value than in C."""
    program, values = over_parameters("pyramidal"), parameters((-3000.0, -40.0))
    values[2:4], point = ends, at(-0.0004)
    velocity, derivative = program(values, point)
    numeric = central_jacobian(lambda change: program(values + change, point)[0], np.zeros(10), 1e-4)
    np.testing.assert_allclose(derivative[:, 2:4], numeric[:, 2:4], rtol=1e-6, atol=1e-10)
    assert np.abs(numeric[:, 2:4]).min(axis=1).max() > 1e-4
    scene = sliding()
    host = engine_model(scene, contact_model(*(part.tolist() for part in np.split(values, [2, 7])), scene=scene))
    data = mujoco.MjData(host)
    data.qpos, data.qvel = point[:3], point[3:]
    mujoco.mj_step(host, data)
    np.testing.assert_allclose(velocity, data.qvel, rtol=1e-7, atol=1e-9)


# States and rollouts.


def test_a_rollout_is_its_steps() -> None:
    case = prepare("sphere-sphere condim 1")
    scene, horizon = case.scene, 6
    start = dynamics.initial_state(scene, qvel=jnp.asarray([0.5, 0.0]))

    def law(index, state):
        return jnp.asarray([0.1]) * index - 0.3 * state.qvel[:1]

    states, controls, residuals = jax.jit(lambda s: dynamics.rollout(scene, scene.model, s, law, horizon))(start)
    assert states.qpos.shape == (horizon + 1, 2) and controls.shape == (horizon, 1) and residuals.shape == (horizon,)
    point, warmstart = np.array([0.0, 1.0, 0.5, 0.0]), np.zeros(2)
    for index in range(horizon):
        np.testing.assert_allclose(np.concatenate([states.qpos[index], states.qvel[index]]), point, rtol=0, atol=1e-14)
        control = 0.1 * index - 0.3 * point[2]
        assert float(controls[index, 0]) == pytest.approx(control, abs=1e-14)
        point, warmstart, _ = map(np.asarray, case.step(scene.model, np.concatenate([point, [control]]), warmstart))


PENDULUM = """
<mujoco><option timestep="0.02" integrator="RK4"/><worldbody><body><joint name="axle" axis="0 1 0" damping=".1"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".03" mass="1" contype="0" conaffinity="0"/></body>
</worldbody><actuator><general joint="axle" dyntype="filter" dynprm=".1" gainprm="2"/></actuator></mujoco>"""


def test_runge_kutta_is_mjxs() -> None:
    """A pendulum with an activated motor."""
    scene = scene_of(PENDULUM)
    assert not scene.has_constraints
    point = np.array([0.9, 2.5, 0.3, 0.7])
    step = lambda of, x, scene=scene: of(scene, scene.model, x, jnp.zeros(1))[0]  # noqa: E731
    program = compiled(lambda x: (step(step_flat, x), step(stock_step_flat, x)), point)
    for _ in range(20):
        ours, stock = program(point)
        np.testing.assert_allclose(ours, stock, rtol=0, atol=1e-13)
        point = np.concatenate([ours, point[-1:]])
    taped = dataclasses.replace(scene, adjoint="tape")
    before = native_summary().partition(",")[2]
    jacobians = [run(in_both_modes(partial(step, step_flat, scene=each)), point)[1:] for each in (scene, taped)]
    assert native_summary().partition(",")[2] == before, "the step is no graph"
    assert scene.uses_graph and np.ptp(np.reshape(jacobians, (4, -1)), axis=0).max() < 1e-12
