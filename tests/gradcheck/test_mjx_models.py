"""The check on foreign MJCF files, MJX's test models: verdicts as `docs/gradient-faults.md` says."""

import re
from pathlib import Path

import pytest
from mujoco import mjx

from mjx_study.gradcheck import gradcheck, plan_scene_gradcheck
from mjx_study.simulation.scene import load_scene

MODELS = Path(mjx.__file__).parent / "test_data"
PAGE = (Path(__file__).parents[2] / "docs" / "gradient-faults.md").read_text()
TABLE = re.findall(r"^\| `([\w/]+)\.xml` \| ([^|]*) \| ([^|]*) \|", PAGE, re.MULTILINE)
FAST = ("tendon/armature",)


def test_the_table_is_there() -> None:
    assert len(TABLE) >= 10 and set(FAST) <= {name for name, *_ in TABLE}


@pytest.mark.parametrize(
    ("name", "budget", "verdict"),
    [pytest.param(*row, id=row[0], marks=[] if row[0] in FAST else [pytest.mark.slow]) for row in TABLE],
)
def test_a_model_is_as_the_page_says(name: str, budget: str, verdict: str) -> None:
    options = {"iterations": 100, "ls_iterations": 50} if budget == "100, 50" else {}
    scene = load_scene(MODELS / f"{name}.xml", **options)
    report = gradcheck(plan_scene_gradcheck(scene, seed=0, states=3))
    assert report.passed is (verdict.startswith("right")), "\n".join(report.lines())
    found = {finding.verdict for finding in report.findings}
    said = set(re.findall(r"kink|jump|unconverged|zero|nan|wrong|engine_mismatch", verdict))
    assert found == said, "\n".join(report.lines())
