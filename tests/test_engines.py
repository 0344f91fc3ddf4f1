"""Gradients of other engines: the cells that need no other environment, the verdicts, and the page."""

import itertools
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments import ROOT
from experiments.engines import __main__ as command
from experiments.engines import catalog, certify, references
from experiments.engines.adapters import mujoco_family
from experiments.engines.judge import combined, measure, verdict
from experiments.engines.page import CELLS, CHECKS, PAGE, cells, tables
from experiments.engines.scenes import RADIUS, SCENES, TIMESTEPS, mjcf
from experiments.pages import replace_tables
from tests.processes import run_script

SMALL = {"grid": 100, "strata": 100, "points": 20}


@pytest.mark.parametrize("variant", ["forward", "plain"])
def test_exact_derivatives_of_a_toss_have_another_mean_than_the_slope(variant: str) -> None:
    scene = SCENES["toss"]
    cell = measure(mujoco_family.build(scene, 0.01, variant), scene, SMALL, single=False)
    assert abs(cell["mean"] - cell["slope"]) > 0.5 * abs(cell["slope"])
    assert cell["point_error"] < 1e-6 and cell["point_share"] == 1
    assert np.isclose(cell["slope"], cell["slope_by_differences"], rtol=0.1)


RIGHT: dict[str, Any] = {
    "scene": "toss",
    **dict.fromkeys(("slope", "slope_by_differences", "mean", "mean_of_strata", "point_share"), 1.0),
    **dict.fromkeys(("slope_error", "mean_error", "point_error"), 0.0),
}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "right"), ({"mean": math.nan}, "unknown"), ({"mean": math.nan, "nan_share": 1.0}, "none"),
        ({"mean": 2.0, "mean_of_strata": 2.0}, "biased"),
        ({"mean": 1.05, "mean_of_strata": 1.05}, "close"),
        ({"mean": 1.05, "mean_of_strata": 1.05, "mean_error": 0.03}, "unknown"),
        ({"point_share": 0.0}, "average"),
        ({"point_share": 0.0, "mean": 2.0, "mean_of_strata": 2.0}, "wrong"),
        ({"slope_by_differences": 1.04}, "unknown"),
        ({"mean": 2.0, "mean_of_strata": 2.6}, "unknown"),
        ({"state": [[0.3, 0, 0.04]]}, "no contact"),
        ({"scene": "pendulum", "state": [[0.3, 0, 2.3]]}, "no joint"),
        ({"scene": "pendulum", "state": [[0.3, 0, 1.6]]}, "right"),
        (dict.fromkeys(("slope", "slope_by_differences", "mean", "mean_of_strata"), 1e-8), "at rest"),
    ],
)  # fmt: skip
def test_verdicts(changes: dict[str, Any], said: str) -> None:
    assert verdict(RIGHT | changes) == said
    assert combined([RIGHT | changes] * 2) == said
    assert combined([RIGHT | changes, None]) == f"{said}, -"


def test_a_scene_that_an_engine_lacks_is_a_dash_with_a_reason() -> None:
    lacking = {"error": "knows no walls"}
    assert combined([lacking, None]) == "-"
    said = tables({("jaxsim", "wall", 0.005): lacking}, {})
    label = catalog.ENGINES["jaxsim"].label
    assert f"| {label} | wall at 5 ms | knows no walls |" in said["reasons"]
    (others,) = (line for line in said["reasons"].splitlines() if line.startswith(f"| {label} | toss,"))
    assert "wall at 2 ms" in others and others.endswith("| not run |")
    assert "JaxSim" not in said["wall"]


def test_the_page_says_what_the_data_give() -> None:
    text, found = PAGE.read_text(), cells(CELLS)
    assert replace_tables(text, tables(found, cells(CHECKS))) == text
    every = list(itertools.product(catalog.ENGINES, SCENES, TIMESTEPS))
    lacking = sum("slope" not in found.get(key, {}) for key in every)
    assert f"Of {len(every)} cells, {lacking} have [no numbers]" in text


def test_accusing_cells_are_accused_under_other_noise() -> None:
    checks, found = cells(CHECKS), cells(CELLS)
    assert set(checks) == set(command.CHECKED)
    accused = [(cell, found[name, "toss", step]) for (name, _, step), cell in checks.items()]
    assert {verdict(each) for pair in accused for each in pair} == {"biased"}


@pytest.mark.parametrize(
    ("engine", "step", "slope", "mean", "at_point"),
    [
        ("brax_spring", 0.005, 0.128, 0.370, 0.35448),
        ("brax_spring", 0.002, 0.130, 0.341, 0.32910),
        ("brax_positional", 0.005, 0.12, 0.34, -0.22303),
    ],
)
def test_brax_from_higher_is_what_others_measured(
    engine: str, step: float, slope: float, mean: float, at_point: float
) -> None:
    cell = cells(CHECKS)[engine, command.HIGH, step]
    assert [cell["slope"], cell["mean"]] == pytest.approx([slope, mean], rel=0.02)
    assert cell["derivative"] == pytest.approx(at_point, abs=6e-6)


@pytest.mark.parametrize("step", TIMESTEPS)
@pytest.mark.parametrize("scene", ["slide", "box_flat", "box_edge"])
def test_derivatives_of_boxes_explode_in_the_line_search_and_are_right_with_exact_forces(
    scene: str, step: float
) -> None:
    """Motion and slope are the same; exact means are off as MJX's are."""
    found = cells(CELLS)
    plain, short, exact = (found[f"brax_generalized{kind}", scene, step] for kind in ("", "_short", "_exact"))
    assert plain["point_share"] < 0.1 and abs(plain["mean"]) > 1e4
    assert exact["point_share"] > 0.95 and exact["mean"] == pytest.approx(found["mjx", scene, step]["mean"], abs=0.1)
    assert short["mean"] == pytest.approx(exact["mean"], abs=0.1)
    assert [plain["slope"], short["slope"]] == pytest.approx([exact["slope"]] * 2, rel=0.05)


@pytest.mark.parametrize("name", ["slide", "box_flat"])
def test_the_rigid_limit_is_that_of_the_c_engine(name: str) -> None:
    scene, thetas = SCENES[name], SCENES[name].center + SCENES[name].sigma * np.array([-1.0, 0.3, 1.0])
    assert scene.exact is not None
    model = certify.mujoco.MjModel.from_xml_string(mjcf(scene, 1e-4))
    model.geom_solref[:, 0] = 1e-3
    assert np.allclose(certify.native(scene, 1e-4, thetas, model)[0], scene.exact(thetas), atol=0.002)


@pytest.mark.parametrize("name", ["bounce", "wall"])
def test_the_rigid_limit_is_a_flight_that_reverses(name: str) -> None:
    scene, step = SCENES[name], 1e-5
    assert scene.exact is not None
    for theta in scene.center + scene.sigma * np.array([-1.0, 0.3, 1.0]):
        (body,) = scene.start(theta)
        edge, way, axis = (RADIUS, 1, 2) if scene.wall is None else (scene.wall - RADIUS, -1, 0)
        distance, speed = way * (body.position[axis] - edge), way * body.velocity[axis]
        for _ in range(scene.steps(step)):
            speed -= scene.gravity * step
            distance += speed * step
            speed = -scene.restitution * speed if distance < 0 > speed else speed
        assert abs(edge + way * distance - scene.exact(theta)) < 1e-4


ENGINE = """#!/bin/sh
echo $4 >> {0}
case $4 in toss) exec sleep 60;; wall) echo '{{"engine": "mjx", "scene": "wall", "timestep": 0.005, "error": ""}}';;
*) exit 1; esac
"""


def test_a_cell_beyond_the_limit_has_this_as_its_reason_and_waits_for_a_higher_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    python, asked, data = (tmp_path / name for name in ("python", "asked", "data"))
    python.write_text(ENGINE.format(asked))
    python.chmod(0o755)
    monkeypatch.setattr(command, "interpreter", lambda engine: python)
    words = ["--only", "mjx", "--timestep", "0.005", "--into", str(data), "--scene", "toss", "wall", "push"]
    for limit, again in (("0.5", "toss wall push"), ("0.5", "push"), ("0.6", "toss push")):
        asked.write_text("")
        monkeypatch.setattr(sys, "argv", ["engines", *words, "--limit", limit])
        monkeypatch.setattr(command, "CELLS", tmp_path / "none")
        with pytest.raises(SystemExit) as ended:
            command.main()
        assert ended.value.code == 1 and asked.read_text().split() == again.split()
    found = cells(data)
    assert set(found) == {("mjx", scene, 0.005) for scene in ("toss", "wall")}
    assert "| toss at 5 ms | no result within 0.01 minutes |" in tables(found, {})["reasons"]


FREE_FLIGHT = """
import dataclasses, json, os, sys
os.environ["JAX_ENABLE_X64"] = "1"
from importlib import import_module
import numpy as np
from experiments.engines.scenes import RADIUS, SCENES, mjcf
scene = dataclasses.replace(SCENES["toss"], horizon=0.1)
found = import_module("experiments.engines.adapters." + sys.argv[1]).build(scene, 0.005, sys.argv[2])(np.array([1.0]))
print(json.dumps([found.positions[0, 0].tolist(), float(found.values[0]), float(found.derivatives[0])]))
"""


@pytest.mark.parametrize(
    "name",
    ["mjx", "newton_semi_implicit", "jaxsim", "drake_sap", "nimble", "mujoco_torch_plain", "brax_generalized_exact"],
)
def test_free_flight_of_what_is_installed(name: str) -> None:
    engine = catalog.ENGINES[name]
    python = catalog.interpreter(engine)
    if not python.exists():
        pytest.skip(f"{name}: not installed")
    words = [python, "-c", FREE_FLIGHT, engine.adapter, engine.variant]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=True)
    position, value, derivative = json.loads(done.stdout.splitlines()[-1])
    z, late = 1 - 0.1 - 9.81 * 0.1**2 / 2, 9.81 * 0.005 * 0.1
    assert np.allclose(position[:2], [0.1, 0], atol=1e-5) and abs(position[2] - z) < late
    assert np.isclose(value, SCENES["toss"].cost(np.array([position])), rtol=1e-5)
    assert np.isclose(derivative, SCENES["toss"].cost_gradient(np.array([position]))[0, 2], rtol=1e-4)


def test_reference_gradients_are_certified_and_the_reader_recomputes_a_few() -> None:
    index, entries = references.read(certify.STEM)
    assert len(entries) >= 100 and not any(certify.faults(entry) for entry in entries)
    for scene in index["scenes"]:
        assert index["scenes"][scene] == certify.describe(scene)
    for entry in entries[:: len(entries) // 6]:
        scene, thetas = SCENES[entry["scene"]], np.array([entry["theta"]])
        values, positions = certify.native(scene, entry["timestep"], thetas)
        slopes = certify.central(scene, entry["timestep"], thetas)
        found = {"value": values[0], "position": positions[0], "derivative": slopes[0]}
        assert max(references.deviations(entry, found).values()) < 10, entry
        assert references.deviations(entry, {"derivative": 1.01 * slopes[0]})["derivative"] > 10


@pytest.mark.parametrize("name", references.NUMBERS)
def test_a_number_that_ways_disagree_on_is_not_certified(name: str) -> None:
    entry = references.read(certify.STEM)[1][0]
    worse = entry["uncertainty"] | {name: abs(entry[name]) + abs(entry["value"])}
    assert certify.faults(entry | {"uncertainty": worse}) == [name]


def test_references_need_no_more_than_numpy() -> None:
    script = "import sys; import references; print(sorted({'jax', 'mujoco', 'experiments'} & set(sys.modules)))"
    assert run_script(script, cwd=Path(references.__file__).parent).stdout.strip() == "[]"
