"""`mjx-study init`: a file for any model, which every command runs as it is, or a reason in one line."""

import dataclasses
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import optax
import pytest

from mjx_study import cli, initial_state, load_scene
from mjx_study.authoring import proposal
from mjx_study.authoring.proposal import Proposal, propose
from mjx_study.authoring.task_file import function_name, source_of_task
from mjx_study.authoring.trial import start_of
from mjx_study.simulation.contact import effective_mass
from mjx_study.simulation.scene import put_scene
from mjx_study.tasks.mjcf import scene_task
from mjx_study.tasks.soundness import check_soundness
from mjx_study.tasks.task import Task, check_shapes

ROOT = Path(__file__).parents[1]
FLOOR: Final = '<option timestep="0.004"/><worldbody><geom name="floor" type="plane" size="3 3 .1"/>'
ARM: Final = """
<mujoco model="arm"><option timestep="0.004" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="5 1 0.1" friction="0.6"/>
  <body name="upper" pos="0 0 0.6"><joint name="shoulder" axis="0 1 0" damping="0.1"/>
    <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.5" contype="0" conaffinity="0"/>
    <body name="lower" pos="0.3 0 0"><joint name="elbow" axis="0 1 0" damping="0.1"/>
      <geom name="hand" type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="0.3" contype="2" conaffinity="2"/>
    </body></body>
  <body name="ball" pos="0.35 0 0.05"><joint name="x" type="slide" axis="1 0 0"/>
    <geom name="ball" size="0.2" mass="0.5" contype="2" conaffinity="2"/></body></worldbody>
  <actuator><motor joint="shoulder" gear="5"/><motor name="elbow" joint="elbow" gear="3"/></actuator></mujoco>"""
LEG: Final = """
<mujoco model="leg"><option timestep="0.004" cone="elliptic"/><worldbody>
  <geom name="floor" type="plane" size="5 1 0.1" friction="0.8"/>
  <body name="torso" pos="0 0 0.56"><joint name="x" type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
    <geom type="box" size="0.1 0.08 0.06" mass="3" contype="0" conaffinity="0"/>
    <body name="thigh"><joint name="hip" axis="0 -1 0" damping="0.3"/>
      <geom type="capsule" fromto="0 0 0 0.1 0 -0.22" size="0.03" mass="0.5" contype="0" conaffinity="0"/>
      <body name="shin" pos="0.1 0 -0.22"><joint name="knee" axis="0 -1 0" damping="0.3"/>
        <geom type="capsule" fromto="0 0 0 -0.1 0 -0.22" size="0.02" mass="0.2" contype="0" conaffinity="0"/>
        <geom name="foot" pos="-0.1 0 -0.24" size="0.04" mass="0.1" friction="0.8"/></body></body></body></worldbody>
  <actuator><position name="hip" joint="hip" kp="60" kv="2" ctrlrange="-1 1"/>
    <position name="knee" joint="knee" kp="60" kv="2" ctrlrange="-1 1"/></actuator>
  <keyframe><key qpos="0 0 0.1 0" qvel="0.5 0 0 0" ctrl="0.1 0"/></keyframe></mujoco>"""
AXES: Final = ("0 0 1", "0 1 0", "0 1 0")
BALL: Final = (
    f'<mujoco model="ball">{FLOOR}<body name="ball" pos="0 0 .2"><freejoint/><geom name="ball" size=".1" mass=".5"/>'
    "</body></worldbody></mujoco>"
)
PENDULUM: Final = """
<mujoco model="pendulum"><worldbody><body name="pole" pos="0 0 1"><joint name="swing" axis="0 1 0" damping=".01"/>
  <geom type="capsule" fromto="0 0 0 .1 0 -.5" size=".02" mass=".3"/></body></worldbody>
  <actuator><motor joint="swing"/></actuator></mujoco>"""
LIMITED: Final = PENDULUM.replace('damping=".01"', 'limited="true" range="-20 20"').replace(
    '<actuator><motor joint="swing"/></actuator>', ""
)
WHEEL: Final = PENDULUM.replace("0 0 0 .1 0 -.5", "0 -.1 0 0 .1 0")
SHAKY: Final = PENDULUM.replace('motor joint="swing"', 'position joint="swing" kv="9"').replace(".3", "1e-3")
UNNAMED: Final = BALL.replace('name="ball"', "").replace('name="floor"', "")
PILE: Final = (
    f'<mujoco model="pile">{FLOOR}'
    + "".join(
        f'<body name="b{index}" pos="{0.05 * (index % 2)} 0 {0.1 + 0.22 * index}"><joint type="slide" axis="0 0 1"/>'
        f'<joint type="slide" axis="1 0 0"/><geom name="g{index}" size=".1" mass=".5"/></body>'
        for index in range(4)
    )
    + "</worldbody></mujoco>"
)
INTEGRATOR: Final = PENDULUM.replace(
    '<motor joint="swing"/></actuator>',
    '<intvelocity joint="swing" kp="1" actrange="-1 1"/></actuator><keyframe><key act="0.5"/></keyframe>',
)
MODELS: Final = {
    "arm": ARM, "leg": LEG, "ball": BALL, "pendulum": PENDULUM, "limited": LIMITED, "wheel": WHEEL, "unnamed": UNNAMED,
    "pile": PILE, "integrator": INTEGRATOR,
}  # fmt: skip


def proposed(source: str) -> Proposal:
    return propose(put_scene(mujoco.MjModel.from_xml_string(source), "model"))


def loaded(path: Path) -> ModuleType:
    module = ModuleType(path.stem)
    module.__file__ = str(path)
    exec(compile(path.read_text(), str(path), "exec"), module.__dict__)
    return module


Begun = tuple[Task, dict[str, Any], Path, Proposal]


@pytest.fixture
def begin(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Begun]:
    """Runs init on an MJCF of that name, and returns the task, the document, the file and the proposal."""
    proposals = []
    monkeypatch.setattr(proposal, "propose", lambda scene: proposals.append(propose(scene)) or proposals[-1])

    def begin(source: str, name: str = "model.xml") -> Begun:
        mjcf = tmp_path / name
        mjcf.write_text(source)
        assert cli.main(["init", str(mjcf), "--json"]) == 0
        document = json.loads(capsys.readouterr().out)
        (written,) = map(Path, document["written"])
        assert written.parent == tmp_path and written.stem == document["task"].partition(":")[0]
        task = getattr(loaded(written), document["task"].partition(":")[2])()
        return task, document, written, proposals[-1]

    return begin


@pytest.mark.parametrize("name", MODELS)
def test_every_model_gets_a_task(name: str, begin: Callable[..., Begun]) -> None:
    """Its parts fit together, its cost is finite, and noise changes it; the file is formatted and has no long lines."""
    task, document, written, found = begin(MODELS[name], f"{name}.xml")
    check_shapes(task)
    check_soundness(task)
    host = task.scene.host
    assert task.policy.at_start == (host.nu == 0) and task.theta.dtype == np.float64
    assert (document["horizon"], document["sigma"]) == (task.horizon, task.sigma)
    assert task.defaults.recipe is not None and task.defaults.recipe.learning_rate > 0
    if task.contact_pair is None:
        assert task.defaults.families == ("mjcf",) and name in ("pendulum", "limited", "wheel", "unnamed", "integrator")
    else:
        low, high = task.defaults.stiffnesses[0], task.defaults.stiffnesses[-1]
        assert len(set(task.defaults.stiffnesses)) == 4 and high >= 5 * low
        assert 0.3 < task.scene.timestep * math.sqrt(high / effective_mass(task.scene, *task.contact_pair)) < 0.8
    moves = (way * np.full((1, found.drive.size), found.drive.scale) for way in (-1, 1))
    misses = [found.aim.misses(proposal.run_trial(found.drive, move, found.horizon), found.horizon) for move in moves]
    assert np.std(misses) > 0 and all(math.isfinite(each) for each in misses)
    for command in ("format --check", "check --select E,F,I,W"):
        ruff = [sys.executable, "-m", "ruff", "--isolated", "--quiet", *command.split(), "--line-length", "120", "-"]
        done = subprocess.run(ruff, input=written.read_text(), text=True, capture_output=True)
        assert done.returncode == 0, done.stdout + done.stderr + written.read_text()


def test_the_cost_is_that_of_the_test_rollouts(begin: Callable[..., Begun]) -> None:
    """The file's cost of a rollout in C is the proposal's."""
    task, _, written, found = begin(ARM, "arm.xml")
    change = np.full((1, 2), 0.3)
    trial = proposal.run_trial(found.drive, change, task.horizon)
    state = initial_state(task.scene)
    last = dataclasses.replace(state, qpos=jnp.asarray(trial.qpos[-1]))
    assert "(shoulder, elbow)" in written.read_text()
    effort = float(task.costs()[0](state, jnp.asarray(found.drive.neutral + change[0]))) * task.horizon
    assert float(task.costs()[1](last)) == pytest.approx(found.aim.misses(trial, task.horizon), rel=1e-9)
    assert effort == pytest.approx(proposal.WEIGHT * (0.3 / (10 * task.sigma)) ** 2)


def test_a_keyframe_s_activations_are_kept(begin: Callable[..., Begun]) -> None:
    """In the file, in its test rollouts and in the task of the MJCF alone."""
    source = PENDULUM.replace("motor", 'general dyntype="filter" dynprm="0.1"')
    task, *_ = begin(source.replace("</mujoco>", '<keyframe><key act="0.5" ctrl="0.5"/></keyframe></mujoco>'))
    for start in (task.start, start_of(task.scene.host), scene_task(task.scene).start):
        assert start.act.tolist() == [0.5]


def test_what_a_task_is_about() -> None:
    """A load that noise moves, a trunk that walks, else a tip; the goal lies where held controls reach."""
    arm, leg, pendulum, wheel = map(proposed, (ARM, LEG, PENDULUM, WHEEL))
    assert arm.aim.role == "load" and arm.aim.body == arm.scene.body("ball") and arm.aim.axis == 0
    assert set(arm.pair or ()) == {"hand", "ball"}
    assert leg.aim.role == "trunk" and leg.aim.body == leg.scene.body("torso")
    assert leg.pair == ("floor", "foot") and leg.touches and leg.drive.neutral.tolist() == [0.1, 0]
    assert leg.drive.scale == 0.1 and 0 < leg.aim.goal[0] - leg.aim.end[0] < 1
    assert pendulum.aim.role == "tip" and wheel.aim.body is None and wheel.aim.role == "coordinate"
    assert proposed(LIMITED).limits == ("swing",)


def test_a_straight_arms_goal_is_where_noise_moves_it() -> None:
    """Along the arm, the tip moves in second order only: the gradient of a goal there is zero."""
    joints = [f'<joint name="{name}" axis="{axis}" damping=".5"/>' for name, axis in zip("ype", AXES, strict=True)]
    link = '<geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" contype="0" conaffinity="0"/>'
    world = f'<body>{joints[0]}{joints[1]}{link}<body pos=".3 0 0">{joints[2]}{link}</body></body>'
    servos = "".join(f'<position joint="{name}" kp="40" kv="2" ctrlrange="-1 2"/>' for name in "ype")
    text = f"<mujoco><worldbody>{world}</worldbody><actuator>{servos}</actuator></mujoco>"
    aim = proposed(text).aim
    assert aim.axis != 0 and aim.goal[0] == pytest.approx(aim.end[0], rel=1e-2)


def test_contacts_are_those_of_a_fall() -> None:
    """A ball falls 0.1 m: after sqrt(2 s / g) = 0.143 s, at sqrt(2 g s) = 1.40 m/s; its noise is 0.1 m/s."""
    found = proposed(BALL)
    (touch,) = found.touches.values()
    assert touch.first * 0.004 == pytest.approx(math.sqrt(0.2 / 9.81), abs=0.02)
    assert touch.speed == pytest.approx(math.sqrt(2 * 9.81 * 0.1), rel=0.1)
    assert found.load is not None and found.load.weight == pytest.approx(0.5 * 9.81)
    assert found.load.depth(found.load.stiffness(0.01)) == pytest.approx(0.01)
    assert found.horizon * 0.004 >= max(2 * 0.143 - 0.01, 0.5)


def test_a_resting_contact_without_gravity_gets_a_task() -> None:
    """Neither weight nor speed presses it."""
    ball = '<body pos="{} 0 0"><joint name="{}" type="slide" axis="1 0 0"/><geom name="{}" size=".1" mass="1"/></body>'
    balls = ball.format(0, "x", "one") + ball.format(0.199, "y", "two")
    found = proposed(f"""<mujoco><option gravity="0 0 0"/><worldbody>{balls}</worldbody>
      <actuator><motor joint="y"/></actuator></mujoco>""")
    assert found.pair == ("one", "two") and found.load is not None and found.load.stiffness(0.01) == 0
    assert found.stiffnesses[-1] == pytest.approx(10 * found.stiffnesses[0], rel=0.1)


def test_depths_are_those_within_the_horizon() -> None:
    """A heavy ball lands on the one that is on the floor after it."""
    ball = '<body pos="0 0 {}"><joint type="slide" axis="0 0 1"/><geom name="{}" size=".1" mass="{}"/></body>'
    world = FLOOR.replace("0.004", "0.002") + ball.format(0.1, "low", 1) + ball.format(3.2, "high", 50)
    found = proposed(f"<mujoco>{world}</worldbody></mujoco>")
    later = proposal.run_trial(found.drive, np.zeros((1, 2)), 500)
    assert found.horizon * 0.002 < math.sqrt(2 * 2.9 / 9.81)
    ((pair, touch),) = found.touches.items()
    assert later.touches[pair].depth > 5 * touch.depth


def test_activations_are_the_keyframes(begin: Callable[..., Begun]) -> None:
    """An integrator's, in test rollouts and in the file."""
    task, _, _, found = begin(INTEGRATOR)
    assert task.draw_start(jax.random.key(0)).act.tolist() == [0.5]
    assert start_of(found.scene.host).act.tolist() == [0.5]


def test_a_wheel_on_its_axle_is_to_turn() -> None:
    """Its centre of mass cannot reach a goal; the joint's angle can."""
    found = proposed("""<mujoco><worldbody>
      <body name="disk"><joint axis="0 1 0"/><geom type="cylinder" size=".06 .02" euler="90 0 0"/></body>
      <body pos="0 0 .2"><joint name="arm" axis="0 1 0" range="-60 60"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.12" size=".01" contype="0" conaffinity="0"/>
        <geom name="tip" size=".02" pos="0 0 -.125"/></body></worldbody>
      <actuator><motor joint="arm" ctrlrange="-1 1" gear=".3"/></actuator></mujoco>""")
    assert (found.aim.body, found.aim.axis) == (None, 0) and found.aim.distance > 0.01


def test_a_load_that_hardly_moves_is_no_task() -> None:
    """The arm falls on top of a block, which it presses and tilts by a fraction of a milliradian."""
    block = """<body name="block" pos="0.55 0 0.1"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <joint axis="0 1 0"/><geom name="block" type="box" size="0.1 0.1 0.1" mass="0.5" contype="3" conaffinity="3"/>"""
    arm, _, rest = ARM.partition('<body name="ball"')
    aim = proposed(arm + block + "</body></worldbody>" + rest.partition("</worldbody>")[2]).aim
    assert aim.role == "tip" and aim.distance > 0.01


def test_a_learning_rate_lowers_the_cost() -> None:
    found = proposed(LEG)
    aim, drive, steps = found.aim, found.drive, found.horizon
    cost = lambda held: aim.misses(proposal.run_trial(drive, np.array([held]), steps), steps)  # noqa: E731
    adam, held = optax.adam(found.learning_rate), np.zeros(2)
    state = adam.init(held)
    for _ in range(20):
        slope = np.array([cost(held + move) - cost(held - move) for move in 0.1 * drive.scale * np.eye(2)])
        update, state = adam.update(slope, state)
        held = held + np.asarray(update)
    assert cost(held) < 0.7 * cost(np.zeros(2))


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>', "has no degree of freedom"),
        (PENDULUM.replace('damping=".01"', 'armature="1e12"'), "noise on its controls of .* moves not"),
        (PENDULUM.replace('damping=".01"', 'stiffness="1e300" springref="90"'), "state is not finite after step"),
        (SHAKY, "by a smaller timestep, armature, or the integrator implicitfast"),
        ("<mujoco>", "is not a valid MJCF"),
    ],
)
def test_a_model_without_a_task_gets_a_reason(
    source: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "model.xml"
    path.write_text(source)
    assert cli.main(["init", str(path)]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["model.xml"]
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    with pytest.raises(ValueError, match=message):
        propose(load_scene(path))


def test_a_file_is_only_replaced_by_force(begin: Callable[..., Begun], capsys: pytest.CaptureFixture[str]) -> None:
    _, _, written, _ = begin(PENDULUM)
    written.write_text("mine")
    mjcf = str(written.with_name("model.xml"))
    assert cli.main(["init", mjcf]) == 2 and written.read_text() == "mine"
    assert capsys.readouterr().err == f"mjx-study: {written} exists: give --force to replace it\n"
    assert cli.main(["init", mjcf, "--force"]) == 0 and "def model(" in written.read_text()
    assert f"cd {written.parent} && mjx-study compare model_task:model" in capsys.readouterr().out
    assert cli.main(["init", "pusher"]) == 2
    assert capsys.readouterr().err == "mjx-study: init needs the path of an MJCF, FILE.xml, got pusher\n"


@pytest.mark.parametrize(
    ("file", "name"),
    {"my-robot.v2": "my_robot_v2", "2legs": "model_2legs", "class": "model_class", "jnp": "model_jnp"}.items(),
)
def test_names_of_files_become_names_in_python(file: str, name: str) -> None:
    path = Path(f"{file}.XML")
    assert function_name(path) == name
    source = source_of_task(path, proposed(PENDULUM.replace('"pole"', '"a &quot;pole&quot;"')))
    compile(source, file, "exec")
    assert f"def {name}(" in source and r'scene.body("a \"pole\"")' in source


COMMANDS: Final = (
    "compare {} --samples 4 --reference-samples 4",
    "optimise {} --iterations 2 --samples 4 --seeds 1",
    "sweep {} --samples 4 --seeds 1 --reference-samples 4 --output sweep",
    "landscape {} --points 3 --samples 4",
    "rollout {} --output film",
    "gradcheck {} --states 1",
    "bench {} --samples 5",
    "diagnose {} --samples 23",
)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm", "leg", "ball", "pendulum", "limited"])
def test_every_command_runs_the_file_as_it_is(name: str, tmp_path: Path) -> None:
    (tmp_path / f"{name}.xml").write_text(MODELS[name])
    assert cli.main(["init", str(tmp_path / f"{name}.xml")]) == 0
    swept = name in ("arm", "leg", "ball")
    environment = os.environ | {"XDG_CACHE_HOME": str(ROOT / ".pytest_cache" / "own_task"), "PYTHONPATH": str(ROOT)}
    for command in COMMANDS:
        words = command.format(f"{name}_task:{name}").split()
        one = ["--contact", "mujoco"] if swept and words[0] in ("compare", "optimise", "sweep") else []
        full = [sys.executable, "-m", "mjx_study", *words, *one, "--horizon", "40"]
        done = subprocess.run(full, capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=900)
        assert done.returncode in ((0, 3) if words[0] == "gradcheck" else (0,)), f"{command}: {done.stderr}"
        lines = (line.split() for line in done.stdout.splitlines() if re.search(r"\d", line))  # nan is a heading, too
        assert not any("nan" in words for words in lines), f"{command}: {done.stdout}"
