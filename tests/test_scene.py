"""Finding, compiling and refusing MJCF files."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_study.choices import CONES, INTEGRATORS, SOLVERS
from mjx_study.graph.native import native_identity
from mjx_study.simulation.dynamics import State
from mjx_study.simulation.limitations import FLAGS
from mjx_study.simulation.scene import (
    ADJOINTS,
    SceneError,
    load_model,
    load_scene,
    model_names,
    models_folder,
    num_constraint_rows,
    put_scene,
)
from mjx_study.tasks import make_task
from tests.processes import run_script
from tests.scenes import FREE_BOX, floor_scene, slider

FREE = '<body pos="0 0 1"><freejoint/><geom size=".1" condim="{}"/></body>'


@pytest.fixture(scope="module")
def pusher():
    return load_scene("pusher")


def test_shipped_models_load_by_name() -> None:
    assert "pusher" in model_names()
    for name in model_names():
        assert load_scene(name).name == name


def test_a_name_needs_no_particular_working_directory(tmp_path: Path) -> None:
    (tmp_path / "pusher").mkdir()  # such as the folder of its study
    code = "from mjx_study.simulation.scene import load_scene; print(load_scene('pusher').host.nq)"
    assert run_script(code, cwd=tmp_path).stdout == "2\n"


ENUMERATED = {
    "pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL,
    "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC,
    "newton": mujoco.mjtSolver.mjSOL_NEWTON,
    "cg": mujoco.mjtSolver.mjSOL_CG,
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
}


@pytest.mark.parametrize(("option", "values"), [("cone", CONES), ("solver", SOLVERS), ("integrator", INTEGRATORS)])
def test_enumerated_options_reach_mjx(option: str, values: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "bare.xml"
    path.write_text("<mujoco><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>")
    for value in values:
        scene = load_scene(path, **{option: value})
        assert int(getattr(scene.model.opt, option)) == int(getattr(scene.host.opt, option))
        assert int(getattr(scene.model.opt, option)) == int(ENUMERATED[value])


def test_numeric_options_reach_mjx() -> None:
    scene = load_scene("pusher", timestep=np.float32(0.0025), iterations=np.int64(7), ls_iterations=9, tolerance=1e-6)
    option = scene.model.opt
    assert (option.iterations, option.ls_iterations) == (7, 9)
    assert float(option.timestep) == scene.timestep == np.float32(0.0025)
    assert float(option.tolerance) == 1e-6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"solver": "pgs"}, "unknown solver 'pgs'; choose from newton, cg"),
        ({"integrator": "implicit"}, r"unknown integrator 'implicit'; did you mean implicitfast\?"),
        ({"cone": "round"}, "unknown cone 'round'; choose from pyramidal, elliptic"),
        ({"gravity": 1.0}, "unknown option 'gravity'; choose from cone, solver, integrator, timestep"),
        ({"disable_flags": "energie"}, r"unknown flag 'energie'; did you mean energy\?"),
        ({"disable_flags": 1}, "disable_flags must be names of flags, got 1"),
        ({"timestep": 0.0}, "timestep must be a positive number, got 0.0"),
        ({"timestep": float("nan")}, "timestep must be a positive number, got nan"),
        ({"timestep": "fast"}, "timestep must be a positive number, got 'fast'"),
        ({"iterations": 0.5}, "iterations must be a positive whole number, got 0.5"),
        ({"ls_iterations": 2.5}, "ls_iterations must be a positive whole number, got 2.5"),
        ({"adjoint": "unrolled"}, "unknown adjoint 'unrolled'; choose from auto, graph, tape"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        load_scene("pusher", **options)


def test_the_adjoint_is_chosen_by_size_or_by_name() -> None:
    body = '<body><joint type="slide"/><geom size=".1" contype="0"/></body>'
    hosts = [mujoco.MjModel.from_xml_string(floor_scene(joints * body)) for joints in (8, 9)]
    chosen = [[put_scene(host, "here", adjoint=name).uses_graph for name in ADJOINTS] for host in hosts]
    assert chosen == [[True, True, False], [native_identity() is not None, True, False]]
    assert not make_task("tennis", adjoint="tape").scene.uses_graph


@pytest.mark.parametrize(
    ("option", "remedy", "message"),
    [
        ('<option solver="PGS"/>', {"solver": "newton"},
         r"MJX lacks the solver that here asks for; set one of newton, cg in its <option>, or give --solver$"),
        ('<option integrator="implicit"/>', {"integrator": "euler"},
         r"the integrator that here asks for; set one of euler, implicitfast, rk4 in .* --integrator$"),
        ('<option integrator="RK4"/>', {"integrator": "implicitfast"},
         r"here combines RK4 with contacts.*; set integrator to euler or implicitfast in .* --integrator euler$"),
        ('<option><flag fwdinv="enable" sleep="enable"/></option>', {"disable_flags": "fwdinv,sleep"},
         r"MJX lacks fwdinv, sleep, which here enables; disable them in .* --disable-flag fwdinv,sleep$"),
    ],
)  # fmt: skip
def test_options_that_mjx_lacks_are_refused_and_what_is_told_helps(
    option: str, remedy: dict[str, Any], message: str
) -> None:
    host = mujoco.MjModel.from_xml_string(floor_scene(FREE_BOX, option))
    before = int(host.opt.integrator), int(host.opt.solver), host.opt.enableflags
    with pytest.raises(SceneError, match=message):
        put_scene(host, "here")
    put_scene(host, "here", **remedy)
    assert (int(host.opt.integrator), int(host.opt.solver), host.opt.enableflags) == before


def test_energy_that_mjx_would_not_compute_is_left_out() -> None:
    host = mujoco.MjModel.from_xml_string(floor_scene(FREE_BOX, '<option><flag energy="enable"/></option>'))
    assert put_scene(host, "here").host.opt.enableflags == 0 < host.opt.enableflags


@pytest.mark.parametrize("flag", FLAGS)
def test_a_disabled_flag_is_that_of_the_mjcf(flag: str, tmp_path: Path) -> None:
    path, wanted = tmp_path / "flag.xml", tmp_path / "wanted.xml"
    text = "<mujoco><option><flag {}/></option><worldbody><body><joint/><geom size='.1'/></body></worldbody></mujoco>"
    path.write_text(text.format('energy="enable" override="enable"'))
    wanted.write_text(
        text.format(" ".join(f'{n}="enable"' for n in ("energy", "override") if n != flag) + f' {flag}="disable"')
    )
    model, expected = load_model(path, disable_flags=(flag,)), load_model(wanted)
    assert model.opt.disableflags == expected.opt.disableflags
    assert model.opt.enableflags == expected.opt.enableflags


JOINT = """<mujoco><option {option}><flag {flag}/></option>{extension}<worldbody><body {body}><joint name="j" {joint}/>
<geom fromto="0 0 0 0 0 -.5" type="capsule" size=".05" {geom}/></body></worldbody>{tendon}
<actuator>{actuator}</actuator></mujoco>"""
PID = '<extension><plugin plugin="mujoco.pid"><instance name="pid"/></plugin></extension>'
TENDON = '<tendon><fixed {}><joint joint="j" coef="1"/></fixed></tendon>'
MUSCLE = '<muscle joint="j" lengthrange="-2 2" force="5"/>'


def joint(**parts: str) -> mujoco.MjModel:
    """One joint, with what is given added."""
    names = ("option", "flag", "extension", "body", "joint", "geom", "tendon", "actuator")
    return mujoco.MjModel.from_xml_string(JOINT.format(**(dict.fromkeys(names, "") | parts)))


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"option": 'noslip_iterations="3"'}, r"noslip_iterations \(set it to 0\)"),
        ({"extension": PID, "actuator": '<plugin joint="j" instance="pid"/>'}, "plugins of actuators"),
        ({"actuator": '<motor joint="j" delay=".02" nsample="2"/>'}, "actuators' delay"),
        ({"actuator": '<general joint="j" dyntype="filter" dynprm="1" actearly="true"/>'}, "actuators' actearly"),
        ({"actuator": '<motor joint="j" damping="1"/>'}, "actuators' damping and armature"),
        ({"actuator": '<motor joint="j" armature="1"/>'}, "actuators' damping and armature"),
        ({"option": 'actuatorgroupdisable="2"', "actuator": '<motor joint="j" group="2"/>'}, "actuatorgroupdisable"),
        ({"option": 'integrator="implicitfast"', "actuator": MUSCLE}, r"muscles' damping .*--integrator euler"),
        ({"joint": 'stiffness="1 2"'}, "polynomial stiffness or damping"),
        ({"tendon": TENDON.format('damping="0 2"')}, "polynomial stiffness or damping"),
        ({"geom": 'adhesion="3"'}, "adhesion of geoms"),
        ({"geom": 'surfacevel="1 0 0 0 0 0"'}, "surfacevel"),
        ({"option": 'viscosity=".1"', "geom": 'fluidshape="ellipsoid"'}, 'fluidshape="ellipsoid"'),
        ({"flag": 'spring="disable"', "joint": 'damping="1"'}, "all passive forces"),
        ({"flag": 'damper="disable"', "joint": 'stiffness="1"'}, "all passive forces"),
        ({"flag": 'damper="disable"', "body": 'gravcomp="1"'}, "all passive forces"),
        ({"flag": 'spring="disable"', "option": 'density="1"'}, "all passive forces"),
        ({"flag": 'spring="disable" damper="disable"', "joint": 'damping="1"'}, "disable eulerdamp, too"),
    ],
)
def test_what_mjx_would_leave_out_is_refused(parts: dict[str, str], message: str) -> None:
    with pytest.raises(SceneError, match=f"MJX would leave out part of here: .*{message}"):
        put_scene(joint(**parts), "here")


@pytest.mark.parametrize(
    "parts",
    [
        {"option": 'actuatorgroupdisable="2"', "actuator": '<motor joint="j" group="3"/>'},
        {"geom": 'fluidshape="ellipsoid"'},
        {"actuator": MUSCLE},
        {"flag": 'spring="disable"', "joint": 'stiffness="1"'},
        {"flag": 'damper="disable"', "option": 'integrator="implicitfast"', "joint": 'damping="1"'},
        {"flag": 'spring="disable" damper="disable" eulerdamp="disable"', "joint": 'stiffness="1" damping="1"'},
        {"flag": 'gravity="disable" spring="disable"', "body": 'gravcomp="1"'},
    ],
)
def test_what_has_no_effect_is_not_refused(parts: dict[str, str]) -> None:
    put_scene(joint(**parts), "here")


CLOTH = (
    '<body name="b" pos="0 0 1"><flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" dim="2"/></body>'
)


def test_models_that_mjx_lacks_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo logs a warning about the cloth to a file where it stands
    elliptic = floor_scene(FREE.format(1) + FREE.format(3), '<option cone="elliptic"/>', 'condim="1"')
    for text, message in (
        (floor_scene(CLOTH), "MJX cannot run here: Flex not implemented"),
        (elliptic, "MJX cannot run here: condim=1 with ConeType.ELLIPTIC not implemented"),
    ):
        with pytest.raises(SceneError, match=message):
            put_scene(mujoco.MjModel.from_xml_string(text), "here")


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


def shipped(name: str) -> str:
    return (models_folder() / f"{name}.xml").read_text()


def test_a_model_in_a_task_s_place_may_number_its_bodies_otherwise(tmp_path: Path) -> None:
    """The cost is that of the ball's mass and the bar's inertia about its pivot, wherever they stand in the file."""
    path, stand = tmp_path / "mine.xml", '<body name="stand"><geom size="0.01" pos="0 -1 0"/></body>'
    source = shipped("momentum_transfer").replace("<worldbody>", f"<worldbody>{stand}")
    moved = 'pos="0 0.35 0" mass="10" diaginertia="3.675 3.675 3.675"'  # and 10 kg (0.35 m)^2 about the pivot
    path.write_text(source.replace('pos="0 0 0" mass="10" diaginertia="4.9 4.9 4.9"', moved))
    task, own = make_task("momentum_transfer"), make_task("momentum_transfer", model=path)
    assert isinstance(task.start, State)
    turning = dataclasses.replace(task.start, qvel=jnp.array([0.0, 0.0, 0.3]))
    assert own.costs()[1](turning) == pytest.approx(float(task.costs()[1](turning)), rel=1e-12) != 0


@pytest.mark.parametrize(
    ("task", "new", "says"),
    [
        ("momentum_transfer", {'"x" type': '"y" type', '"y" type': '"x" type'},
         "the joints of mine must come in the order x, y, pivot; they come as y, x, pivot"),
        ("tennis", {'name="paddle_x" joint="paddle_x"': 'name="first" joint="paddle_angle"'},
         "must drive paddle_x, paddle_y, paddle_angle in this order; they drive paddle_angle, paddle_y"),
        ("sliding_box", {'joint="block"': 'joint="box"'}, "must drive block in this order; they drive box"),
    ],
)  # fmt: skip
def test_a_model_in_a_task_s_place_has_its_order(tmp_path: Path, task: str, new: dict[str, str], says: str) -> None:
    path = tmp_path / "mine.xml"
    path.write_text(re.sub("|".join(map(re.escape, new)), lambda found: new[found[0]], shipped(task)))
    with pytest.raises(SceneError, match=says):
        make_task(task, model=path)
