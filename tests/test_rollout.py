"""`mjx-study rollout`: numbers are those of the objective and of the C engine, files are whole, errors are clear."""

import functools
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_study import cli
from mjx_study.cli import motions, rollout
from mjx_study.cli import options as shared
from mjx_study.objective import Simulator
from mjx_study.simulation.engine import quiet_engine
from mjx_study.simulation.names import coordinates
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid
from tests.documents import stages_of

SHORT = ["pusher", "--horizon", "10", "--renderer", "drawing"]
FILES = ["rollout.gif", "strip.pdf", "strip.png", "stroboscope.pdf", "stroboscope.png", "trajectory.npz"]
PENDULUM = """<mujoco><option timestep=".01"/><worldbody>
  <body name="rod"><joint name="hinge" axis="0 1 0"/><geom type="capsule" size=".05" fromto="0 0 0 1 0 0"/></body>
</worldbody><actuator><motor joint="hinge"/></actuator>{keyframe}</mujoco>"""
KEYFRAME = '<keyframe><key qpos=".3" qvel="-1" ctrl="2"/></keyframe>'


@pytest.fixture(autouse=True)
def elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Default folders lie in a temporary one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def call(*arguments: str) -> int:
    """The command alone, its errors as they are raised."""
    return rollout.run(cli.parser("rollout").parse_args(["rollout", *arguments]))


def document(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    """What a run prints as JSON, and nothing else."""
    assert call(*arguments, "--json") == 0
    printed = capsys.readouterr()
    assert stages_of(printed.err) == ["[0/2] simulating", "[1/2] drawing"]
    return json.loads(printed.out)


@functools.cache
def ten_steps() -> Simulator:
    return Simulator(make_task("pusher", horizon=10), chunk_size=1)


@pytest.mark.parametrize("noise", [[], ["--noisy", "--seed", "3"]], ids=["silent", "noisy"])
def test_the_cost_is_the_objectives(capsys: pytest.CaptureFixture[str], noise: list[str]) -> None:
    """The same sample as in a batch: the value with its key's noise, the baseline without."""
    facts = document(capsys, *SHORT, "--contact", "penalty", "--stiffness", "1000", *noise)
    task = ten_steps().task
    (cell,), _ = family_grid(task, ("penalty",), (1000.0,))
    batch = ten_steps().objective(cell.contact).evaluate(task.theta, jax.random.key(3)[None])
    assert facts["cost"] == pytest.approx(float((batch.value if noise else batch.baseline)[0]), rel=1e-9)
    assert facts["contact"] == "penalty" and facts["stiffness"] == 1000 and facts["finite"]
    assert facts["sigma"] == (0.1 if noise else 0) and facts["residual"] < 1e-6


def test_a_trajectory_has_every_state_and_control(capsys: pytest.CaptureFixture[str], elsewhere: Path) -> None:
    facts = document(capsys, *SHORT)
    folder = elsewhere / "results" / "pusher-rollout"
    assert sorted(path.name for path in folder.iterdir()) == FILES
    assert sorted(facts["written"]) == [f"results/pusher-rollout/{name}" for name in FILES]
    data = np.load(folder / "trajectory.npz")
    np.testing.assert_allclose(data["time"], 0.005 * np.arange(11))
    assert data["qpos"].shape == data["qvel"].shape == (11, 2)
    np.testing.assert_allclose(data["qpos"][0], [0, 1])
    np.testing.assert_allclose(data["controls"], np.full((10, 1), 0.1))
    assert facts["steps"] == 10 and facts["duration"] == pytest.approx(0.05)
    # The pusher starts at 0, and the slider's joint is 1 where its body is at 1.
    assert facts["bodies"]["pusher"] == pytest.approx([data["qpos"][-1, 0], 0, 0])
    assert facts["bodies"]["slider"] == pytest.approx([data["qpos"][-1, 1], 0, 0])
    assert list(facts["qpos"].values()) == data["qpos"][-1].tolist()
    assert call(*SHORT) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    for name, value in facts["qpos"].items():
        assert [name, f"{value:.4f}", "m"] in lines


def test_coordinates_are_named_by_their_joints() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><freejoint name="root"/><geom size=".1"/>
        <body><joint type="ball" pos="1 0 0"/><geom size=".1"/>
        <body name="arm"><joint/><joint name="out" type="slide"/><geom size=".1"/></body></body></body></worldbody>
        </mujoco>"""
    )
    places, turns = [(f"root, {axis}", "m") for axis in "xyz"], [(f"root, q{axis}", "") for axis in "wxyz"]
    ball = [(f"joint 1, q{axis}", "") for axis in "wxyz"]
    assert coordinates(model) == [*places, *turns, *ball, ("joint 2 of arm", "rad"), ("out", "m")]


def test_theta_as_numbers(capsys: pytest.CaptureFixture[str], elsewhere: Path) -> None:
    facts = document(capsys, "pusher", "--horizon", "3", "--frames", "1", "--theta=-0.5,1,2e-1")
    assert facts["theta"] == [-0.5, 1.0, 0.2]
    data = np.load(elsewhere / "results" / "pusher-rollout" / "trajectory.npz")
    np.testing.assert_allclose(data["controls"][:, 0], [-0.5, 1.0, 0.2])


@pytest.mark.parametrize(
    "keyframe", [pytest.param("", id="reference pose", marks=pytest.mark.slow), pytest.param(KEYFRAME, id="keyframe")]
)
def test_an_mjcf_moves_as_the_c_engine_moves_it(
    capsys: pytest.CaptureFixture[str], elsewhere: Path, keyframe: str
) -> None:
    path = elsewhere / "rod.xml"
    path.write_text(PENDULUM.format(keyframe=keyframe))
    facts = document(capsys, str(path), "--renderer", "drawing")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    if keyframe:
        data.qpos[0], data.qvel[0], data.ctrl[0] = 0.3, -1, 2
    for _ in range(200):
        mujoco.mj_step(model, data)
    written = np.load(elsewhere / "results" / "rod-rollout" / "trajectory.npz")
    assert written["qpos"].shape == (201, 1) and written["controls"].shape == (200, 1)
    np.testing.assert_allclose(written["qpos"][-1], data.qpos, rtol=1e-12)
    np.testing.assert_allclose(written["qvel"][-1], data.qvel, rtol=1e-12)
    np.testing.assert_allclose(written["controls"], 2.0 if keyframe else 0.0)
    mujoco.mj_forward(model, data)
    assert facts["bodies"]["rod"] == pytest.approx(data.body("rod").xipos.tolist())
    assert facts["duration"] == pytest.approx(2) and "cost" not in facts


def test_a_rollout_that_is_lost_is_shown_as_far_as_it_goes(capsys: pytest.CaptureFixture[str], elsewhere: Path) -> None:
    path = elsewhere / "runaway.xml"
    path.write_text(
        """<mujoco><option timestep=".01" gravity="0 0 0"/><worldbody><body name="ball">
        <joint type="slide" axis="1 0 0" stiffness="-1e4"/><geom size=".1" mass="1"/></body></worldbody>
        <keyframe><key qpos="1"/></keyframe></mujoco>"""
    )
    with quiet_engine():  # it warns here, on standard error if a test before has called `configure`
        facts = document(capsys, str(path), "--horizon", "100", "--renderer", "drawing")
    assert not facts["finite"] and "the state is not finite from" in facts["warnings"][0]
    data = np.load(elsewhere / "results" / "runaway-rollout" / "trajectory.npz")
    assert len(data["qpos"]) == 101
    good = np.all(np.abs(data["qpos"]) < 1e10, axis=1) & np.all(np.abs(data["qvel"]) < 1e10, axis=1)
    assert not good.all() and facts["bodies"]["ball"][0] == pytest.approx(data["qpos"][np.argmin(good) - 1, 0])


def test_a_policy_keeps_what_is_zero_and_not_what_is_none(capsys: pytest.CaptureFixture[str], elsewhere: Path) -> None:
    """A damping of 0 is one; a stiffness of 0 stands for none in files written earlier."""
    policy = {"task": "pusher", "theta": [0.1, 0.1], "contact": "mujoco", "stiffness": 100.0, "horizon": 2}
    costs = []
    for given in ({}, {"damping": 0.0}, {"stiffness": 0}):
        (elsewhere / "policy.json").write_text(json.dumps(policy | given))
        facts = document(capsys, "pusher", "--theta", "policy.json", "--frames", "1")
        costs.append((facts["stiffness"], facts["cost"]))
    middle = make_task("pusher").defaults.middle_stiffness
    assert [stiffness for stiffness, _ in costs] == [100.0, 100.0, middle] and costs[0][1] != costs[1][1]


def test_a_policy_is_shown_with_another_contact(capsys: pytest.CaptureFixture[str], elsewhere: Path) -> None:
    """Which takes none of the options of the policy's own."""
    policy = {"task": "pusher", "theta": [0.1, 0.1], "contact": "hunt_crossley", "horizon": 2}
    policy |= {"stiffness": 100.0, "damping": 1.0, "smoothing": 1e-4}
    (elsewhere / "policy.json").write_text(json.dumps(policy))
    facts = document(capsys, "pusher", "--theta", "policy.json", "--frames", "1", "--contact", "mujoco_default")
    assert facts["contact"] == "mujoco_default" and facts["stiffness"] != 100


def test_a_theta_without_a_finite_cost(capsys: pytest.CaptureFixture[str], elsewhere: Path) -> None:
    np.save(elsewhere / "theta.npy", np.full(10, 1e200))
    facts = document(capsys, *SHORT, "--theta", "theta.npy")
    assert facts["cost"] is None and not facts["finite"]


def test_a_policy_of_another_task_is_refused(elsewhere: Path) -> None:
    (elsewhere / "theirs.json").write_text('{"task": "tennis", "theta": [1]}')
    with pytest.raises(shared.UsageError, match="theirs.json is a policy of tennis, not of pusher"):
        call("pusher", "--theta", "theirs.json")


def test_mp4_without_ffmpeg_and_opengl_without_a_library(monkeypatch: pytest.MonkeyPatch, elsewhere: Path) -> None:
    monkeypatch.setenv("PATH", str(elsewhere))
    with pytest.raises(shared.UsageError, match="mp4 needs ffmpeg, which is not on the PATH; use the format gif"):
        call("pusher", "--format", "mp4")
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(shared.UsageError, match="MuJoCo's renderer does not work here .*; use the renderer drawing"):
        call("pusher", "--renderer", "opengl")
    assert not (elsewhere / "results").exists()


def test_a_start_that_is_not_finite_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    task = make_task("pusher", horizon=2)
    start = task.draw_start(jax.random.key(0))
    lost = type(start)(jnp.full(2, jnp.nan), start.qvel, start.act, start.warmstart)
    monkeypatch.setattr(motions, "task_of", lambda options: task.replace(start=lost))
    with pytest.raises(shared.UsageError, match="pusher: .*: the first state is not finite"):
        call(*SHORT, "--output", "out")
