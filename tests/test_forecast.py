"""A dry run: the cost of a study counted from its plan, with nothing computed or written."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_study import cli
from mjx_study.execution.forecast import forecast_study
from mjx_study.experiment.plan import plan_study
from mjx_study.options.configuration import StudyConfig
from mjx_study.storage.folder import load_study
from tests.documents import content

DESCENTS = (
    "optimise pusher --reference --horizon 8 --iterations 3 --seeds 2 --samples 4 --evaluation-samples 5 "
    "--estimators zobg,fobg --output"
).split()


def test_batches_of_gradients_are_counted() -> None:
    """Of each cell: 3 seeds of 8 values, one baseline and 8 gradients; 10 pairs and 100 candidates of the reference."""
    config = StudyConfig(
        tasks=("pusher",), contact=("penalty",), stiffness=(10.0, 100.0), samples=(8,), seeds=3, horizon=4,
        reference_samples=10,
    )  # fmt: skip
    found = forecast_study(plan_study(config))
    assert (found.cells, found.computed, found.programs) == (2, 0, 2)
    assert found.rollouts == 2 * (3 * (8 + 1 + 8) + 2 * 10 + 100)
    assert found.gradients == 2 * (3 * 8 + 100)


def test_points_of_landscapes_are_counted() -> None:
    """5 points of 8 values, a baseline and 8 gradients; 1500 gradients of the quadrature in MJX alone."""
    config = StudyConfig(
        tasks=("ball_wall",), contact=("reference", "mujoco_default"), points=5, samples=(8,),
        stiffness=(1000.0,), estimators=("zobg", "fobg"),
    )  # fmt: skip
    found = forecast_study(plan_study(config))
    assert found.rollouts == 2 * 5 * (8 + 1 + 8) + 1500 and found.gradients == 2 * 5 * 8 + 1500


def test_what_is_forecast_is_what_descents_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Their own count of rollouts; nothing is written, and another study is refused."""
    folder = tmp_path / "out"

    def told(*options: str) -> dict[str, Any]:
        assert cli.main([*DESCENTS, str(folder), "--json", *options]) == 0
        return json.loads(capsys.readouterr().out)

    found = told("--dry-run")
    assert not folder.exists() and (found["cells"], found["computed"], found["programs"]) == (1, 0, 0)
    told()
    data, before = load_study(folder), content(folder)
    assert found["rollouts"] == 2 * 3 * int(np.sum(data["rollouts"])) + (2 * 2 + 1) * 5
    assert found["gradients"] == 2 * 3 * 4 and found["kept"] >= 8 * data["theta"].size
    assert told("--dry-run")["computed"] == 1 and told("--dry-run", "--iterations", "5")["computed"] == 0
    assert cli.main([*DESCENTS, str(folder), "--dry-run", "--sigma", "0.3"]) == 2
    assert "holds another study" in capsys.readouterr().err and content(folder) == before
