"""Environments of MuJoCo Playground, if it is installed: exact gradients where stock MJX has none."""

import importlib
import json

import numpy as np
import pytest

from experiments import DOCS, tumble


def test_the_page_has_the_table_of_the_data() -> None:
    """And its sentences hold: to about seven events, the term's deviation is below half of zeroth order's; on the
    cheetah, what it leaves falls with the step, and plain first order's error does not."""
    assert tumble.table() in (DOCS / "in-the-wild.md").read_text()
    results = list(map(json.loads, tumble.RESULTS.read_text().splitlines()))
    cheetah = [each for each in results if each["name"] == "CheetahRun"]
    for kind, low, high in (("fobg", 0.9, 1.0), ("fobg_onset", 0.5, 0.7)):
        off = np.array([each[kind]["mean"][0] / each["slope"][0] - 1 for each in cheetah])
        assert np.all((low < off[1:] / off[:-1]) & (off[1:] / off[:-1] < high)) and [
            each["substeps"] for each in cheetah
        ] == [1, 2, 4]
    for each in results[: -len(cheetah)]:
        share = each["fobg_onset"]["deviation"] / each["zobg"]["deviation"]
        error = np.hypot(each["slope"][1], each["fobg_onset"]["mean"][1])
        off = abs(each["slope"][0] - each["fobg_onset"]["mean"][0]) / error
        assert share < 0.5 and off < 2.3 if each["events"] < 7 else each["events"] > 20 and share > 6


@pytest.mark.slow
def test_gradients_through_an_environment_are_those_of_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hopper's over five steps, with the solver's own budget and converged."""
    pytest.importorskip("mujoco_playground", reason="needs `pip install playground`")
    wild = importlib.import_module("experiments.wild")
    monkeypatch.setattr(wild, "STEPS", 5)
    found = wild.single(wild.environment("HopperHop"))
    assert found["stock_own"].startswith("Reverse-mode differentiation does not work")
    assert abs(found["ours"]) > 1e-3
    np.testing.assert_allclose(
        [found["ours_own"], found["ours"]], [found["differences_own"][2], found["differences"][2]], rtol=1e-5
    )
