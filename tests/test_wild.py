"""Environments of MuJoCo Playground, if it is installed: exact gradients where stock MJX has none."""

import importlib
import json

import numpy as np
import pytest

from experiments import DOCS, tumble


def test_the_page_has_the_table_of_the_data() -> None:
    """And its sentences hold: to about seven events, the term's deviation is below half of zeroth order's."""
    assert tumble.table() in (DOCS / "in-the-wild.md").read_text()
    for each in map(json.loads, tumble.RESULTS.read_text().splitlines()):
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
