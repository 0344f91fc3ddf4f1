"""Finding, compiling and refusing MJCF files."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest

from mjx_study.scene import (
    CONES,
    INTEGRATORS,
    SOLVERS,
    SceneError,
    load_scene,
    model_names,
    models_folder,
    num_constraint_rows,
    put_scene,
)
from tests.scenes import FREE_BOX, floor_scene, slider

FREE = '<body pos="0 0 1"><freejoint/><geom type="{}" size=".1 .1 .1" condim="{}"/></body>'


@pytest.fixture(scope="module")
def pusher():
    return load_scene("pusher")


def test_shipped_models_load_by_name() -> None:
    assert "pusher" in model_names()
    for name in model_names():
        assert load_scene(name).name == name


def test_a_name_needs_no_particular_working_directory(tmp_path: Path) -> None:
    code = "from mjx_study.scene import load_scene; print(load_scene('pusher').host.nq)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, "2\n"), done.stderr


def test_a_path_is_loaded_and_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "copy.xml"
    path.write_text((models_folder() / "pusher.xml").read_text())
    assert load_scene(path).name == "copy"
    assert load_scene(str(path)).host.nv == 2


@pytest.mark.parametrize(
    ("option", "values"), [("cone", CONES), ("solver", SOLVERS), ("integrator", {**INTEGRATORS, "rk4": None})]
)
def test_enumerated_options_reach_mjx(option: str, values: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "bare.xml"
    path.write_text("<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>")
    for value in values:
        scene = load_scene(path, **{option: value})
        assert int(getattr(scene.model.opt, option)) == int(getattr(scene.host.opt, option))
        choices: dict[str, Any] = {"cone": CONES, "solver": SOLVERS, "integrator": INTEGRATORS}[option]
        assert int(getattr(scene.model.opt, option)) == int(choices[value])


def test_numeric_options_reach_mjx() -> None:
    scene = load_scene("pusher", timestep=0.0025, iterations=7, ls_iterations=9, tolerance=1e-6)
    option = scene.model.opt
    assert (option.iterations, option.ls_iterations) == (7, 9)
    assert float(option.timestep) == scene.timestep == 0.0025
    assert float(option.tolerance) == 1e-6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solver": "pgs"}, "unknown solver 'pgs'; choose from newton, cg"),
        ({"integrator": "implicit"}, "unknown integrator 'implicit'; choose from euler, implicitfast, rk4"),
        ({"cone": "round"}, "unknown cone 'round'; choose from pyramidal, elliptic"),
        ({"gravity": 1.0}, "unknown option 'gravity'; choose from cone, solver, integrator, timestep"),
        ({"timestep": 0.0}, "timestep must be a positive number, got 0.0"),
        ({"timestep": -0.1}, "timestep must be a positive number, got -0.1"),
        ({"timestep": float("nan")}, "timestep must be a positive number, got nan"),
        ({"timestep": float("inf")}, "timestep must be a positive number, got inf"),
        ({"timestep": "fast"}, "timestep must be a positive number, got 'fast'"),
        ({"iterations": 0}, "iterations must be a positive whole number, got 0"),
        ({"iterations": 0.5}, "iterations must be a positive whole number, got 0.5"),
        ({"ls_iterations": 2.5}, "ls_iterations must be a positive whole number, got 2.5"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        load_scene("pusher", **options)


def test_a_missing_file_or_name_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="no MJCF file at .*absent.xml"):
        load_scene(tmp_path / "absent.xml")
    with pytest.raises(SceneError, match="no model named 'absent'; there are .*pusher"):
        load_scene("absent")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody></mujoco>", "broken.xml is not a valid MJCF: XML parse error"),
        ("<mujoco><worldbody><robot/></worldbody></mujoco>", "broken.xml is not a valid MJCF: .*robot"),
        ("<mujoco><worldbody><body><joint/></body></worldbody></mujoco>", "broken.xml is not a valid MJCF: .*mass"),
    ],
)
def test_malformed_files_are_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "broken.xml"
    path.write_text(text)
    with pytest.raises(SceneError, match=message) as refusal:
        load_scene(path)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ('solver="PGS"', "MJX lacks the solver that here asks for; use one of newton, cg"),
        ('integrator="implicit"', "MJX lacks the integrator that here asks for; use one of euler, implicitfast, rk4"),
    ],
)
def test_options_that_mjx_lacks_are_refused(option: str, message: str) -> None:
    host = mujoco.MjModel.from_xml_string(floor_scene(FREE_BOX, f"<option {option}/>"))
    with pytest.raises(SceneError, match=message):
        put_scene(host, "here")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            floor_scene(
                '<body name="b" pos="0 0 1">'
                '<flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2"/></body>'
            ),
            "MJX cannot run here: Flex not implemented",
        ),
        (
            floor_scene(FREE.format("sphere", 1) + FREE.format("sphere", 3), '<option cone="elliptic"/>', 'condim="1"'),
            "MJX cannot run here: condim=1 with ConeType.ELLIPTIC not implemented",
        ),
    ],
)
def test_models_that_mjx_lacks_are_refused(
    text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo logs a warning about the cloth to a file where it stands
    with pytest.raises(SceneError, match=message):
        put_scene(mujoco.MjModel.from_xml_string(text), "here")


def test_rk4_with_constraints_is_refused() -> None:
    with pytest.raises(SceneError, match="pusher combines RK4 with contacts"):
        load_scene("pusher", integrator="rk4")


def test_names_are_looked_up_and_choices_listed(pusher) -> None:
    assert (pusher.geom("slider"), pusher.joint("slider")) == (1, 1)
    with pytest.raises(SceneError, match="pusher has no geom 'ball'; it has pusher, slider"):
        pusher.geom("ball")
    with pytest.raises(SceneError, match="pusher has no joint 'ball'; it has pusher, slider"):
        pusher.joint("ball")
    empty = put_scene(mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>"), "empty")
    with pytest.raises(SceneError, match="empty has no joint 'x'; it has none"):
        empty.joint("x")


def test_constraint_rows_are_counted(pusher) -> None:
    assert num_constraint_rows(pusher.template) == 1
    assert pusher.has_constraints
    pyramid = put_scene(mujoco.MjModel.from_xml_string(floor_scene(slider(condim=4))), "here")
    assert num_constraint_rows(pyramid.template) == 6
    bare = "<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    assert not put_scene(mujoco.MjModel.from_xml_string(bare), "here").has_constraints


def test_the_template_is_the_reference_pose_with_fixed_types(pusher) -> None:
    np.testing.assert_array_equal(pusher.template.qpos, [0.0, 1.0])  # the slider's ref is its place
    leaves = [leaf for leaf in jax.tree.leaves(pusher.template) if isinstance(leaf, jax.Array)]
    assert leaves and not any(leaf.weak_type for leaf in leaves)
