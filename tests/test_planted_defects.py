"""The list of defects is alive: each still has its place, and its tests exist."""

import ast
import shutil
from pathlib import Path

import mujoco
import pytest

from tests.planted.defects import DEFECTS, Defect, plant
from tests.planted.models import MODELS

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect.name)
def test_a_defect_can_be_planted(defect: Defect, tmp_path: Path) -> None:
    """The text occurs once, Python stays Python, and the tests that should see it are there."""
    path = tmp_path / defect.file
    path.parent.mkdir(parents=True)
    shutil.copy(ROOT / defect.file, path)
    plant(defect, tmp_path)
    if path.suffix == ".py":
        ast.parse(path.read_text())
    with pytest.raises(ValueError, match=f"{defect.name}: .* times"):
        plant(defect, tmp_path)
    for test in defect.tests:
        file, _, name = test.partition("::")
        assert not name or f"def {name.partition('[')[0]}(" in (ROOT / file).read_text()
        assert (ROOT / file).is_file()
    assert defect.model is None or defect.model in MODELS


def test_there_are_enough_and_each_once() -> None:
    assert len({defect.name for defect in DEFECTS}) == len(DEFECTS) >= 25
    assert len({(defect.file, defect.old, defect.new) for defect in DEFECTS}) == len(DEFECTS)


@pytest.mark.parametrize("model", MODELS)
def test_models_compile(model: str) -> None:
    assert mujoco.MjModel.from_xml_string(MODELS[model]).nv > 0
