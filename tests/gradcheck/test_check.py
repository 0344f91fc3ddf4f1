"""The check passes right derivatives, and finds, names and explains the others."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_study import cli
from mjx_study.gradcheck import Finding, GradcheckReport, gradcheck, plan_gradcheck, plan_scene_gradcheck
from mjx_study.gradcheck.causes import ROUNDING_DECIDES
from mjx_study.gradcheck.cost import CostPrograms, check_cost
from mjx_study.simulation import dynamics
from mjx_study.simulation.scene import load_scene
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import ContactPoint
from tests.scenes import plain_warm_start, scene_of

CONVERGED = 'iterations="100" ls_iterations="50"'
BALL = (
    '<body name="ball"><joint name="{name}" type="slide" axis="{axis}"/><geom name="ball" size=".1" mass="1"/></body>'
)


def check(xml: str, *families: str, states: int = 1, horizon: int = 20, **options: object) -> GradcheckReport:
    """The report on a scene."""
    scene = scene_of(f"<mujoco>{xml}</mujoco>")
    plan = plan_scene_gradcheck(scene, families or None, seed=0, states=states, horizon=horizon, **options)  # type: ignore[arg-type]
    return gradcheck(plan)


def only(report: GradcheckReport, verdict: str) -> Finding:
    """The one finding of a verdict."""
    (finding,) = [finding for finding in report.findings if finding.verdict == verdict]
    return finding


def test_the_pusher_is_right(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["gradcheck", "pusher", "--horizon", "12", "--stiffness", "100", "--states", "2"]
    assert cli.main([*arguments, "--contact", "penalty,mujoco_default", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["passed"] is True
    penalty, default = document["costs"]
    assert penalty["verdict"] == default["verdict"] == "right"
    assert penalty["closed_form"] < 1e-3 and default["closed_form"] is None
    for cost in (penalty, default):
        assert cost["modes"] < 1e-10 and cost["difference"] < 1e-6 and cost["residual"] < 1e-9
    for step in document["steps"]:
        assert step["modes"] < 1e-10 and step["differences"] < 1e-6 and step["parameters"] < 1e-6
        assert step["stock_step"] < 1e-6 and step["engine_step"] < 1e-8 and step["engine"] < 1e-5
        assert step["coverage"]["counts"]["push"] and step["coverage"]["missing"] == []


def test_a_gradient_that_is_no_number_is_told_from_a_wrong_step() -> None:
    """Of a cost with a square root at 0, in the branch that is not taken."""
    task = make_task("pusher", horizon=3)
    kinky = lambda state, control: jnp.where(control[0] > 5, jnp.sqrt(control[0] - 5), 0 * state.qpos[0])  # noqa: E731
    report = gradcheck(plan_gradcheck(task.replace(running_cost=kinky), ["mujoco_default"], None, seed=0, states=1))
    assert [check.verdict for check in report.costs] == ["nan"] and not any(each.fails for each in report.findings)
    assert not report.passed and report.failure == "nan"
    assert report.lines()[-1].startswith("NOT RIGHT: the derivatives of steps are right, but")
    assert "cost or policy" in report.reason


@pytest.mark.parametrize(
    ("slope", "domain", "verdict"), [(50.0, 0.0, "right"), (0.0, 0.0, "wrong"), (50.0, 1e-4, "unresolved")]
)
def test_a_cost_is_judged_where_it_is_finite(slope: float, domain: float, verdict: str) -> None:
    """A square root near the end of its domain, which the longest differences leave."""
    none = np.zeros((0, 1))

    class Root(CostPrograms):
        def __init__(self) -> None:
            self.task = make_task("pusher", horizon=1).replace(theta=jnp.array([1e-4]), reference=None)
            self.key = jax.random.key(0)

        def gradient(self, contact: Any, directions: np.ndarray) -> Any:
            states = SimpleNamespace(qpos=none, qvel=none, act=none, warmstart=none)
            return (states, none, 0.0, None), np.array([slope]), directions[:, 0] * slope

        def costs(self, contact: Any, changes: np.ndarray) -> np.ndarray:
            theta = 1e-4 + changes[:, 0]
            return np.where((theta > domain) | (changes[:, 0] == 0), np.sqrt(np.maximum(theta, 0)), np.nan)

    assert check_cost(Root(), ContactPoint("mjcf", None, None), seed=0)[0].verdict == verdict


def test_a_wrong_derivative_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    right = dynamics.step_change

    def slightly_wrong(*arguments):
        qpos, qvel, act, qacc = right(*arguments)
        return qpos, qvel * (1 + 1e-4), act, qacc

    monkeypatch.setattr(dynamics, "step_change", slightly_wrong)
    report = check(f"<worldbody>{BALL.format(name='x', axis='1 0 0')}</worldbody>")
    assert not report.passed and {finding.verdict for finding in report.findings} == {"wrong"}
    assert report.lines()[-1] == "NOT RIGHT: the derivative is not that of the step"


def test_a_kink_is_not_a_wrong_derivative() -> None:
    """Without a first push the bodies rest exactly at the onset of contact, where a difference straddles it."""
    task = make_task("pusher", horizon=6)
    task = task.replace(theta=task.theta.at[0].set(0.0))
    report = gradcheck(plan_gradcheck(task, ["mujoco"], [100.0], seed=0, states=1))
    assert report.passed and report.steps[0].verdict == "kink"
    assert all("onset" in finding.cause for finding in report.findings), report.findings
    assert any(line.startswith("kink:") for line in report.lines())


@pytest.mark.slow
def test_a_jump_is_not_a_wrong_derivative() -> None:
    """MuJoCo's default contact begins with its damping force: a ball that arrives with speed meets a jump."""
    falling = BALL.format(name="z", axis="0 0 1").replace("<body", '<body pos="0 0 .1"')
    key = '<keyframe><key qpos="0" qvel="-1"/></keyframe>'
    floor = '<geom name="floor" type="plane" size="1 1 1"/>'
    report = check(f"<option {CONVERGED}/><worldbody>{floor}{falling}</worldbody>{key}")
    jump = only(report, "jump")
    assert "floor and ball is at its onset" in jump.cause, jump.cause
    assert report.passed and "d qvel[z] / d qpos[z]" in {entry.name for entry in jump.entries}


LYING = """
<option timestep="0.002"/>
<worldbody>
  <geom name="log" type="cylinder" size=".2 .5" euler="{log}"/>
  <body pos="0 0 .245">
    <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
    <joint name="turn" type="hinge" axis="0 1 0"/>
    <geom name="bar" type="{kind}" size=".05 .2" euler="{bar}" mass="1"/>
  </body>
</worldbody>
"""


@pytest.mark.slow
def test_rounding_decides_where_rollers_touch() -> None:
    """Anywhere along the line: two programs of the same step differ, as do its two modes, and neither is wrong."""
    report = check(LYING.format(kind="cylinder", log="90 0 0", bar="90 0 0"), states=40, horizon=200)
    causes = {finding.cause: len(finding.entries) for finding in report.findings if finding.verdict == "jump"}
    assert causes.get(ROUNDING_DECIDES) and report.passed, report.lines()


def test_a_control_at_its_bound_is_a_kink() -> None:
    motor = '<actuator><motor name="push" joint="x" ctrlrange="0 1" ctrllimited="true"/></actuator>'
    world = f"<worldbody>{BALL.format(name='x', axis='1 0 0')}</worldbody>"
    report = check(world + motor)
    assert only(report, "kink").cause == "a control is at the end of its range, where MuJoCo clips it"
    assert {entry.name for entry in only(report, "kink").entries} == {
        "d qpos[x] / d ctrl[push]",
        "d qvel[x] / d ctrl[push]",
    }


def test_a_joint_at_its_limit_is_named() -> None:
    joint = '<joint name="x" type="slide" axis="1 0 0" limited="true" range="0 1"/>'
    report = check(f'<worldbody><body>{joint}<geom size=".1" mass="1"/></body></worldbody>')
    causes = {finding.cause for finding in report.findings}
    assert report.passed and causes == {"x is at its limit"}


@pytest.mark.slow
def test_an_upright_cylinder_excuses_its_own_entries_and_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its three contact points turn with the direction in which it tilts, however little; bodies beside it do not jump.

    The tilt is 1e-9 rad, which differences reach across. The planted fault is in a slider that touches nothing.
    """
    right = dynamics.step_change

    def wrong_beside(*arguments):
        qpos, qvel, act, qacc = right(*arguments)
        return qpos, qvel.at[3].multiply(1 + 1e-3), act, qacc  # the slider's

    monkeypatch.setattr(dynamics, "step_change", wrong_beside)
    cylinder = (
        '<body pos="0 0 .0999"><joint name="z" type="slide" axis="0 0 1"/><joint name="a" axis="1 0 0"/>'
        '<joint name="b" axis="0 1 0"/><geom name="can" type="cylinder" size=".1 .1" mass="1"/></body>'
    )
    beside = (
        '<body pos="1 0 1"><joint name="slider" type="slide" axis="1 0 0" stiffness="30" damping="2"/>'
        '<geom size=".1" mass="1" contype="0" conaffinity="0"/></body>'
    )
    key = '<keyframe><key qpos="0 1e-9 0 .1"/></keyframe>'
    floor = '<geom type="plane" size="1 1 1"/>'
    report = check(f"<option {CONVERGED}/><worldbody>{floor}{cylinder}{beside}</worldbody>{key}")
    jumps = [finding for finding in report.findings if finding.verdict == "jump"]
    assert jumps and any("can stands upright" in finding.cause for finding in jumps)
    assert not any("slider" in entry.name for finding in jumps for entry in finding.entries)
    wrong = {entry.name for f in report.findings if f.verdict == "wrong" for entry in f.entries if entry.name}
    assert {"d qvel[slider] / d qpos[slider]", "d qvel[slider] / d qvel[slider]"} <= wrong
    assert all("slider" in name for name in wrong)
    assert not report.passed


@pytest.mark.slow
def test_runge_kutta_is_compared_with_the_engine() -> None:
    rod = '<body><joint name="j" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body>'
    motor = '<actuator><motor joint="j"/></actuator>'
    report = check(f'<option integrator="RK4"/><worldbody>{rod}</worldbody>{motor}', states=2)
    (step,) = report.steps
    assert report.passed and report.findings == () and step.states == 2
    assert step.engine_step is not None and step.engine_step <= 1e-8
    assert step.stock_step is not None and step.stock_step <= 1e-8
    assert step.engine is not None and step.engine < 1e-6


def test_a_silent_zero_fails() -> None:
    tendon = '<tendon><spatial stiffness="100" springlength="0"><site site="a"/><site site="b"/></spatial></tendon>'
    body = '<body><joint name="y" type="slide" axis="0 1 0"/><geom size=".1" mass="1"/><site name="b"/></body>'
    report = check(f'<worldbody><site name="a"/>{body}</worldbody>{tendon}')
    zero = only(report, "zero")
    assert not report.passed and zero.fails and "tendon of zero length" in zero.cause
    assert report.lines()[-1] == "NOT RIGHT: the derivative is not that of the step"  # others are wrong


@pytest.mark.slow
def test_a_nan_fails_in_the_mode_that_has_it() -> None:
    tendon = '<tendon><fixed name="t" actuatorfrcrange="-1 1"><joint joint="x" coef="1"/></fixed></tendon>'
    far = '<geom type="plane" size="1 1 1" pos="0 0 -9"/>'  # with contacts, reverse mode is checked on the tape as well
    world = f"<worldbody>{far}{BALL.format(name='x', axis='1 0 0')}</worldbody>"
    report = check(f'{world}{tendon}<actuator><motor name="push" tendon="t"/></actuator>')
    nan = only(report, "nan")
    assert not report.passed and nan.modes == ("tape",) and "limited actuator force" in nan.cause


@pytest.mark.slow
def test_an_unconverged_solve_is_not_a_wrong_derivative() -> None:
    """One iteration on two contacts that compete; given its budget, the same scene is right."""
    sliding = (
        '<geom type="plane" size="1 1 1"/><body pos="0 0 .0996"><joint name="z" type="slide" axis="0 0 1"/>'
        '<joint name="x" type="slide" axis="1 0 0"/><joint name="turn" axis="0 1 0"/><geom size=".1" mass="1"/>'
        '<geom size=".1" pos=".3 0 0" mass="1"/></body>'
    )
    key = '<keyframe><key qpos="0 0 0" qvel="-.1 .3 .2"/></keyframe>'
    with plain_warm_start():  # which would solve so few coordinates by itself
        short = check(f'<option solver="CG" iterations="1" ls_iterations="2"/><worldbody>{sliding}</worldbody>{key}')
    assert not short.passed and {f.verdict for f in short.findings if f.fails} == {"unconverged"}
    assert all("iterations=1 and ls_iterations=2" in finding.cause for finding in short.findings if finding.fails)
    whole = check(f'<option solver="CG" {CONVERGED}/><worldbody>{sliding}</worldbody>{key}')
    assert whole.passed and whole.steps[0].residual < 1e-9


@pytest.mark.slow
def test_contacts_placed_differently_are_reported_and_do_not_fail() -> None:
    """MuJoCo and MJX pick other points of the area in which two boxes touch."""
    boxes = (
        '<geom name="table" type="box" size="1 1 .1" pos="0 0 -.1"/><body pos="0 0 .099" euler="0 0 20">'
        '<joint name="z" type="slide" axis="0 0 1"/><joint name="tilt" axis="0 1 0"/>'
        '<geom name="box" type="box" size=".1 .2 .1" mass="1"/></body>'
    )
    key = '<keyframe><key qpos="0 .0005" qvel="0 .1"/></keyframe>'
    report = check(f"<option {CONVERGED}/><worldbody>{boxes}</worldbody>{key}")
    placement = only(report, "engine_mismatch")
    assert report.passed and not placement.fails and "table and box" in placement.cause
    assert report.steps[0].engine is None  # another step has another derivative


@pytest.mark.slow
def test_stock_derivatives_are_checked_apart() -> None:
    """MJX takes the derivative of a rotation at rest as zero: a finding that is not the project's."""
    world = '<worldbody><body><joint name="ball" type="ball"/><geom size=".1" mass="1"/></body></worldbody>'
    report = check(world, stock=True)
    zero = only(report, "zero")
    assert report.passed and zero.who == "mjx.step" and "norm of its angular velocity" in zero.cause
    assert report.steps[0].verdict == "right" and report.steps[0].stock == pytest.approx(1.0)


def test_plans_are_refused() -> None:
    """Of stiffnesses without the pair that they act on, among others."""
    scene, task = load_scene("pusher"), make_task("pusher", horizon=3)
    with jax.enable_x64(False):
        single = make_task("pusher", horizon=3)
    fixed = scene_of('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>')
    plan = plan_scene_gradcheck(scene, ["penalty"], [10.0, 100.0], seed=0, pair=("pusher", "slider"))
    assert [cell.stiffness for cell in plan.cells] == [10.0, 100.0]
    refused: tuple[Any, ...] = (
        (plan_scene_gradcheck, (scene, ["penalty"]), {}, "`pair`"),
        (plan_scene_gradcheck, (scene, ["penalty"], [10.0]), {}, "`pair`"),
        (plan_scene_gradcheck, (scene, ["mujoco_default"], [10.0]), {}, "`stiffness` has no effect on .* mujoco_def"),
        (plan_scene_gradcheck, (scene, ["penalty"], [10.0]), {"pair": ("pusher", "nothing")}, "no geom 'nothing'"),
        (plan_scene_gradcheck, (fixed,), {}, "no degree of freedom"),
        (plan_gradcheck, (single, ["penalty"], [10.0]), {}, "needs float64"),
        (plan_gradcheck, (task, [], [10.0]), {}, "no contact model"),
        (plan_gradcheck, (task, ["penalty"], [10.0]), {"states": 0}, "states must be at least 1"),
    )
    for make, arguments, options, message in refused:
        with pytest.raises(ValueError, match=message):
            make(*arguments, seed=0, **options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["FILE", "--pair", "a"], "names of two geoms, got 1"),
        (["FILE", "--model", "FILE"], "a file already"),
        (["FILE", "--contact", "penalty"], "--stiffness must be given in N/m, along with --pair"),
        (["FILE", "--stiffness", "100"], "give --pair GEOM,GEOM"),
        (["missing.xml"], "missing.xml"),
        (["broken.xml"], "broken.xml"),
    ],
)
def test_invalid_requests_are_refused_in_one_line(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ball.xml").write_text(f"<mujoco><worldbody>{BALL.format(name='x', axis='1 0 0')}</worldbody></mujoco>")
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody>")
    assert cli.main(["gradcheck", *(part.replace("FILE", "ball.xml") for part in arguments)]) == 2
    printed = capsys.readouterr()
    assert message in printed.err and printed.err.count("\n") == 1 and printed.out == ""
