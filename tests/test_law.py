"""Contact laws beyond MuJoCo's: static load, derivatives, what commands leave out for them, refusals."""

import dataclasses
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import mjx_study as study
from mjx_study import cli
from mjx_study.bench import run_bench
from mjx_study.choices import FAMILIES
from mjx_study.diagnose.page import document_of, page_lines
from mjx_study.diagnose.run import diagnose_task, plan_diagnosis
from mjx_study.execution.run import run_study
from mjx_study.graph import scalars
from mjx_study.graph.native import SWITCH
from mjx_study.objective import rollout_cost
from mjx_study.options.configuration import StudyConfig
from mjx_study.simulation.contact import apply_contact, cone_edges, effective_mass, family_model
from mjx_study.simulation.dynamics import State, step
from mjx_study.simulation.law import LAWS, MujodicoLaw
from mjx_study.simulation.scene import Scene, put_scene
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import single_contact
from mjx_study.tasks.policy import InitialStatePolicy
from mjx_study.tasks.task import StudyDefaults, Task

BALL = """<mujoco><option timestep="0.002" cone="{}"/><worldbody><geom name="floor" type="plane" size="5 5 1"/>
  <body pos="0 0 0.1"><freejoint/><geom name="ball" size="0.1" mass="1"/></body></worldbody></mujoco>"""
PAIR = ("ball", "floor")
WEIGHT = 9.81
ACCURACY = 1e-5


def ball(cone: str = "pyramidal") -> Scene:
    return put_scene(mujoco.MjModel.from_xml_string(BALL.format(cone)), "ball")


def stepping(scene: Scene, law: str, stiffness: float | None = None):
    mass = effective_mass(scene, *PAIR)
    contact = family_model(law, scene, stiffness=stiffness, effective_mass=mass, edges=cone_edges(scene, *PAIR))
    return partial(step, scene, apply_contact(scene.model, contact), control=jnp.zeros(0))


def settled(advance: partial[Any], steps: int) -> State:
    """The last state of a fall from the reference pose."""
    start = study.initial_state(advance.args[0])
    return jax.jit(lambda state: jax.lax.fori_loop(0, steps, lambda _, at: advance(state=at)[0], state))(start)


DROP = """<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="1 1 .1" condim="1"/>
  <body><joint type="slide" axis="0 0 1"/><geom name="ball" size=".1" mass="1" condim="1"/></body></worldbody>
  <keyframe><key qpos="0.11" qvel="-1"/></keyframe></mujoco>"""


TWO = """<mujoco><option timestep="0.002" gravity="0 0 0"/><default><geom size=".1" mass="1" condim="1"/>
  <joint type="slide" axis="1 0 0"/></default><worldbody><body><joint/><geom name="ball"/></body>
  <body pos=".7 0 0"><joint/><geom name="other"/></body></worldbody></mujoco>"""


def thrown(horizon: int = 80) -> Task:
    """A ball thrown at another, half a metre away, which is to move as far; its speed is the parameter."""
    scene = put_scene(mujoco.MjModel.from_xml_string(TWO), "two")

    def start_at(start: State, theta: jax.Array) -> State:
        return dataclasses.replace(start, qvel=jnp.append(theta, 0.0))

    return Task(
        name="thrown",
        scene=scene,
        horizon=horizon,
        policy=InitialStatePolicy(1, horizon, 0, start_at, "m/s"),
        theta=jnp.array([5.0]),
        sigma=0.5,
        start=study.initial_state(scene),
        final_cost=lambda state: 4 * (state.qpos[1] - 0.5) ** 2,
        contact_pair=("ball", "other"),
        defaults=StudyDefaults(stiffnesses=(1e4,)),
    )


THROWN = f"{__name__}:thrown"


@pytest.fixture(autouse=True)
def _installed(request: pytest.FixtureRequest) -> None:
    if "missing" not in request.node.name:
        pytest.importorskip("mujodico", reason="the extra laws is not installed")


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
@pytest.mark.parametrize("law", ["hunt_crossley", "kelvin_voigt"])
def test_a_static_load_measures_the_stiffness(law: str, cone: str) -> None:
    stiffness = 2000.0
    last = settled(stepping(ball(cone), law, stiffness), 3000)
    assert float(jnp.abs(last.qvel).max()) < 1e-6
    assert WEIGHT / (0.1 - float(last.qpos[2])) == pytest.approx(stiffness, rel=0.01)


@pytest.mark.parametrize("law", ["log_barrier", "conic"])
def test_a_barrier_floats_in_proportion_to_its_smoothing(law: str) -> None:
    """Both laws, at the same kappa: four edges share the weight's impulse, each kappa over phi / (h + tau)."""
    scene, kappa, tau = ball(), 1e-4, 2 * 0.95 * 0.02
    contact = family_model(law, scene, effective_mass=1.0, smoothing=kappa)
    last = settled(partial(step, scene, apply_contact(scene.model, contact), control=jnp.zeros(0)), 2000)
    assert float(last.qpos[2]) - 0.1 == pytest.approx(4 * kappa * (0.002 + tau) / (0.002 * WEIGHT), rel=1e-3)


@pytest.mark.parametrize("law", list(LAWS))
def test_derivatives_are_those_of_differences_in_both_modes(law: str) -> None:
    scene = ball()
    advance = stepping(scene, law, 2000.0 if study.FAMILIES[law].swept else None)
    moved = jnp.array([0.3, 0.1, -0.2, 0.4, -0.3, 0.2])

    def after(height_and_qvel: jax.Array) -> jax.Array:
        qpos = scene.template.qpos.at[2].set(height_and_qvel[0])
        found = advance(state=State(qpos, height_and_qvel[1:], scene.template.act, jnp.zeros(6)))[0]
        return jnp.concatenate([found.qpos, found.qvel])

    point = jnp.concatenate([jnp.array([0.099]), moved])
    forward, reverse = (jax.jit(mode(after))(point) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, atol=1e-9)
    size, run = 1e-6, jax.jit(after)
    differences = np.stack([(run(point + d) - run(point - d)) / (2 * size) for d in size * jnp.eye(7)], axis=1)
    np.testing.assert_allclose(forward, differences, atol=ACCURACY * np.abs(differences).max())


@pytest.mark.parametrize(
    ("law", "given", "cone", "message"),
    [
        *((law, {"smoothing": 0.0}, "pyramidal", "needs a smoothing above 0") for law in LAWS),
        ("hunt_crossley", {"stiffness": 1.0, "damping": 1.0}, "pyramidal", "in s/m: omit the damping"),
        *((law, {}, "elliptic", "does not support elliptic cones") for law in ("log_barrier", "conic")),
    ],
)
def test_what_a_law_lacks_is_refused(law: str, given: dict[str, Any], cone: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        family_model(law, ball(cone), effective_mass=1.0, **given)


def test_gradcheck_counts_what_has_no_counterpart(capsys: pytest.CaptureFixture[str]) -> None:
    """Its own differences judge the derivative; the steps of mjx.step and the C engine are those of another law."""
    law = [THROWN, "--contact", "hunt_crossley", "--stiffness", "1000", "--states", "3"]
    assert cli.main(["gradcheck", *law, "--smoothing", "1e-4", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    (own,) = document["steps"]
    assert own["stock_step"] is own["engine_step"] is own["engine"] is None
    assert own["verdict"] == "right" and own["differences"] < 1e-6 and own["coverage"]["counts"]["push"]
    (said,) = [warning for warning in document["warnings"] if "not compared" in warning]
    assert said.startswith("hunt_crossley, K = 1000 N/m: 3 states not compared with mjx.step and the C engine")


def miss(document: dict[str, Any]) -> float:
    """Largest distance of E[FoBG] from the slope of the mean cost, over the steepest."""
    slope, first = (np.array(document["curves"][-1][name]) for name in ("exact_slope", "exact_first"))
    return np.abs(first - slope).max() / np.abs(slope).max()


@pytest.mark.parametrize(
    ("command", "measured", "low", "high"),
    [
        ("compare --estimators fobg --samples 20", lambda found: found["rows"][0]["relative_error"], 0.0, 0.1),
        (
            "optimise --estimators fobg --iterations 20 --samples 10 --learning-rate 1",
            lambda of: of["runs"][0]["final_cost"][0] / of["start_cost"][0], 0, 0.9,
        ),
        ("landscape --points 3 --samples 40", miss, 0.0, 0.05),
        ("rollout", lambda found: found["cost"], 0.1, 10.0),
    ],
)  # fmt: skip
def test_every_command_takes_a_law(
    command: str, measured: Callable[[Any], float], low: float, high: float, capsys, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    used, own = [], MujodicoLaw.equations
    monkeypatch.setattr(MujodicoLaw, "equations", lambda law, scene: used.append(law.name) or own(law, scene))
    name, *options = command.split()
    law = f"{THROWN} --contact kelvin_voigt --stiffness 10000 --json".split()
    assert cli.main([name, *law, *options]) == 0
    document = json.loads(capsys.readouterr().out)
    assert set(used) == {"kelvin_voigt"} and not document["warnings"] and "means" not in document
    assert low <= measured(document) < high


@pytest.mark.parametrize("most", [9, 20_000], ids=["as it is", "as a graph"])
def test_a_timestep_may_be_a_number(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SWITCH, "xla")
    monkeypatch.setitem(scalars.MOST_SCALARS, "cpu", most)
    advance = stepping(ball(), "kelvin_voigt", 2000.0)
    scene, model = advance.args
    start = study.initial_state(scene, scene.template.qpos.at[2].set(0.2))
    shorter = model.replace(opt=model.opt.replace(timestep=5e-4))
    fallen = jax.jit(lambda state: step(scene, shorter, state, jnp.zeros(0))[0].qvel[2])(start)
    assert float(fallen) == pytest.approx(-9.81 * 5e-4, rel=0.01)  # a rounded force acts at a distance


def test_diagnose_judges_means_under_every_law() -> None:
    """What begins, and how much its step varies, does not depend on the law: the ball flies freely until then."""
    for law, lead in (("hunt_crossley", 0.004), ("log_barrier", 0.002 + 0.95 * 0.04)):
        found = diagnose_task(THROWN, plan_diagnosis(THROWN, thrown(), law, samples=60), samples=60)
        document, page = document_of(found), "\n".join(page_lines(found))
        means = {each["estimator"]: each["mean"] for each in document["estimators"]}
        assert means == {"zobg": "unbiased", "fobg": "right", "aobg": "right"}
        assert document["derivatives"] == "right" and document["onsets"] == 60
        (touch,) = document["touches"]
        assert document["onset_spread"] == pytest.approx(5, rel=0.3)  # a tenth of the 50 steps of the flight
        assert 0 <= lead * touch["speed"] - touch["distance"] < 1.5 * 0.002 * touch["speed"]
        assert f"{law} is not MuJoCo's law" in page and "take fobg" in page
        assert not any(each in page for each in ("_onset", "--onset", "h^2 k", "solimp", " biased"))


@pytest.mark.slow
def test_bench_leaves_out_rivals_of_another_law() -> None:
    task = make_task("pusher", horizon=3)
    report = run_bench(task, 6, single_contact(task, "hunt_crossley", 100.0)[0])
    assert report.contact.startswith("hunt_crossley")
    assert set(report.ratios) == {"gradient_per_value", "onset_per_gradient"}
    assert any("left out" in line for line in report.lines())


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("gradcheck pusher --contact conic --stock", "--stock is for MuJoCo's law, which conic does not have"),
        ("diagnose pusher --contact conic --smoothing 0", "conic needs a smoothing above 0"),
        ("rollout pusher --contact mujoco --smoothing 1e-5", "--smoothing has no effect on MuJoCo's law"),
        ("sweep pusher --contact conic --onset linear --dry-run", "--onset is for MuJoCo's law"),
        ("sweep pusher --contact mujoco,conic --estimators fobg_onset --dry-run", "corrects MuJoCo's law, not conic"),
        ("compare drop.xml --contact hunt_crossley", "contact_pair, as mjx-study init writes for an MJCF"),
        ("gradcheck drop.xml --contact hunt_crossley", "--stiffness must be given in N/m, along with --pair"),
    ],
)
def test_what_does_not_go_with_a_law_is_refused(
    command: str, message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drop.xml").write_text(DROP)
    assert cli.main(command.split()) == 2
    printed = capsys.readouterr().err
    said = [line for line in printed.splitlines() if line.startswith("mjx-study: ")]
    assert len(said) == 1 and message in said[0], printed


def test_a_law_of_ones_own_is_one_file(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """That of the page: it bears a load by its stiffness, commands and studies take it, and its derivative is right."""
    for table in (LAWS, FAMILIES):
        monkeypatch.setitem(table, "spring", None)  # restored at the end
    page = (Path(__file__).parents[1] / "docs" / "extending.md").read_text()
    code = page.partition("## A contact law of your own")[2].partition("```python\n")[2].partition("```")[0]
    monkeypatch.setitem(sys.modules, "spring", own := ModuleType("spring"))
    exec(code, vars(own))
    scene = put_scene(mujoco.MjModel.from_xml_string(DROP), "drop")
    pressed = study.initial_state(scene, jnp.array([0.1 - WEIGHT / 3000]))
    moved, _ = stepping(scene, "spring", 3000.0)(state=pressed)
    assert abs(float(moved.qvel[0])) < 1e-3 * 0.002 * WEIGHT
    path = tmp_path / "drop.xml"
    path.write_text(DROP)
    spring = ["--contact", "spring", "--stiffness", "3000"]
    assert cli.main(["gradcheck", str(path), *spring, "--pair", "floor,ball", "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["steps"]
    assert found["verdict"] == "right" and found["coverage"]["counts"]["push"]
    with pytest.raises(ValueError, match="spring does not support more than a height"):
        single_contact(make_task("pusher"), "spring", 3000.0)
    task = make_task(str(path), horizon=60).replace(contact_pair=PAIR, sigma=0.1)
    about = StudyConfig(tasks=(task,), contact=("spring",), stiffness=(3000.0,), samples=(50,), estimators=("fobg",))
    assert float(run_study(about)["relative_error"].squeeze()) < 0.1


@pytest.mark.parametrize("model", ["momentum_transfer", "drop.xml"])
def test_a_law_whose_extra_is_missing_says_what_to_install(
    model: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drop.xml").write_text(DROP)
    monkeypatch.setitem(sys.modules, "mujodico", None)
    given = ["--stiffness", "2500", "--pair", "floor,ball"] if model == "drop.xml" else []
    assert cli.main(["gradcheck", model, "--contact", "kelvin_voigt", *given]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[-1].startswith("mjx-study: kelvin_voigt needs MuJoDiCo: pip install 'mjx-study[laws]'")


def test_forces_and_onsets_of_mujocos_law_are_refused() -> None:
    task = make_task("pusher", horizon=3)
    contact = family_model("conic", task.scene, effective_mass=1.0)
    seen = study.observed(task.scene, study.initial_state(task.scene), contact, jnp.zeros(task.scene.host.nu))
    with pytest.raises(ValueError, match="contact_force has forces of MuJoCo's law"):
        seen.contact_force("pusher", "slider")
    assert seen.xpos.shape == (task.scene.host.nbody, 3)  # what moves has no law
    noise = jnp.zeros(task.policy.noise_shape)
    for onset in ("linear", "shift"):
        with pytest.raises(ValueError, match="the onset term is that of MuJoCo's law"):
            rollout_cost(task, task.theta, contact, study.initial_state(task.scene), noise, onset)
