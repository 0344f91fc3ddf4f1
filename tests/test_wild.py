"""Environments of MuJoCo Playground, if it is installed: exact gradients where stock MJX has none."""

import importlib

import numpy as np
import pytest


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
