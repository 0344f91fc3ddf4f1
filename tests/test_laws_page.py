"""Contact laws compared: the page is that of the data, and the data are those of the scenes."""

import numpy as np
import pytest

from experiments import DOCS
from experiments.laws import measure
from experiments.laws.page import LAWS, TOSSES, measured, tables
from experiments.pages import replace_tables

TOSSED: dict[tuple[str, str], tuple[float, float, float]] = {
    ("toss 5 ms", "MuJoCo's default"): (0.1193, 0.2938, 0.031),
    ("toss 2 ms", "MuJoCo's default"): (0.1176, 0.2910, 0.025),
    ("toss 0.5 ms", "MuJoCo's default"): (0.1164, 0.2908, 0.019),
    ("toss 5 ms", "hunt_crossley"): (0.11781, 0.11781, 0.019),
    ("toss 2 ms", "hunt_crossley"): (0.11847, 0.11850, 0.022),
    ("toss 5 ms", "kelvin_voigt"): (0.07208, 0.07208, 0.038),
    ("toss 2 ms", "kelvin_voigt"): (0.08159, 0.08159, 0.034),
    ("toss 5 ms", "log_barrier"): (0.10965, 0.10966, 0.022),
    ("toss 2 ms", "log_barrier"): (0.12058, 0.12059, 0.012),
    ("toss 5 ms", "conic"): (0.07207, 0.07211, 0.038),
    ("toss 2 ms", "conic"): (0.08158, 0.08159, 0.034),
}
"""Slope of the mean cost, E[FoBG] and its deviation by other code: of the laws, the steps of their own package."""


def test_the_page_says_what_the_data_give() -> None:
    text = (DOCS / "which-contact.md").read_text()
    assert replace_tables(text, tables()) == text


def test_the_toss_is_what_others_measured_of_it() -> None:
    found = measured()
    assert set(TOSSED) < set(TOSSES)
    for key, (slope, mean, deviation) in TOSSED.items():
        cell = found[key]
        np.testing.assert_allclose([cell["slope"], cell["first"]], [slope, mean], atol=1e-4)
        assert cell["first_sd"] == pytest.approx(deviation, abs=6e-4), key


@pytest.mark.parametrize("row", ["MuJoCo's default", "kelvin_voigt"])
def test_the_data_are_those_of_the_scene(row: str, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujodico", reason="the extra laws is not installed")
    monkeypatch.setattr(measure, "POINTS", 1000)
    monkeypatch.setattr(measure, "CHUNK", 1000)
    cell, kept = measure.integrated("toss 5 ms", *LAWS[row]), measured()["toss 5 ms", row]
    for name in ("slope", "first", "first_sd"):
        assert cell[name] == pytest.approx(kept[name], rel=1e-2), name
