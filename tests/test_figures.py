"""Figures of made-up studies: what they show, mark and name, and that their texts fit."""

import json
import re
from typing import Any

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from mjx_study._matplotlib import matplotlib
from mjx_study.plots.panels import UNDRAWN, UNSTABLE
from mjx_study.plots.study import plot_study
from mjx_study.plots.style import STYLES, fit_to_paper, mark_clipped, style_of
from mjx_study.report import render_report
from mjx_study.results.kind import find_kind
from mjx_study.results.rows import meanings_of
from mjx_study.results.rows import numbers_of as table_of
from mjx_study.results.variables import CELL, ONSETS

OUTER = ("task", "timestep", "cone", "model", "sigma", "samples")
MASS, TIMESTEP = 0.05, 0.01  # kg, s: an undamped spring is unstable from 2000 N/m on
FAMILIES = ("penalty", "mujoco", "mujoco_stiff", "smooth_onset")
BOTH = ("zobg", "fobg", "aobg")


def study(kind: str, models: list[tuple[str, float]], seeds: int = 1, sigma=(0.1,), **changes: Any) -> xr.Dataset:
    """A study whose numbers are all 0.5 unless changed, to what broadcasts over a variable's dimensions."""
    coords: dict[str, Any] = {
        "task": ["pusher"], "timestep": [TIMESTEP], "cone": ["pyramidal"], "sigma": list(sigma), "samples": [50],
        "model": [f"{family} {stiffness:g}" if stiffness else family for family, stiffness in models],
        "estimator": list(BOTH), "seed": range(seeds), "iteration": range(1, 41), "point": range(41),
    }  # fmt: skip
    sizes = {name: len(values) for name, values in coords.items()} | {"solref_entry": 2}
    data = {}
    changes.setdefault("position", along("point", *range(41)))
    for name, variable in ({**find_kind(kind).variables, "solref": CELL["solref"]}).items():
        dims = (*OUTER, *variable.dims)
        if "param" not in dims:
            full = xr.DataArray(np.full([sizes[dim] for dim in dims], 0.5), dims=dims)
            data[name] = (full * 0 + changes.get(name, full)).transpose(*dims)
    springs = [[-stiffness / MASS, 0.0] for _, stiffness in models]
    data["solref"] = data["solref"] * 0 + xr.DataArray(springs, dims=("model", "solref_entry"))
    used = {dim for array in data.values() for dim in array.dims}
    found = xr.Dataset(data, {name: values for name, values in coords.items() if name in used})
    found = found.assign_coords({n: ("model", [m[k] for m in models]) for k, n in enumerate(("contact", "stiffness"))})
    config = json.dumps({"confidence": 0.95, "direction": None, "kind": kind})
    return found.assign_attrs(config=config, many_parameters=0)


def along(dim: str, *values: Any) -> xr.DataArray:
    return xr.DataArray(list(values), dims=(dim,))


def marks(axes: Axes, shape: str) -> list[tuple[float, str]]:
    """Arrowheads at an edge: where along x, and whose colour."""
    drawn = [each for each in axes.lines if each.get_transform() is not axes.transData and each.get_marker() == shape]
    return sorted((float(each.get_xdata()[0]), to_hex(each.get_color())) for each in drawn)  # type: ignore[index]


def bare() -> tuple[Figure, Axes]:
    figure = Figure()
    FigureCanvasAgg(figure)
    return figure, figure.subplots()


def legend_of(figure: Figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_titles_and_labels_fit_their_axes_on_paper() -> None:
    models = [(family, stiffness) for family in FAMILIES[:3] for stiffness in (10.0, 1000.0)]
    several = {"seeds": 3, "squared_bias": 0.5, "squared_bias_se": 0.1}
    studies = [study("gradients", models), study("gradients", models, **several), study("descents", models),
               study("landscapes", models[::2])]  # fmt: skip
    with matplotlib.rc_context(STYLES["paper"]):
        for found in studies:
            for name, figure in plot_study(found).items():
                fit_to_paper(figure)
                figure.draw_without_rendering()
                assert all(each.get_window_extent().width <= figure.bbox.width for each in figure.legends), name
                for axes in figure.axes:
                    room = axes.get_window_extent()
                    for text, height in ((axes.title, 0), (axes.xaxis.label, 0), (axes.yaxis.label, 1)):
                        box = text.get_window_extent()
                        taken, free = (box.height, room.height) if height else (box.width, room.width)
                        assert taken <= 1.05 * free, (name, text.get_text())
    assert STYLES["paper"]["svg.fonttype"] == "path"  # SVG embeds no fonts
    assert STYLES["paper"]["pdf.fonttype"] == STYLES["paper"]["ps.fonttype"] == 42


def test_curves_and_intervals_beyond_the_limits_are_marked() -> None:
    figure, axes = bare()
    axes.plot([1, 2, 3], [5.0, 50.0, np.inf], color="#112233")
    axes.fill_between([1, 2, 3], [-9.0, 1.0, 1.0], [6.0, 6.0, 6.0], color="#445566", alpha=0.2)
    axes.errorbar([2.0], [4.0], yerr=[[9.0], [1.0]], color="#778899", linestyle="none", capsize=3)
    axes.axhline(99)
    axes.set_ylim(0, 10)
    mark_clipped(figure)
    assert marks(axes, "^") == [(2.0, "#112233"), (3.0, "#112233")]
    assert marks(axes, "v") == [(1.0, "#445566"), (2.0, "#778899")]
    faces = {each.get_marker(): each.get_markerfacecolor() for each in axes.lines if np.size(each.get_xdata()) == 1}
    assert faces["v"] == "none" != faces["^"]
    heads = [each for each in axes.lines if each.get_marker() in ("^", "v") and np.size(each.get_xdata()) == 1]
    assert len(heads) == 4
    boxes = [(each.get_window_extent(), each.get_marker()) for each in heads]
    assert all(box.y0 > axes.bbox.y1 if shape == "^" else box.y1 < axes.bbox.y0 for box, shape in boxes)


def test_every_kind_of_figure_marks_what_its_limits_clip() -> None:
    models = [("penalty", stiffness) for stiffness in (10.0, 100.0, 1000.0)]
    wide = along("model", 1.0, 1e30, 1.0)
    (comparison,) = plot_study(study("gradients", models, variance=1.0, variance_upper=wide)).values()
    assert {x for x, _ in marks(comparison.axes[0], "^")} == {100.0}
    unsure = plot_study(study("gradients", models, relative_error_se=along("model", 0.01, 9.0, 0.01)))["comparison"]
    assert {x for x, _ in marks(unsure.axes[1], "v")} == {100.0}
    far = xr.where(along("iteration", *range(40)) > 20, along("estimator", 1.0, 1e6, 1.0), 1.0)
    descent = plot_study(study("descents", models, cost=far, start_cost=2.0, cost_se=0.0))["descent"]
    assert {colour for _, colour in marks(descent.axes[0], "^")} == {to_hex(style_of("fobg")[1])}
    steep = xr.where(along("point", *range(41)) == 20, along("estimator", 0.0, 1e6, 0.0), 0.0)
    rising = along("point", *range(41)) * 1.0
    (landscape,) = plot_study(study("landscapes", models[:1], slope=steep, slope_se=0.0, smoothed=rising)).values()
    assert marks(landscape.axes[1], "^") == [(20.0, to_hex(style_of("fobg")[1]))]
    assert "beyond the axis (hollow: its interval)" in legend_of(landscape)


def test_a_slope_that_is_not_resolved_sets_no_limits_unless_none_is() -> None:
    one, rising = [("penalty", 10.0)], along("point", *range(41)) * 1.0

    def lower(**slopes: Any) -> Axes:
        (figure,) = plot_study(study("landscapes", one, smoothed=rising, **slopes)).values()
        return figure.axes[1]

    mixed = lower(slope=along("estimator", 2.0, -0.1, -0.1), slope_se=along("estimator", 3.0, 0.01, 0.01))
    low, high = mixed.get_ylim()
    assert -0.2 < low < -0.1 and 0.0 < high < 0.01
    assert [text.get_text() for text in mixed.texts] == ["ZoBG not resolved (± 5.9)"]
    none = lower(slope=along("estimator", 2.0, -0.1, -0.1), slope_se=3.0)
    assert none.get_ylim()[1] > 2.0 and none.texts[0].get_text().count("not resolved") == 3


def crosses(axes: Axes) -> list[tuple[float, bool]]:
    """Crosses at the edges: where along x, and whether above."""
    drawn = [each for each in axes.lines if each.get_label() == UNDRAWN]
    return sorted((float(x), float(y) > 0.5) for each in drawn for x, y in np.asarray(each.get_xydata()))


@pytest.mark.parametrize("seeds", [1, 3])
def test_axes_follow_what_is_finite_and_stable_and_mark_the_rest(seeds: int) -> None:
    """Of 10, 100 and 1000 N/m stable, 1e4 exploded, 1e5 without a number."""
    models = [("penalty", stiffness) for stiffness in (10.0, 100.0, 1000.0, 1e4, 1e5)]
    wild = along("model", 1.0, 10.0, 300.0, 1e76, np.nan)
    numbers = {"variance": wild, "variance_lower": wild, "variance_upper": wild, "squared_bias": wild}
    found = study("gradients", models, seeds, relative_error=wild, squared_bias_se=0.0, **numbers)
    name = "comparison" if seeds == 1 else "variance"
    figures = plot_study(found)
    axes = figures[name].axes[0]
    assert 1e-3 < axes.get_ylim()[0] < 1 and 300 < axes.get_ylim()[1] < 1e5
    assert {x for x, _ in marks(axes, "^")} == {1e4} and crosses(axes) == [(1e5, True)] * 3
    assert UNDRAWN in legend_of(figures[name])
    if seeds > 1:
        bias = figures["bias"].axes[0]
        assert 17 < bias.get_ylim()[1] < 1e4 and len(crosses(bias)) == 3


def test_a_zero_is_marked_below_and_a_ratio_of_nothing_in_its_place() -> None:
    models = [("penalty", stiffness) for stiffness in (10.0, 100.0, 1000.0)]
    (figure,) = plot_study(study("gradients", models, variance=along("model", 1.0, 0.0, 2.0))).values()
    assert crosses(figure.axes[0]) == [(100.0, False)] * 3
    lost = along("model", 1.0, np.nan, 2.0)
    chart = plot_study(study("gradients", models, 3, (0.1, 1.0), variance=lost))["map_stiffness_sigma"]
    assert [x for x, _ in crosses(chart.axes[0])] == [1.5, 1.5]


def test_a_bound_below_zero_is_not_taken_for_no_number() -> None:
    """Squared biases are estimates that may be negative."""
    models = [("penalty", stiffness) for stiffness in (10.0, 100.0, 1000.0)]
    square = along("model", 1.0, -0.3, np.nan)
    figure = plot_study(study("gradients", models, 3, squared_bias=square, squared_bias_se=0.1))["bias"]
    assert sorted(above for _, above in crosses(figure.axes[0])) == [False] * 3 + [True] * 3


def test_a_map_is_over_stiffness() -> None:
    """And another parameter; two others make none."""
    models = [("penalty", 10.0), ("penalty", 100.0)]
    for chosen, drawn in ((models, {"map_stiffness_timestep_0.1", "map_stiffness_timestep_1"}), (models[:1], set())):
        found = study("gradients", chosen, 3, (0.1, 1.0))
        found = xr.concat([found, found.assign_coords(timestep=[2 * TIMESTEP])], "timestep")
        assert {name for name in plot_study(found) if name.startswith("map")} == drawn


@pytest.mark.slow
@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, 1e138, 1e308])
@pytest.mark.parametrize("kind", ["gradients", "descents", "landscapes"])
def test_figures_and_reports_of_extreme_numbers_warn_of_nothing(kind: str, value: float) -> None:
    """Warnings are errors here."""
    models = [("penalty", stiffness) for stiffness in (10.0, 100.0, 1000.0)]
    counts = {"nonfinite", "unconverged", "position", "residual", "rollouts", *ONSETS}
    config = json.dumps({"confidence": 0.95, "direction": None, "tasks": ["pusher"], "theta": [], "kind": kind})
    for where in (along("model", True, False, False), along("model", True, True, True)):
        extreme = {name: xr.where(where, value, 0.5) for name in find_kind(kind).variables if name not in counts}
        found = study(kind, models, 3, (0.1, 1.0), **extreme)
        assert plot_study(found)
        attrs = {"config": config, "environment": json.dumps({"versions": {}}), "missing_cells": 0}
        attrs |= {"mixed_versions": "", "resolved": json.dumps([{"estimators": {}}])}
        assert "<table" in render_report(found.assign_attrs(attrs))


def test_achieved_costs_are_above_one_baseline_and_none_is_drawn_at_it() -> None:
    cost = along("model", 3.0, 5.0, 9.0) + along("estimator", 0.0, 1.0, 4.0)
    models = [("penalty", stiffness) for stiffness in (10.0, 100.0, 1000.0)]
    figure = plot_study(study("descents", models, final_cost=cost))["achieved"]
    (axes,) = [each for each in figure.axes if each.get_xlabel()]
    curves = {line.get_label(): np.asarray(line.get_ydata(), float) for line in axes.lines}
    np.testing.assert_allclose(curves["ZoBG"], [np.nan, 2, 6])  # the baseline itself: not on a logarithmic axis
    np.testing.assert_allclose(curves["FoBG"], [1, 3, 7])
    assert marks(axes, "v") == [(10.0, to_hex(style_of("zobg")[1]))]
    assert axes.get_ylim()[1] == pytest.approx(3 * (9 + 4 - 3))
    assert "3" in axes.get_ylabel().split()[-1] and "lowest" in axes.get_ylabel()
    assert figure.get_suptitle().endswith("(1 seed)")


def test_unstable_steps_are_shown_wherever_the_axis_is_stiffness() -> None:
    mixed = [("penalty", 10.0), ("penalty", 100.0), ("penalty", 1e4), ("mujoco", 1e4), ("smooth_onset", 10.0)]
    (figure,) = plot_study(study("gradients", mixed)).values()
    shaded = [[patch for patch in axes.patches if patch.get_label() == UNSTABLE] for axes in figure.axes]
    assert [len(each) for each in shaded] == [1, 1, 1, 1]  # two rows: from the limit on; the first of two families
    assert shaded[1][0].get_extents().width > 0 and UNSTABLE in legend_of(figure)
    assert figure.legends[0].get_lines()[0].get_linestyle() == "-"  # as in the panel of a family, not of single models
    assert not any(text.get_text() == UNSTABLE for axes in figure.axes for text in axes.texts)  # not on the data
    swept = [("penalty", stiffness) for stiffness in (10.0, 100.0, 1e4)]
    chart = plot_study(study("gradients", swept, 3, (0.1, 1.0)))["map_stiffness_sigma"]
    hatched = [patch.get_xy() for patch in chart.axes[0].patches if patch.get_hatch()]  # type: ignore[attr-defined]
    assert hatched == [(2, 0), (2, 1)] and UNSTABLE in legend_of(chart)


def test_negative_costs_have_no_ratio_and_no_map() -> None:
    for cost, drawn in ((0.5, True), (-0.5, False)):
        figures = plot_study(study("descents", [("penalty", 10.0), ("penalty", 100.0)], 1, (0.1, 1.0), final_cost=cost))
        assert ("map_stiffness_sigma" in figures) == drawn


def test_one_stiffness_gives_an_axis_of_families() -> None:
    """Warnings are errors here: an axis of one stiffness had identical limits."""
    (figure,) = plot_study(study("gradients", [(family, 1000.0) for family in FAMILIES])).values()
    assert len(figure.axes) == 2 and len(figure.axes[1].get_xticklabels()) == len(FAMILIES)


def numbers_of(found: xr.Dataset) -> dict[tuple[str, ...], list[list[str]]]:
    """Headings of the table in a report, and its rows."""
    page = render_report(found)
    table = page[page.index("<h2>Numbers") : page.index("<h2>Configuration")]
    headings = tuple(re.findall(r"<th(?: [^>]*)?>(.*?)</th>", table))
    return {headings: [re.findall(r"<td>(.*?)</td>", row) for row in table.split("\n") if "<td>" in row]}


def test_a_report_shows_what_there_is_and_once() -> None:
    """One number of a cell stands in its first row, and what no estimator has, in none."""
    config = {"confidence": 0.95, "direction": None, "tasks": ["pusher"], "theta": [], "gamma": 0.0}
    attrs = {"environment": json.dumps({"versions": {}}), "missing_cells": 0, "mixed_versions": ""}
    lines = study(
        "landscapes", [("penalty", 10.0)], smoothed=along("point", *range(41)), smoothed_se=0.0312, slope=-2.0
    )
    lines = lines.assign_attrs(attrs | {"config": json.dumps(config | {"kind": "landscapes"})})
    assert numbers_of(lines) == {
        ("contact model", "estimator", "least mean cost", "least at", "steepest slope", "nan"): [
            ["penalty, K = 10 N/m", "ZoBG", "0 ± 0.031", "0", "2", "20"],
            *(["", name, "", "", "2", "20"] for name in ("FoBG", "AoBG")),
        ]
    }
    page = render_report(lines)
    meanings = re.findall(r'<th title="(.*?)">(.*?)</th>', page)
    assert meanings and all(f"<b>{heading}</b>: {meaning}" in page for meaning, heading in meanings)
    assert "<td>gamma</td>" in page and "<td>theta</td>" not in page and "<td>direction</td>" not in page


def test_a_table_of_estimates_has_intervals_and_milliseconds_as_compare_has() -> None:
    numbers = {"variance": 2.0, "variance_lower": 1.25, "variance_upper": 3.0, "seconds_per_sample": 0.0005}
    for seeds, variance in ((1, "2 (1.2 to 3)"), (3, "2")):
        found = study("gradients", [("penalty", 10.0)], seeds=seeds, relative_error_se=0.1, **numbers)
        headings, rows = table_of(found) or ([], [])
        assert len(rows) == 3
        for row in rows:
            shown = dict(zip(headings, row, strict=True))
            assert shown["variance"] == variance and shown["ms"] == "0.5"
        assert set(headings) <= meanings_of(found).keys() | {"contact model", "estimator"}


def test_any_name_of_a_task_can_be_written() -> None:
    found = study("gradients", [("penalty", 10.0)]).assign_coords(task=["a$\\b$\0c"])
    (figure,) = plot_study(found).values()
    assert "a$\\b$?c" in figure.get_suptitle()
