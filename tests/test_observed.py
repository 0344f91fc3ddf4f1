"""Quantities that costs ask their states for: equal to the C engine's by every route, with right derivatives."""

import dataclasses
from collections.abc import Callable
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.test_util import check_grads

from mjx_study import OpenLoop, Task, initial_state, observed
from mjx_study.graph.native import SWITCH
from mjx_study.objective import rollout_cost
from mjx_study.simulation.contact import ContactModel, contact_model
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.engine import HostState, converged_host, host_data
from mjx_study.simulation.integration import integrate_position
from mjx_study.simulation.observation import FORCES, POSITIONS, QUANTITIES, VELOCITIES, ObservedState
from mjx_study.simulation.scene import Scene, SceneError, load_scene, put_scene
from mjx_study.tasks.soundness import check_soundness
from mjx_study.tasks.task import check_shapes, no_cost
from tests.scenes import floor_scene, option
from tests.test_own_task import LIFTED

SENSORS: Final = """<sensor>
  <framepos name="place" objtype="site" objname="tip"/><framequat objtype="geom" objname="box"/>
  <framezaxis objtype="body" objname="arm" reftype="site" refname="tip"/><jointpos joint="elbow"/>
  <subtreecom body="arm"/><magnetometer site="tip"/><ballquat joint="ball"/><actuatorpos actuator="motor"/>
  <velocimeter site="tip"/><gyro site="tip"/><framelinvel objtype="xbody" objname="arm"/><jointvel joint="elbow"/>
  <subtreelinvel body="arm"/><subtreeangmom body="arm"/><actuatorvel actuator="motor"/><ballangvel joint="ball"/>
  <touch name="touch" site="sole"/><accelerometer site="tip"/><force site="tip"/><torque site="tip"/>
  <actuatorfrc actuator="motor"/><jointactuatorfrc joint="elbow"/><framelinacc objtype="site" objname="tip"/>
</sensor>"""


FAR: Final = 'contype="0" conaffinity="0"'


def arm(extra: str, condim: int, rest: str = SENSORS) -> str:
    """A ball joint and a hinge, and a sliding box in contact with the floor: six, or seven degrees of freedom."""
    bodies = f"""
    <body name="arm" pos="0 0 1"><joint name="ball" type="ball" damping=".1"/>
      <geom name="upper" type="capsule" fromto="0 0 0 .3 .1 0" size=".03" mass=".5" {FAR}/>
      <body name="lower" pos=".3 .1 0" euler="10 20 30"><joint name="elbow" axis="0 1 0"/>
        <geom name="hand" type="box" pos=".1 0 0" size=".1 .02 .03" mass=".3" {FAR}/>
        <site name="tip" pos=".2 .01 0" euler="40 0 10"/></body></body>
    <body name="load" pos=".5 .5 .0994"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <geom name="box" type="box" size=".1 .1 .1" mass=".4" condim="{condim}" friction=".5 .01 .001"/>
      <site name="sole" pos="0 0 -.1" size=".2"/></body>"""
    motor = '<actuator><motor name="motor" joint="elbow" gear="2"/></actuator>'
    floor = f'condim="{condim}" friction=".5"'
    return floor_scene(bodies, option(extra=extra), floor).replace("</mujoco>", f"{motor}{rest}</mujoco>")


HEAVY: Final = '<body pos="2 0 .0995" name="other"><freejoint/><geom name="second" size=".1"/></body>'
SCENES: Final = {
    "pyramidal": arm("", 3),
    "elliptic": arm('cone="elliptic" integrator="implicitfast"', 4),
    "frictionless": arm("", 1),
    "tape": arm("", 3).replace("</worldbody>", f"{HEAVY}</worldbody>"),  # more degrees of freedom than graphs serve
}


def scene_of(name: str, **options: Any) -> Scene:
    return put_scene(mujoco.MjModel.from_xml_string(SCENES[name]), name, **options)


def generic(scene: Scene) -> tuple[State, jax.Array]:
    """A state in motion whose box is pressed into the floor, and controls."""
    host = scene.host
    random = np.random.default_rng(1)
    data = mujoco.MjData(host)
    qvel = 0.3 * random.normal(size=host.nv)
    qpos = data.qpos.copy()
    mujoco.mj_integratePos(host, qpos, np.where(np.arange(host.nv) < 4, random.normal(size=host.nv), 0.0), 1.0)
    return initial_state(scene, jnp.asarray(qpos), jnp.asarray(qvel)), jnp.asarray(random.normal(size=host.nu))


def in_engine(scene: Scene, contact: ContactModel | None, state: State, control: jax.Array) -> mujoco.MjData:
    host = converged_host(scene, contact)
    leaves = (np.asarray(leaf) for leaf in (state.qpos, state.qvel, state.act, control, state.warmstart))
    data = host_data(host, HostState(*leaves))
    mujoco.mj_forward(host, data)
    return data


def engine_quantity(host: mujoco.MjModel, data: mujoco.MjData, name: str) -> np.ndarray:
    """MuJoCo's C value of one of `QUANTITIES`."""
    if name.endswith(("linvel", "angvel")):
        kind, count = {
            "x": (mujoco.mjtObj.mjOBJ_XBODY, host.nbody),
            "xi": (mujoco.mjtObj.mjOBJ_BODY, host.nbody),
            "geom_x": (mujoco.mjtObj.mjOBJ_GEOM, host.ngeom),
            "site_x": (mujoco.mjtObj.mjOBJ_SITE, host.nsite),
        }[name[:-6]]
        rows = np.zeros((count, 6))
        for index in range(count):
            mujoco.mj_objectVelocity(host, data, kind, index, rows[index], 0)
        return rows[:, :3] if name.endswith("angvel") else rows[:, 3:]
    found = getattr(data, name)
    return found.reshape(-1, 3, 3) if name.endswith("mat") else found


def engine_force(host: mujoco.MjModel, data: mujoco.MjData, first: int, second: int) -> np.ndarray:
    """MuJoCo's C force of one geom on another, summed over their contacts."""
    total, force = np.zeros(3), np.zeros(6)
    for index in range(data.ncon):
        contact = data.contact[index]
        mujoco.mj_contactForce(host, data, index, force)
        world = contact.frame.reshape(3, 3).T @ force[:3]
        total += {(first, second): -1, (second, first): 1}.get(tuple(contact.geom), 0) * world
    return total


def everything(scene: Scene, contact: ContactModel | None) -> Callable[[State, jax.Array], dict[str, jax.Array]]:
    def ask(state: State, control: jax.Array) -> dict[str, jax.Array]:
        seen = observed(scene, state, contact, control)
        forces = {"force": seen.contact_force("box", "floor"), "back": seen.contact_force(0, scene.geom("box"))}
        return {name: getattr(seen, name) for name in [*POSITIONS, *VELOCITIES, "sensordata"]} | forces

    return ask


@pytest.mark.slow
@pytest.mark.parametrize("native", ["1", "0", "xla"])
@pytest.mark.parametrize("name", SCENES)
def test_quantities_are_the_c_engines(name: str, native: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Under a contact model other than the MJCF's: every quantity, in batches, natively and by JAX's operations."""
    monkeypatch.setenv(SWITCH, native)
    scene = scene_of(name)
    contact = contact_model((-3000.0, -60.0), (0.3, 0.9, 0.002, 0.5, 2.0), scene=scene)
    state, control = generic(scene)
    batch = jax.tree.map(lambda leaf: leaf[None], (state, control))
    found = jax.tree.map(lambda leaf: leaf[0], jax.jit(jax.vmap(everything(scene, contact)))(*batch))
    data, host = in_engine(scene, contact, state, control), scene.host
    for quantity in [*POSITIONS, *VELOCITIES, "sensordata"]:
        np.testing.assert_allclose(
            found[quantity], engine_quantity(host, data, quantity), rtol=1e-6, atol=1e-7, err_msg=quantity
        )
    expected = engine_force(host, data, scene.geom("box"), scene.geom("floor"))
    assert expected[2] > 0.1 and (name == "frictionless") == (abs(expected[0]) < 1e-9)
    np.testing.assert_allclose(found["force"], expected, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(found["back"], -expected, rtol=1e-6, atol=1e-7)


def test_velocities_and_contact_forces_are_the_c_engines() -> None:
    """Two quantities of those above, in less time."""
    scene = scene_of("pyramidal")
    state, control = generic(scene)
    box, floor = scene.geom("box"), scene.geom("floor")

    def ask(state: State, control: jax.Array) -> tuple[jax.Array, jax.Array]:
        seen = observed(scene, state, None, control)
        return seen.geom_xlinvel, seen.contact_force(box, floor)

    velocities, force = jax.jit(ask)(state, control)
    data = in_engine(scene, None, state, control)
    np.testing.assert_allclose(velocities, engine_quantity(scene.host, data, "geom_xlinvel"), rtol=0, atol=1e-9)
    expected = engine_force(scene.host, data, box, floor)
    assert expected[2] > 1
    np.testing.assert_allclose(force, expected, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elliptic", "tape"])
def test_derivatives_are_those_of_finite_differences(name: str) -> None:
    """Of every quantity over positions, velocities and controls, in both modes; no force has a kink there."""
    scene = scene_of(name)
    state, control = generic(scene)

    def ask(qpos: jax.Array, qvel: jax.Array, control: jax.Array) -> dict[str, jax.Array]:
        return everything(scene, None)(dataclasses.replace(state, qpos=qpos, qvel=qvel), control)

    check_grads(jax.jit(ask), (state.qpos, state.qvel, control), order=1, rtol=1e-4, atol=1e-4, eps=1e-6)


def feet(scene: Scene) -> Task:
    """A cost of positions, velocities, forces and sensors, by controls."""
    box, load = scene.geom("box"), scene.body("load")

    def running_cost(state: ObservedState, control: jax.Array) -> jax.Array:
        touch = state.sensordata[scene.sensor("touch")][0]
        return 1e-3 * (touch + state.contact_force("box", "floor")[2] ** 2) + 0.1 * jnp.sum(control**2)

    def final_cost(state: ObservedState) -> jax.Array:
        return jnp.sum(state.site_xpos[0] ** 2) + state.geom_xlinvel[box, 2] + jnp.sum(state.xmat[load])

    return Task(
        name="feet",
        scene=scene,
        horizon=4,
        policy=OpenLoop(4, 1),
        theta=jnp.linspace(-1, 1, 4),
        sigma=0.1,
        start=generic(scene)[0],
        running_cost=running_cost,
        final_cost=final_cost,
        contact_pair=("floor", "box"),
    )


def replayed(task: Task, contact: ContactModel | None) -> float:
    """The cost of `feet` in the C engine."""
    host = converged_host(task.scene, contact)
    box, address = task.scene.geom("box"), task.scene.sensor("touch").start
    leaves = (task.start.qpos, task.start.qvel, task.start.act, jnp.zeros(1), task.start.warmstart)
    data = host_data(host, HostState(*map(np.asarray, leaves)))
    total = 0.0
    for control in np.asarray(task.theta):
        data.ctrl[:] = control
        mujoco.mj_forward(host, data)
        force = engine_force(host, data, box, task.scene.geom("floor"))
        total += 1e-3 * (data.sensordata[address] + force[2] ** 2) + 0.1 * control**2
        mujoco.mj_step(host, data)
    mujoco.mj_forward(host, data)
    velocity = engine_quantity(host, data, "geom_xlinvel")[box, 2]
    return total + np.sum(data.site_xpos[0] ** 2) + velocity + np.sum(data.xmat[task.scene.body("load")])


@pytest.mark.slow
def test_costs_are_the_same_by_every_route(monkeypatch: pytest.MonkeyPatch) -> None:
    """Value and gradient natively, by XLA's graph and by the tape; the value in C; and the gradient of differences."""
    values, gradients = [], []
    for native, adjoint in (("1", "graph"), ("0", "graph"), ("xla", "graph"), ("xla", "tape")):
        monkeypatch.setenv(SWITCH, native)
        task = feet(scene_of("elliptic", adjoint=adjoint))
        check_shapes(task)
        check_soundness(task)
        contact = contact_model((-3000.0, -60.0), (0.3, 0.9, 0.002, 0.5, 2.0), scene=task.scene)
        noise = jnp.zeros(task.policy.noise_shape)
        cost = jax.jit(
            lambda theta, task=task, contact=contact, noise=noise: rollout_cost(
                task, theta, contact, task.draw_start(jax.random.key(0)), noise
            )[0]
        )
        value, gradient = jax.jit(jax.value_and_grad(cost))(task.theta)
        values.append(value)
        gradients.append(gradient)
    np.testing.assert_allclose(values, replayed(task, contact), rtol=1e-7)
    np.testing.assert_allclose(gradients[1:], [gradients[0]] * 3, rtol=1e-8, atol=1e-10)
    moves = 1e-5 * jnp.eye(4)
    slopes = [float(cost(task.theta + move) - cost(task.theta - move)) / 2e-5 for move in moves]
    np.testing.assert_allclose(gradients[0], slopes, rtol=1e-5, atol=1e-7)


def test_positions_in_costs_have_derivatives() -> None:
    """Of a body's position in a batch of states, as metrics are given, against MuJoCo's Jacobian."""
    scene = scene_of("elliptic")
    host, (state, _) = scene.host, generic(scene)
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), state)
    assert observed(scene, both).geom_xpos.shape == (2, host.ngeom, 3)
    body = scene.body("lower")

    def place(change: jax.Array) -> jax.Array:
        moved = integrate_position(host, state.qpos, change, 1.0)
        return observed(scene, dataclasses.replace(state, qpos=moved)).xipos[body]

    data, expected = in_engine(scene, None, state, jnp.zeros(host.nu)), np.zeros((3, host.nv))
    mujoco.mj_jacBodyCom(host, data, expected, None, body)
    np.testing.assert_allclose(jax.jit(jax.jacrev(place))(jnp.zeros(host.nv)), expected, rtol=0, atol=1e-9)


def test_states_are_pytrees() -> None:
    """Compiled functions within a cost take them."""
    scene = scene_of("elliptic")
    state = observed(scene, generic(scene)[0], None, jnp.ones(1))
    assert np.array_equal(jax.jit(lambda seen: seen.xpos[scene.body("load")])(state), state.xpos[scene.body("load")])
    assert jax.tree.map(lambda leaf: leaf, state).scene is scene


def test_a_state_outlives_the_programs_that_ask_it() -> None:
    """Quantities computed in a program, or in a branch of it, stay there; others are kept."""
    scene = scene_of("elliptic")
    state = generic(scene)[0]
    target, known = observed(scene, state), observed(scene, state).xpos

    def cost(height: jax.Array) -> jax.Array:
        seen = observed(scene, dataclasses.replace(state, qpos=state.qpos.at[-1].add(height)))
        inside = jax.lax.cond(height > 0, lambda: seen.xpos, lambda: target.xpos)
        assert not {"xpos"} & {*vars(seen), *vars(target)}
        return jnp.sum(inside + 0 * seen.xpos) * ("xpos" in vars(seen))

    for height in (0.0, 0.5):
        np.testing.assert_allclose(jax.jit(cost)(height), jnp.sum(known) + height, rtol=1e-12)
    assert np.array_equal(target.xpos, known) and "xpos" in vars(target)


def test_what_a_state_lacks_has_one_line() -> None:
    scene = scene_of("elliptic")
    state, control = generic(scene)
    seen = observed(scene, state)
    with pytest.raises(AttributeError, match=r"a state has qpos, .*geom_xpos.*sensor.* no 'geom_xpoz'; did you"):
        seen.geom_xpoz  # noqa: B018
    with pytest.raises(AttributeError, match=r"no 'xpos'; .* are those of mjx_study.observed\(scene, state\)"):
        state.xpos  # type: ignore[attr-defined]  # noqa: B018
    for ask in (lambda: seen.contact_force("box", "floor"), lambda: seen.sensordata):
        with pytest.raises(ValueError, match="depends on the control, which only the running_cost is given"):
            ask()
    both = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (state, control))
    with pytest.raises(ValueError, match=r"contact_force is computed for single states: map over them with jax.vmap"):
        observed(scene, both[0], None, both[1]).contact_force("box", "floor")
    with pytest.raises(ValueError, match="geoms 0 and 1 never collide: they are excluded, fixed to each other"):
        observed(scene, state, None, control).contact_force(0, 1)
    with pytest.raises(SceneError, match="has no body 'lod'; did you mean load"):
        scene.body("lod")
    with pytest.raises(SceneError, match="has no site 'top'"):
        scene.site("top")
    with pytest.raises(SceneError, match="has no sensor 'tuch'; did you mean touch"):
        scene.sensor("tuch")
    assert set(QUANTITIES) == {*POSITIONS, *VELOCITIES, *FORCES}


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        ("<clock/>", "has no clock sensor; remove it"),
        ('<contact geom1="box" geom2="floor"/>', "has no contact sensor; .* or ask for contact_force"),
        ('<gyro site="tip" delay="0.01" nsample="3"/>', "has no delay or interval"),
    ],
)
def test_sensors_that_a_state_does_not_determine(sensor: str, message: str) -> None:
    model = mujoco.MjModel.from_xml_string(arm("", 3, f"<sensor>{sensor}</sensor>"))
    scene = put_scene(model, "arm")
    with pytest.raises(ValueError, match=message):
        observed(scene, initial_state(scene), None, jnp.zeros(1)).sensordata  # noqa: B018


def test_an_error_in_a_cost_names_its_line() -> None:
    scene = scene_of("elliptic")

    def final_cost(state: ObservedState) -> jax.Array:
        return jnp.sum(state.geom_pos)

    task = feet(scene).replace(final_cost=final_cost, running_cost=no_cost)
    line = final_cost.__code__.co_firstlineno + 1
    with pytest.raises(ValueError, match=rf"^mine: the final_cost raised AttributeError: .*\(.*line {line}\)$"):
        check_shapes(task, "mine")


@pytest.mark.slow
def test_the_pages_costs_of_feet() -> None:
    """As they stand there, of the robot at rest: its feet do not slide but carry weight, and are on the floor."""
    scene = load_scene("quadruped")
    namespace: dict[str, Any] = {"jnp": jnp}
    exec(LIFTED, namespace)
    running_cost, final_cost = namespace["lifted"](scene)
    host, keyframe = scene.host, scene.host.key_qpos[0] if scene.host.nkey else None
    state = initial_state(scene, None if keyframe is None else jnp.asarray(keyframe))
    control = jnp.zeros(host.nu)
    data = in_engine(scene, None, state, control)
    feet = [scene.geom(name) for name in ("hind_left_foot", "hind_right_foot")]
    forces = sum(engine_force(host, data, foot, scene.geom("floor"))[2] ** 2 for foot in feet)
    found = jax.jit(lambda state: running_cost(observed(scene, state, None, control), control))(state)
    np.testing.assert_allclose(found, 1e-4 * forces, rtol=1e-4)
    expected = np.sum((data.geom_xpos[feet, 2] - 0.1) ** 2)
    np.testing.assert_allclose(final_cost(observed(scene, state)), expected, rtol=1e-9)
