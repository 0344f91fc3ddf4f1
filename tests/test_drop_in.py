"""The drop-in step: MJX's in every field, with derivatives that MJX's lacks, by itself and under the context."""

import inspect
import itertools
import re
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import mjx_study as study
from mjx_study.graph.native import SWITCH, native_identity
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import apply_contact
from mjx_study.simulation.drop_in import differentiable_mjx, solver_residual, step
from mjx_study.simulation.dynamics import initial_state
from mjx_study.simulation.onset import check_onset
from mjx_study.simulation.patches import patched
from tests.scenes import (
    CASES,
    FALLING,
    assert_close_by_rows,
    central_jacobian,
    compiled,
    corrected_rollout,
    floor_scene,
    in_both_modes,
    option,
    scene_of,
    slider,
    split,
)
from tests.test_dynamics import jacobian, prepare
from tests.test_onset_term import BOUNCING, Law

PAGE = Path(__file__).parents[1] / "docs" / "differentiable-mjx.md"
MODELS = Path(mjx.__file__).parent / "test_data"
NATIVE = pytest.mark.skipif(native_identity() is None, reason="there is no C compiler")
FAST = ("tendon/armature",)
CROWDS = {f"humanoid/{count:02}_humanoids" for count in range(2, 11)}  # copies of the first, and slow
STILL = {"ray", "actuator/general_dyntype"}  # no coordinate; an inertia matrix that is singular
NAMES = sorted({str(path.relative_to(MODELS))[:-4] for path in MODELS.rglob("*.xml")} - CROWDS - STILL)

# A sphere that slides on the plane, pushed by a servo; sensors of all three stages, and of contact.
SENSED = floor_scene(
    slider().replace("</body>", '<site name="s" size=".2"/></body>').replace('axis="1 0 0"', 'name="x" axis="1 0 0"'),
    option(extra='cone="elliptic"'),
).replace(
    "</mujoco>",
    """<actuator><position joint="x" kp="30" kv="1"/></actuator><sensor><framepos objtype="site" objname="s"/>
    <velocimeter site="s"/><accelerometer site="s"/><touch site="s"/><actuatorfrc actuator="position"/></sensor>
    </mujoco>""".replace("<position ", '<position name="position" '),
)


def device(source: str) -> tuple[mjx.Model, mjx.Data]:
    """A model from an MJCF, and its empty state with fixed types."""
    scene = study.put_scene(mujoco.MjModel.from_xml_string(source), "test")
    return scene.model, scene.template


def assert_same(ours: Any, theirs: Any, tolerance: float) -> None:
    """Every field agrees, relative to its largest entry; friction with what the C engine makes of it."""
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    for (path, one), other in zip(jax.tree_util.tree_leaves_with_path(ours), jax.tree.leaves(theirs), strict=True):
        one, other = np.asarray(one), np.asarray(other)
        if jax.tree_util.keystr(path).endswith(".contact.friction"):
            other = np.maximum(other, mujoco.mjMINMU)  # as the C engine clamps it
        scale = np.abs(other[np.isfinite(other)]).max(initial=1.0)
        np.testing.assert_allclose(one, other, rtol=0, atol=tolerance * scale, err_msg=jax.tree_util.keystr(path))


@pytest.mark.parametrize("name", [pytest.param(n, marks=[] if n in FAST else [pytest.mark.slow]) for n in NAMES])
def test_every_field_is_mjxs(name: str) -> None:
    """Three steps of MJX's own test models, with their own budgets, each from the same state."""
    host = mujoco.MjModel.from_xml_path(str(MODELS / f"{name}.xml"))
    model, rng = mjx.put_model(host), np.random.default_rng(0)
    data = mjx.make_data(host).replace(
        qvel=jnp.asarray(0.1 * rng.standard_normal(host.nv)), ctrl=jnp.asarray(0.1 * rng.standard_normal(host.nu))
    )
    stock, ours = (compiled(function, model, data) for function in (mjx.step, step))
    for _ in range(3):
        following = ours(model, data)
        assert_same(following, stock(model, data), 1e-9)
        assert jax.tree.leaves(jax.tree.map(jax.typeof, following)) == jax.tree.leaves(jax.tree.map(jax.typeof, data))
        data = following
    assert np.abs(data.qvel).max() > 0


@pytest.mark.parametrize("body", [slider(), '<body pos="0 0 .09"><freejoint/><geom size=".1"/></body>'])
def test_a_state_of_the_engine_can_be_stepped_in_a_scan(body: str) -> None:
    """`mjx.put_data` in contact, with fields of 32 bits."""
    host = mujoco.MjModel.from_xml_string(floor_scene(body, option(extra='cone="elliptic"')))
    state = mujoco.MjData(host)
    state.qpos[2] = 0.09 if host.nq == 7 else -0.01
    mujoco.mj_forward(host, state)
    assert state.ncon == 1
    model, data = mjx.put_model(host), mjx.put_data(host, state)
    last = jax.eval_shape(lambda: jax.lax.scan(lambda data, _: (step(model, data), None), data, length=2)[0])
    assert jax.tree.map(jax.typeof, last) == jax.tree.map(jax.typeof, data)


TENDON_DRIVEN = f"""<mujoco>{option()}<worldbody><geom type="plane" size="1 1 .1"/><site name="a" pos=".3 0 0"/>
<body pos="0 0 .1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><geom size=".1" mass="1"/>
<site name="b"/></body></worldbody>
<tendon><spatial name="t" stiffness="20"><site site="a"/><site site="b"/></spatial></tendon>
<actuator><general tendon="t" dyntype="filter" dynprm=".05" gainprm="3"/></actuator></mujoco>"""
INPUTS = {"qpos": (0.01, -0.0004), "qvel": (0.2, -0.3), "act": (0.2,), "ctrl": (0.4,)}
PAIRS = [pair for size in (1, 2) for pair in itertools.combinations(INPUTS, size)]
SOME = [pytest.param(pair, onset, marks=[] if (pair, onset) == (("qvel",), "none") else [pytest.mark.slow])
        for pair in PAIRS for onset in ("none", "linear")]  # fmt: skip


@pytest.mark.parametrize(("names", "onset"), SOME)
def test_derivatives_over_any_input(names: tuple[str, ...], onset: str) -> None:
    """In both modes, over some inputs of a scanned step: the columns of the derivative over all of them."""
    model, data = device(TENDON_DRIVEN)
    inputs = {name: jnp.array(value) for name, value in INPUTS.items()}
    point, chosen = ravel_pytree({name: inputs[name] for name in names})

    def last(point):
        start = data.replace(time=jnp.array(1.0), **(inputs | chosen(point)))
        following = jax.lax.scan(lambda data, _: (step(model, data, onset=onset), None), start, length=2)[0]
        return jnp.concatenate([following.qpos, following.qvel, following.act])

    program = compiled(in_both_modes(last), point)
    _, forward, reverse = program(point)
    expected = central_jacobian(lambda x: program(x)[0], np.asarray(point), 1e-5)
    assert_close_by_rows(reverse.T, forward.T, 1e-10)
    if onset == "none":
        assert_close_by_rows(forward.T, expected.T, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_derivatives_are_those_of_the_scenes_step(name: str) -> None:
    """Forwards and backwards; `test_dynamics` has these against central differences."""
    case = prepare(name)
    scene = case.scene

    def after(point):
        qpos, qvel, act, ctrl = split(scene, point)
        data = scene.template.replace(qpos=qpos, qvel=qvel, act=act, ctrl=ctrl, qacc_warmstart=case.warmstart)
        data = step(scene.model, data)
        return jnp.concatenate([data.qpos, data.qvel, data.act])

    _, forward, reverse = compiled(in_both_modes(after), case.point)(case.point)
    assert_close_by_rows(reverse, forward, 1e-10)
    # from another warm start the solver stops elsewhere, 1e-8 from the solution with cones
    assert_close_by_rows(forward, jacobian(name), 1e-6)


@pytest.mark.slow
def test_derivatives_of_sensors_and_forces() -> None:
    """Of what the scene's step does not compute, against central differences, in both modes."""
    model, data = device(SENSED)

    def outputs(point):
        qpos, qvel, ctrl = jnp.split(point, (3, 6))
        after: Any = step(model, data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl))
        return jnp.concatenate([after.sensordata, after._impl.efc_force, after.qfrc_constraint, after.qacc])

    point = np.array([0.0, 0.0, -4e-4, 0.3, 0.2, -0.1, 0.05])
    program = compiled(in_both_modes(outputs), point)
    _, forward, reverse = program(point)
    assert forward.shape == (11 + 3 + 3 + 3, 7) and np.abs(forward).max(axis=1).min() > 0
    assert_close_by_rows(reverse, forward, 1e-10)
    # the acceleration is 1e-8 off where MJX's solver stops, over differences of 5e-5
    assert_close_by_rows(forward, central_jacobian(lambda x: program(x)[0], point, 5e-5), 1e-3)


class Environment:
    """Somebody's, who knows nothing of this package: a sphere that is pushed along the floor."""

    def __init__(self, extra: str = "") -> None:
        self.model, self.data = device(floor_scene(slider(), option(extra=extra)))
        self.rollout = jax.jit(self._rollout)

    def _rollout(self, solref, speed):
        """Last position along x after 20 steps."""
        model = self.model.replace(geom_solref=jnp.broadcast_to(solref, self.model.geom_solref.shape))
        start = self.data.replace(qpos=jnp.array([0.0, 0.0, -1e-3]), qvel=jnp.stack([speed, 0.1, 0.0]))

        def advance(data, _):
            data = mjx.step(model, data)
            return data, data.qpos[0]

        return jax.lax.scan(advance, start, length=20)[1][-1]


def test_somebody_elses_environment_has_gradients_inside_and_only_there() -> None:
    """Twenty steps, a batch of models and states, behind a jit that has been used outside before."""
    environment = Environment()
    solrefs, speeds = jnp.array([[0.02, 1.0], [0.03, 0.8], [0.015, 1.2]]), jnp.array([0.3, 0.4, 0.5])
    values = jax.vmap(environment.rollout)
    gradients = jax.jit(jax.vmap(jax.grad(environment.rollout, argnums=(0, 1))))
    stock = values(solrefs, speeds)
    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
        gradients(solrefs, speeds)
    with differentiable_mjx():
        np.testing.assert_allclose(values(solrefs, speeds), stock, rtol=1e-9)
        over_solref, over_speed = gradients(solrefs, speeds)
    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
        gradients(solrefs, speeds)
    np.testing.assert_array_equal(values(solrefs, speeds), stock)

    for axis, size in ((0, 1e-5), (1, 1e-3)):
        shift = size * jnp.eye(2)[axis]
        difference = (values(solrefs + shift, speeds) - values(solrefs - shift, speeds)) / (2 * size)
        np.testing.assert_allclose(over_solref[:, axis], difference, rtol=2e-4, atol=1e-8)
    difference = (values(solrefs, speeds + 1e-4) - values(solrefs, speeds - 1e-4)) / 2e-4
    np.testing.assert_allclose(over_speed, difference, rtol=1e-6)
    assert np.abs(over_solref).min() > 1e-5 and np.all(over_speed < 0.04)  # friction brakes


@pytest.mark.slow
def test_the_context_is_a_decorator_and_may_be_nested() -> None:
    environment = Environment()

    @differentiable_mjx()
    def gradient(speed):
        with patched(), differentiable_mjx():
            return jax.grad(environment.rollout, argnums=1)(jnp.array([0.02, 1.0]), speed)

    assert 0 < float(gradient(jnp.array(0.3))) < 0.04


def test_the_residual_tells_whether_the_solver_has_converged() -> None:
    model, data = device(floor_scene(slider(), option(extra='cone="elliptic"')))
    start = data.replace(qpos=jnp.array([0.0, 0.0, -5e-4]), qvel=jnp.array([0.05, 0.02, -0.01]))
    few = model.replace(opt=model.opt.replace(iterations=1, ls_iterations=1))
    residual = jax.jit(lambda model: solver_residual(model, step(model, start)))
    converged, left = (float(residual(each)) for each in (model, few))
    assert converged < 1e-8 and left > 1e-4


RUNGE_KUTTA = """<mujoco><option integrator="RK4" timestep="0.01"/><worldbody>{}
<body pos="0 0 .3"><joint type="ball" damping=".01"/>
<geom type="capsule" fromto="0 0 0 0 .05 -.2" size=".1"/></body></worldbody></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("floor", ["", '<geom type="plane" size="1 1 .1"/>'], ids=["free", "contact"])
def test_runge_kutta(floor: str) -> None:
    """In contact, too: each of its stages has an implicit derivative."""
    scene = mujoco.MjModel.from_xml_string(RUNGE_KUTTA.format(floor))
    scene.opt.tolerance, scene.opt.iterations, scene.opt.ls_iterations = 1e-30, 100, 50
    model, data = mjx.put_model(scene), mjx.make_data(scene)
    quaternion = jnp.array([0.95, 0.1, 0.05, 0.2])

    def after(velocity):
        following = step(model, data.replace(qpos=quaternion / jnp.linalg.norm(quaternion), qvel=velocity))
        return jnp.concatenate([following.qpos, following.qvel])

    point = np.array([0.3, -0.4, 0.2])
    reverse, values = compiled(jax.jacrev(after), point), compiled(after, point)
    assert_close_by_rows(reverse(point), central_jacobian(values, point, 1e-4), 1e-6)


def test_what_has_no_derivative_is_refused() -> None:
    host = mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>")
    with pytest.raises(ValueError, match="only MJX's implementation in JAX has derivatives, this model is for cpp"):
        step(mjx.put_model(host, impl="cpp"), mjx.make_data(host))
    with pytest.raises(TypeError, match="step takes an mjx.Model and mjx.Data, .* not MjModel and MjData"):
        inspect.unwrap(step)(host, mujoco.MjData(host))  # without run-time checks of types
    host.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    with pytest.raises(ValueError, match="the onset term is that of steps by Euler or implicitfast"):
        step(mjx.put_model(host), mjx.make_data(host), onset="linear")
    host.opt.noslip_iterations = 3
    with pytest.raises(study.SceneError, match="MJX would leave out part of sled: noslip_iterations"):
        study.check_model(host, "sled")


@pytest.mark.parametrize("ending", ["while[", pytest.param("native[", marks=NATIVE)])
def test_the_backward_pass_does_not_run_the_solver_again(monkeypatch: pytest.MonkeyPatch, ending: str) -> None:
    """The only loop of open end is the solver's; gradients, too, have it once. In native code, they call the solved
    step and the transpose of its derivative once each."""
    monkeypatch.setenv(SWITCH, "1" if ending == "native[" else "xla")
    model, data = device(FALLING)

    def last(speed):
        start = data.replace(qvel=data.qvel.at[0].set(speed))
        return jax.lax.scan(lambda data, _: (step(model, data), None), start, length=3)[0].qpos[0]

    programs = [str(jax.make_jaxpr(function)(-0.1)) for function in (last, jax.grad(last))]
    assert [program.count("while[") for program in programs] == ([1, 1] if ending == "while[" else [0, 0])
    assert [program.count("native[") for program in programs] == ([0, 0] if ending == "while[" else [1, 2])


@pytest.mark.parametrize(
    ("law", "speed", "gaps", "steps"),
    [
        # Over a cell: contact begins early or late in a step.
        pytest.param(Law(), -1.5, 0.035 + 7.5e-4 * (np.arange(4) + 0.3) / 4, 80, id="begins"),
        pytest.param(
            BOUNCING, -1.0, np.linspace(0.0311, 0.0489, 7), 400,
            id="begins and ends under force", marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_the_onset_term_of_a_step_is_that_of_a_rollout(law: Law, speed: float, gaps: np.ndarray, steps: int) -> None:
    """To the order of a timestep, 1 %, where the term is four times the rest; the same values."""
    scene = scene_of(FALLING)
    model, start, qvel = apply_contact(scene.model, law.contact), scene.template, jnp.array([speed])

    def by_steps(gap, onset):
        def advance(data, _):
            return step(model, data, onset=onset), None

        return jax.lax.scan(advance, start.replace(qpos=gap, qvel=qvel), length=steps)[0].qpos

    def by_rollout(gap):
        state = initial_state(scene, gap, qvel)
        return corrected_rollout(scene, model, state, lambda index, state: jnp.zeros(0), steps)[0].qpos[-1]

    def all_of(gap):
        value, pull = jax.vjp(partial(by_steps, onset="linear"), gap)
        stock, plain = jax.jvp(partial(by_steps, onset="none"), (gap,), (jnp.ones(1),))
        return value, *pull(jnp.ones(1)), stock, plain, jax.jvp(by_rollout, (gap,), (jnp.ones(1),))[1]

    points = gaps[:, None]
    value, corrected, stock, plain, expected = compiled(jax.vmap(all_of), points)(points)
    np.testing.assert_allclose(value, stock, rtol=1e-13)
    np.testing.assert_allclose(corrected, expected, rtol=0, atol=0.01 * np.abs(expected - plain).max())
    assert np.abs(expected - plain).min() > 0.1
    if native_identity() is not None:  # the step, its derivative, what its guards did, and the term's two parts
        slope = jax.make_jaxpr(jax.vmap(jax.grad(lambda gap: by_steps(gap, "linear")[0])))(points)
        assert str(slope).count("native[") >= 6


@pytest.mark.slow
def test_an_environment_has_the_onset_term_inside_and_only_there() -> None:
    """The context's derivative is that of `step`, behind a jit used with and without; an imported `step` is refused."""
    model, data = device(FALLING)
    imported = mjx.step  # as by `from mujoco.mjx import step` before anything is patched
    while hasattr(imported, "branches"):
        imported = imported.__wrapped__

    def height(gap, advance):
        def following(data, _):
            return (mjx.step if advance is None else advance)(model, data), None

        start = data.replace(qpos=gap[None], qvel=jnp.array([-1.5]))
        return jax.lax.scan(following, start, length=80)[0].qpos[0]

    gradient = jax.jit(jax.grad(height), static_argnums=1)
    gap = jnp.array(0.0352)
    expected = float(gradient(gap, lambda model, data: step(model, data, onset="linear")))
    with differentiable_mjx():
        plain = float(gradient(gap, None))
    with differentiable_mjx(onset="linear"):
        corrected = float(gradient(gap, None))
        with pytest.raises(RuntimeError, match="would have no onset term: call mjx.step by that name"):
            gradient(gap, imported)
        with differentiable_mjx():
            assert float(gradient(gap, None)) == plain
    np.testing.assert_allclose(corrected, expected, rtol=1e-12)
    assert abs(corrected - plain) > 0.1
    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work"):
        gradient(gap, None)


def test_the_onset_term_is_of_first_order() -> None:
    model, data = device(FALLING)
    with pytest.raises(ValueError, match="unknown onset of a step 'smooth'; choose from none, linear"):
        step(model, data, onset="smooth")
    with pytest.raises(ValueError, match="unknown onset of a step 'smooth'"), differentiable_mjx(onset="smooth"):
        pass
    with pytest.raises(ValueError, match="unknown onset 'exact'; choose from none, linear, shift"):
        check_onset("exact")


@pytest.mark.parametrize("ways", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_page_runs(ways: int) -> None:
    """Both ways give the same gradient: friction brakes the ball until it rolls, at 5/7 of its speed."""
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        if ways == 2 or not {"differentiable_mjx", "hessian"} & set(re.findall(r"\w+", block)):
            exec(block, names)
    if ways == 2:
        np.testing.assert_allclose(names["same"], names["gradient"], rtol=1e-9, atol=1e-15)
    assert 0 < float(names["gradient"][0]) <= 0.1 and float(names["residual"]) < 1e-6
