"""The scripts of the documentation: those that pages name exist, and their parts do what they say."""

import importlib.util
import json
import re
from pathlib import Path

import numpy as np
import pytest

from experiments import DATA
from experiments.pages import replace_tables
from experiments.scaling.figure import PANELS, scaling_figure
from experiments.timing import interleaved
from experiments.toss import DAMPING, START, STIFFNESS, point

ROOT = Path(__file__).parents[1]


def test_every_script_that_a_page_names_exists() -> None:
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), ROOT / "Makefile"]
    text = "".join(page.read_text() for page in pages if page.name != "CHANGELOG.md")
    named = set(re.findall(r"-m ((?:experiments|tools)\.[a-z_]+)", text))
    assert len(named) >= 6
    for module in named:
        spec = importlib.util.find_spec(module)
        assert spec is not None and spec.origin is not None
        path = Path(spec.origin)
        path = path.with_name("__main__.py") if spec.submodule_search_locations else path
        assert '__name__ == "__main__"' in path.read_text(), module


def test_a_table_is_replaced_between_its_markers() -> None:
    page = "a\n<!-- table: one -->\nold\n<!-- end -->\n<!-- table: two -->\nkept\n<!-- end -->\n"
    assert replace_tables(page, {"one": r"new \1"}) == page.replace("old", r"new \1")
    with pytest.raises(ValueError, match="must have one table three, it has 0"):
        replace_tables(page, {"three": ""})


def test_interleaved_calls_alternate_until_the_limit() -> None:
    now, order = [0.0], []

    def call(name: str, seconds: float) -> None:
        order.append(name)
        now[0] += seconds

    calls = {"a": lambda: call("a", 1.0), "b": lambda: call("b", 2.0)}
    assert interleaved(calls, 5, clock=lambda: now[0], limit=6.0) == {"a": [1.0, 1.0], "b": [2.0, 2.0]}
    assert order == ["a", "b", "a", "b"]


@pytest.mark.parametrize("name", ["scaling_cpu.json", "scaling_gpu.json"])
def test_the_figure_of_scaling_has_the_measured_points(name: str) -> None:
    document = json.loads((DATA / name).read_text())
    panels = dict(zip(PANELS, scaling_figure([document]).axes, strict=True))
    for axis, axes in panels.items():
        lines = [np.asarray(line.get_xdata(), float) for line in axes.lines if line.get_marker() != "None"]
        measured = [row for row in document["measured"] if row["axis"] == axis and row["kind"] in ("value", "gradient")]
        assert sorted(np.concatenate(lines)) == sorted(row["at"] for row in measured)


def test_the_published_toy_has_the_derivative_of_its_steps() -> None:
    """Against differences where contact begins within a step, and one step of contact by hand."""
    start, small = np.array([START + 0.003, 0.807]), 1e-6
    for pulls in (True, False):
        ends = [point(start + sign * small, 0.01, pulls=pulls)[0] for sign in (1, -1)]
        np.testing.assert_allclose(point(start, 0.01, pulls=pulls)[1], (ends[0] - ends[1]) / (2 * small), rtol=1e-5)
    height, step = -0.5, 2.0  # two seconds in one step
    speed = -1 + step * (DAMPING - STIFFNESS * height)
    assert point(np.array([height]), step, pulls=True)[0] == pytest.approx(abs(height + step * speed - 1))
