"""Which step differs: this project's, MJX's, or the C engine's as documented."""

import dataclasses
from collections.abc import Generator
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_study.gradcheck.coordinates import Coordinates, make_coordinates
from mjx_study.gradcheck.engine_step import EngineStep
from mjx_study.gradcheck.programs import ContactCase, Exact, Programs, _stages
from mjx_study.gradcheck.values import Values, compare_values, difference_of_engines
from mjx_study.simulation import patches
from mjx_study.simulation.contact import contact_model
from mjx_study.simulation.dynamics import State, smooth_stages
from mjx_study.simulation.engine import HostState, host_data
from mjx_study.simulation.scene import put_scene
from tests.scenes import scene_of

SERVO = """<mujoco><option integrator="implicitfast"/><worldbody>
<body><joint name="x" axis="0 1 0"/><geom size=".1" pos=".1 0 0" mass="1"/></body></worldbody>
<actuator><velocity name="m" joint="x" kv="10" forcerange="-1 1"/></actuator></mujoco>"""
PLAIN = SERVO.replace('forcerange="-1 1"', "")


@cache
def layout(xml: str = PLAIN) -> Coordinates:
    return make_coordinates(scene_of(xml), None)


def at(qpos: Any, qvel: Any) -> HostState:
    """A state without activations and controls, and with no warm start."""
    qpos, qvel = np.asarray(qpos), np.asarray(qvel)
    return HostState(qpos, qvel, np.zeros(0), np.zeros(0), np.zeros(len(qvel)))


def exact_step(programs: Programs, state: HostState) -> Exact:
    """This project's step, and MJX's quantities in it."""
    own = programs.layout
    case, still = ContactCase(None, own.scales), np.zeros((1, len(own.inputs)))
    return programs.exact(case, state, jnp.asarray(state.qpos), still)


def start(xml: str = PLAIN) -> HostState:
    host = layout(xml).scene.host
    return HostState(np.array([0.3]), np.array([0.7]), np.full(host.na, 0.4), np.array([0.2]), np.zeros(1))


def stages_of(engine: EngineStep, state: HostState) -> dict[str, Any]:
    """The engine's quantities in the place of MJX's."""
    data = host_data(engine.host, state)
    mujoco.mj_forward(engine.host, data)
    names = ("xpos", "ten_length", "actuator_length", "qfrc_bias", "qfrc_passive", "act_dot", "qfrc_actuator")
    inertia = np.zeros((engine.host.nv, engine.host.nv))
    mujoco.mj_fullM(engine.host, data, inertia)
    empty = np.zeros((0, engine.host.nv))
    rows = {"efc_type": np.zeros(0, int), "efc_J": empty, "efc_aref": np.zeros(0), "efc_D": np.zeros(0)}
    contacts = {"dist": np.zeros(0), "margin": np.zeros(0)}
    own = {name: np.array(getattr(data, name)) for name in (*names, "qacc_smooth")}
    return own | {"qM": inertia} | rows | contacts


def compare(ours: float, stock: float, xml: str = PLAIN, **stages: Any) -> Values:
    """The verdict where velocities are off by these from the C engine's."""
    engine, state = EngineStep(layout(xml), None), start(xml)
    after = engine.after(state)
    mine, theirs = (dataclasses.replace(after, qvel=after.qvel + off) for off in (ours, stock))
    return compare_values(layout(xml), engine, state, mine, theirs, stages_of(engine, state) | stages)


@pytest.mark.parametrize(
    ("ours", "stock", "xml", "verdict", "cause"),
    [
        (0.0, 0.0, PLAIN, None, ""),
        (1e-16, -1e-16, PLAIN, None, ""),
        (1e-3, 0.0, PLAIN, "value", "this project's step is not that of mjx.step; the C engine agrees with mjx.step"),
        (0.0, 1e-3, PLAIN, "value", "mjx.step differs from the step"),
        (1e-3, 1e-3, PLAIN, "engine", "the integration: the state after the step differs, its acceleration does not"),
        (1e-3, 1e-3, SERVO, "engine_mismatch", "MJX's implicitfast damps as if no force or control were clamped"),
    ],
)
def test_which_step_differs(ours: float, stock: float, xml: str, verdict: str | None, cause: str) -> None:
    found = compare(ours, stock, xml)
    assert found.verdict == verdict and cause in found.cause
    assert found.agrees_with_engine is (ours < 1e-8)
    if verdict is not None and ours != stock:
        assert str(layout(xml).outputs[found.coordinate]) == "qvel[x]"
        assert found.numbers[0] - found.numbers[1] == pytest.approx(ours - stock)


def test_the_first_quantity_that_differs_is_named() -> None:
    assert compare(1e-3, 1e-3, qfrc_bias=np.array([9.0])).cause.startswith("the bias force differs")


def test_at_rest_rounding_is_all_that_moves() -> None:
    engine, state = EngineStep(layout(), None), start()
    after = engine.after(state)
    still = dataclasses.replace(after, qvel=1e-13 * after.qvel, warmstart=1e-13 * after.warmstart, qpos=state.qpos)
    off = dataclasses.replace(still, qvel=1.001 * still.qvel)
    for driven, noise, verdict in ((1e-13, 0.0, "value"), (1e-13, 1e-15, ""), (1.0, 0.0, "")):
        stages = stages_of(engine, state) | {"qacc_smooth": driven * after.warmstart}
        found = compare_values(layout(), engine, state, off, still, stages, noise)
        assert (found.stock > 1e-8) == bool(verdict)


@pytest.mark.parametrize("index", range(7))
def test_the_engines_step_changes_as_the_layout_says(index: int) -> None:
    """Each entry of the flat vector is the same change in both engines: state, length, velocity, control."""
    scene = scene_of("pusher")
    both = make_coordinates(scene, contact_model((-100.0, -1.0), scene=scene))
    contact = contact_model((-100.0, -1.0), scene=scene)
    change = np.zeros(len(both.inputs))
    change[both.num_state + index % 7] = 0.25
    model = both.model(contact, jnp.asarray(both.scales), jnp.asarray(change[both.num_state :]))
    engine = EngineStep(both, contact)
    engine.set_parameters(change[both.num_state :] * both.scales)
    for name in ("geom_solref", "geom_solimp", "geom_friction", "pair_solref", "pair_solimp", "pair_friction"):
        np.testing.assert_allclose(getattr(engine.host, name), np.asarray(getattr(model, name)), rtol=0, atol=1e-15)


def value_check(xml: str, qpos: list[float], qvel: list[float], **doctored: Any) -> Values:
    """The values of one step, with planted faults and other quantities in place of MJX's."""
    own = layout(xml)
    programs, case = Programs(own), ContactCase(None, own.scales)
    state = at(qpos, qvel)
    for _ in range(2):  # the second time from the solution
        exact = exact_step(programs, state)
        state = dataclasses.replace(state, warmstart=exact.after.warmstart)
    stock = programs.stock_step(case, state)
    return compare_values(own, EngineStep(own, None), state, exact.after, stock, exact.stages | doctored)


@pytest.fixture
def planted(monkeypatch: pytest.MonkeyPatch) -> Generator[pytest.MonkeyPatch]:
    """A planted fault is traced anew, and leaves no trace."""
    jax.clear_caches()
    yield monkeypatch
    jax.clear_caches()


def test_a_wrong_repair_is_a_defect_here(planted: pytest.MonkeyPatch) -> None:
    """k over d_width in place of its square: the derivative of the step is right, and the step is not MJX's."""
    right = patches.stiffness_damping_impedance

    def wrong(model, solref, solimp, position):
        k, b, impedance = right(model, solref, solimp, position)
        return k * solimp[1], b, impedance

    name = next(name for name, ours in patches._REPLACED.items() if ours is right)
    planted.setitem(patches._REPLACED, name, wrong)
    joint = '<joint type="slide" axis="1 0 0" limited="true" range="0 1"/>'
    xml = f'<mujoco><worldbody><body>{joint}<geom size=".1" mass="1"/></body></worldbody></mujoco>'
    found = value_check(xml, [-0.0101], [-0.1])
    assert found.verdict == "value" and "the C engine agrees with mjx.step" in found.cause


MIXED = """<mujoco><worldbody><geom name="floor" type="plane" size="3 3 .1" condim="1"/>
<body name="door" pos="0 1 1"><joint name="hinge" axis="0 1 0" limited="true" range="-1 0"/>
<geom size=".1" pos=".3 0 0"/><body name="leaf" pos=".6 0 0"><joint name="elbow" axis="0 1 0"/>
<geom size=".1" pos=".3 0 0"/></body></body>
<body pos="0 -1 1"><joint name="arm" type="ball" limited="true" range="0 .3"/><geom size=".1" pos=".3 0 0"/></body>
<body pos="0 0 .0995"><joint type="slide" axis="0 0 1"/><joint type="slide" axis="1 0 0"/>
<geom size=".1" condim="3"/></body>
<body pos="1 0 .0995"><joint type="slide" axis="0 0 1"/><geom size=".1" condim="1"/></body></worldbody>
<equality><joint joint1="hinge" joint2="elbow" polycoef="0 1 0 0 0"/>
<connect body1="leaf" anchor=".5 0 .2"/></equality></mujoco>"""
BENT = np.array([0.02, 0.1, np.cos(0.2), 0.0, np.sin(0.2), 0.0, 0.0, 0.0, 0.0])
MOVING = np.array([0.5, -0.3, 0.2, 0.4, -0.1, -0.2, 0.3, -0.3])


@cache
def mixed_stages() -> dict[str, Any]:
    """MJX's quantities, without the solution of its constraints."""
    scene = layout(MIXED).scene
    state = State(jnp.asarray(BENT), jnp.asarray(MOVING), jnp.zeros(0), jnp.zeros(len(MOVING)))
    stages = jax.jit(lambda model: _stages(model, smooth_stages(scene, model, state, jnp.zeros(0))))(scene.model)
    return jax.tree.map(np.asarray, stages)


def mixed_difference(stages: dict[str, Any]) -> tuple[str, bool]:
    """The difference reported for another constrained acceleration."""
    host = EngineStep(layout(MIXED), None).host
    return difference_of_engines(host, at(BENT, MOVING), stages, MOVING, 0 * MOVING)


def test_rows_are_compared_whatever_their_order() -> None:
    """MJX sorts contacts by dimension and limits by kind of joint; a connection in a plane has a row of zeros."""
    cause, documented = mixed_difference(mixed_stages())
    assert cause.startswith("reference accelerations of connect equality rows differ") and ";" not in cause, cause
    assert documented


@pytest.mark.parametrize(
    ("name", "kind", "cause"),
    [
        ("efc_D", "CONTACT_PYRAMIDAL", "stiffnesses of contact_pyramidal rows"),
        ("efc_aref", "CONTACT_FRICTIONLESS", "reference accelerations of contact_frictionless rows"),
        ("efc_J", "LIMIT_JOINT", "Jacobians of limit_joint rows"),
        ("efc_D", "EQUALITY", "stiffnesses of connect equality rows"),
        ("efc_aref", "EQUALITY", "reference accelerations of joint equality rows"),
    ],
)
def test_different_rows_are_not_a_documented_difference(name: str, kind: str, cause: str) -> None:
    """Beside a documented one."""
    stages = dict(mixed_stages())
    chosen = stages["efc_type"] == int(getattr(mujoco.mjtConstraint, f"mjCNSTR_{kind}"))
    stages[name] = np.where(np.reshape(chosen, (-1, *[1] * (stages[name].ndim - 1))), 1.001, 1.0) * stages[name]
    found, documented = mixed_difference(stages)
    assert not documented and f"{cause} differ by 1.0e-03" in found, found
    assert "(MJX leaves out -dJ/dt qvel" in found


def test_contacts_with_other_tangents_are_placed_differently() -> None:
    """MJX turns those of a steep capsule on a plane otherwise, and with them the pyramid."""
    stages = dict(mixed_stages())
    stages["frame"] = stages["frame"][:, [0, 2, 1]]
    found, documented = mixed_difference(stages)
    assert documented and "their normals by 0.0e+00 and their tangents by 1.0e+00" in found, found


def test_a_missing_row_is_not_a_documented_difference() -> None:
    stages = dict(mixed_stages())
    active = np.flatnonzero(np.abs(stages["efc_J"]).max(axis=1) > 0)
    stages["efc_J"] = stages["efc_J"] * (np.arange(len(stages["efc_J"])) != active[-1])[:, None]
    found, documented = mixed_difference(stages)
    assert not documented and "active contact_pyramidal rows in MJX" in found, found


def test_frames_that_c_takes_for_the_same() -> None:
    """A centre of mass 9e-7 m from the hinge: its weight turns the body in MJX, and not in C."""
    body = '<joint axis="0 1 0"/><inertial pos="9e-7 0 0" mass="1" diaginertia=".004 .004 .004"/>'
    xml = f"<mujoco><worldbody><body>{body}</body></worldbody></mujoco>"
    found = value_check(xml, [0.0], [0.1])
    assert found.verdict == "engine_mismatch" and "C takes frames less than 1e-6 apart for the same" in found.cause
    more = value_check(xml, [0.0], [0.1], qfrc_passive=np.ones(1))
    assert more.verdict == "engine" and more.cause.startswith("passive forces differ")


@pytest.mark.parametrize(("speed", "verdict"), [(9e-9, None), (2e-8, "value")])
def test_mjx_stops_what_turns_slower_than_it_sees(speed: float, verdict: str | None) -> None:
    """Below 1e-8 rad/s MJX leaves an orientation as it is."""
    xml = '<mujoco><worldbody><body><joint type="ball"/><geom size=".1"/></body></worldbody></mujoco>'
    own = layout(xml)
    state = at([1.0, 0.0, 0.0, 0.0], [speed, 0.0, 0.0])
    after = EngineStep(own, None).after(state)
    stopped = dataclasses.replace(after, qpos=state.qpos)
    stages = {"qacc_smooth": np.zeros(3)}
    assert compare_values(own, EngineStep(own, None), state, after, stopped, stages).verdict == verdict


RESTING = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .099"><freejoint/>
<geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("name", ["dist", "pos", "frame", "efc_J", "efc_aref", "efc_D", "xpos", "qM", "qacc_smooth"])
def test_nonfinite_quantities_differ(name: str) -> None:
    """They are compared nevertheless, without a traceback."""
    host = mujoco.MjModel.from_xml_string(RESTING)
    state = at(host.qpos0, np.zeros(6))
    engine = EngineStep(make_coordinates(put_scene(host, "box"), None), None)
    data = host_data(engine.host, state)
    mujoco.mj_forward(engine.host, data)
    contact = {part: np.array(getattr(data.contact, part)) for part in ("dist", "pos", "frame", "geom")}
    rows = {"efc_J": data.efc_J.reshape(data.nefc, 6).copy()}
    rows |= {part: np.array(getattr(data, part)) for part in ("efc_type", "efc_aref", "efc_D")}
    stages = stages_of(engine, state) | contact | {"margin": np.array(data.contact.includemargin)} | rows
    qacc = data.qacc.copy()
    assert difference_of_engines(engine.host, state, stages, qacc, qacc)[0].startswith("the integration")
    poisoned = np.full_like(stages[name], np.nan)
    text, documented = difference_of_engines(engine.host, state, stages | {name: poisoned}, qacc, qacc + 1)
    assert "differ" in text or "apart" in text or "points" in text or "rows" in text
    assert not documented or name in ("dist", "pos", "frame")
