"""Figures of descents, the costs they reach and their progress, and of landscapes."""

import itertools
import json
from typing import Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_study.plots.panels import a_few, against_stiffness, estimators, line, make_panels, model_title
from mjx_study.plots.style import line_with_band, robust_limits, style_of
from mjx_study.results.curves import line_of
from mjx_study.results.rows import onset_of
from mjx_study.results.variables import DERIVED, DESCENTS, LANDSCAPES
from mjx_study.table import number, plural

MOST_COST_RATIO: Final = 1e7
"""Maximum ratio of the ends of an axis of costs; beyond it a descent counts as diverged."""
MOST_SLOPE_RATIO: Final = 10  # maximum ratio of the slopes shown to the steepest of the mean cost
MOST_UNRESOLVED: Final = 0.5
"""Share of the points of a curve whose intervals contain 0 from which on it does not set the limits of an axis."""
ROOM_AT_ZERO: Final = 0.05  # room beyond zero on an axis of slopes, as a share of the rest
MIDDLE_AND_ENDS: Final = (0.5, 0, 1)  # quantiles of the seeds that a descent shows


def achieved(part: xr.Dataset, title: str) -> Figure | None:
    """Plot how far final costs lie above the lowest mean cost of any estimator at any contact model."""
    if part.sizes["model"] < 2:
        return None  # the table shows it
    best = float(part["final_cost"].mean("seed").min())
    middle = (part["final_cost"].median("seed") - best).values
    positive = middle[np.isfinite(middle) & (middle > 0)]
    floor = float(np.min(positive)) / 3 if len(positive) else 1e-3
    costs = (part["final_cost"] - best).values
    ceiling = min(MOST_COST_RATIO * floor, 3 * float(np.max(costs, where=np.isfinite(costs), initial=floor)))

    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in estimators(rows):
            above = np.nan_to_num((mine["final_cost"] - best).transpose("model", "seed").values, nan=np.inf)
            middle = np.median(above, axis=1)
            middle = np.where((floor < middle) & (middle < ceiling), middle, np.nan)  # of others only the seeds show
            line(axes, mine, x, middle, middle, middle, style)
            axes.plot(x, above, color=style["color"], marker=".", markersize=4, linestyle="none", alpha=0.6)
        axes.set_ylim(floor, ceiling)

    iterations, seeds = part.sizes["iteration"], plural(part.sizes["seed"], "seed")
    seeds += " as dots, and the median" if part.sizes["seed"] > 1 else ""
    return against_stiffness(
        part,
        f"{title}\ncost after {iterations} iterations ({seeds})",
        f"cost above the lowest\nmean, {best:.6g}",
        draw,
    )


def descent(part: xr.Dataset, title: str) -> Figure:
    """Plot cost against iterations, rollouts and seconds, and alpha; one row for each of a few contact models."""
    models, columns = a_few(part), 4 if bool(part["alpha"].notnull().any()) else 3
    seeds = plural(part.sizes["seed"], "seed")
    title = f"{title} ({f'median and range of {seeds}' if part.sizes['seed'] > 1 else seeds})"
    figure, grid = make_panels(len(models), columns, 0.6 + 3.4 * columns, 1.3 + 2.5 * len(models), title)
    for row, model in zip(grid, models, strict=True):
        one = part.isel(model=model)
        curves, least = [], np.inf
        for mine, style in estimators(one):
            cost = mine["cost"].transpose("iteration", "seed").values
            going = np.any(np.isfinite(cost), axis=1)
            if not going.any():
                continue
            cost, iteration = cost[going], mine["iteration"].values[going]
            curves.append(np.nanmedian(cost, 1))
            least = min(least, float(np.nanmin(cost)))
            xs = iteration, iteration * float(mine["rollouts"]), mine["seconds"].values[going]
            weight = mine["alpha"].transpose("iteration", "seed").values[going]
            known = np.any(np.isfinite(weight), axis=1)
            if known.any():
                line_with_band(
                    row[3], iteration[known], *np.nanquantile(weight[known], MIDDLE_AND_ENDS, axis=1), **style
                )
            for axes, x in zip(row[:3], xs, strict=True):
                line_with_band(axes, x, *np.nanquantile(cost, MIDDLE_AND_ENDS, axis=1), **style)
        if curves:
            start, (low, high) = float(one["start_cost"]), robust_limits(curves)
            if (room := start - least) > 0:  # a descent that diverges leaves them at the top
                low, high = least - 0.1 * room, max(start + 0.1 * room, min(high, start + 2 * room))
            for axes in row[:3]:
                axes.set_ylim(low, high)
        for axes in row[3:]:
            axes.set_ylim(-0.03, 1.03)
            axes.set_ylabel(DESCENTS["alpha"].label, fontsize="small")
        row[0].set_ylabel(DESCENTS["cost"].label, fontsize="small")
        row[0].set_title(model_title(one), loc="left", fontsize="medium")  # along the row
    labels = ("iteration", DERIVED["seed_rollouts"].label, DESCENTS["seconds"].label, "iteration")
    for axes, label in zip(grid.flat, itertools.cycle(labels[:columns])):
        axes.locator_params(axis="x", nbins=5, integer=label != labels[2])  # numbers of rollouts are long
    for axes, label in zip(grid[-1], labels, strict=False):
        axes.set_xlabel(label)
    return figure


def landscape(part: xr.Dataset, title: str) -> Figure:
    """Plot cost and mean cost along the line above, estimators' slopes below; one column for each of a few models."""
    models, title = a_few(part), f"{title} at each point (95 % intervals)"
    figure, grid = make_panels(2, len(models), 1.6 + 2.9 * len(models), 6.2, title, sharex=True, sharey="row")
    slopes, unresolved, steepest = [], [], 0.0
    direction = json.loads(part.attrs["config"])["direction"] or "random"
    per, unit = line_of(part)
    along = (f"t in theta + t d (d: {direction})" if per == "t" else per) + (f" [{unit}]" if unit else "")
    for (above, below), model in zip(grid.T, models, strict=True):
        one = part.isel(model=model)
        t = one["position"].values
        with np.errstate(all="ignore"):  # points may coincide
            steepest = max(steepest, float(np.nanmax(np.abs(np.gradient(one["smoothed"].values, t)), initial=0.0)))
        above.plot(t, one["cost"], color="0.55", linewidth=1.2, label=LANDSCAPES["cost"].label)
        mean = _interval(one["smoothed"], one["smoothed_se"])
        line_with_band(above, t, *mean, color="black", marker="", label=LANDSCAPES["smoothed"].label)
        if "exact_slope" in one and bool(one["exact_slope"].notnull().any()):
            above_all = {"linestyle": "none", "markerfacecolor": "none", "markersize": 4, "zorder": 3}
            below.plot(t, one["exact_slope"], "ok", **above_all, label="slope of the mean cost, quadrature")
            name, colour, marker = style_of("fobg", onset_of(part))
            first = {"color": colour, "marker": marker}
            below.plot(t, one["exact_first"], **first, **above_all, label=f"mean of {name}, quadrature")
        notes = []
        for mine, style in estimators(one):
            slope, low, high = _interval(mine["slope"], mine["slope_se"])
            if np.mean((low < 0) & (high > 0)) > MOST_UNRESOLVED:
                unresolved.append(slope)
                notes.append(f"{style['label']} not resolved (± {number(float(np.median(high - low)) / 2, 2)})")
            else:
                slopes.append(slope)
            style["label"] = f"mean of {style['label']}"
            line_with_band(below, t, slope, low, high, **style)
        if notes:
            below.text(0.02, 0.97, "\n".join(notes), transform=below.transAxes, va="top", fontsize="small")
        above.set_title(model_title(one, ",\n"), fontsize="medium")
        below.axhline(0, color="0.7", linewidth=0.8)
        below.set_xlabel(along)
    # slopes far beyond that of the mean cost leave the axes
    low, high = robust_limits([np.zeros(1), *(slopes or unresolved)])
    if steepest > 0:
        low, high = max(low, -MOST_SLOPE_RATIO * steepest), min(high, MOST_SLOPE_RATIO * steepest)
    grid[1, 0].set_ylim(min(low, -ROOM_AT_ZERO * high), max(high, -ROOM_AT_ZERO * low))
    grid[0, 0].set_ylabel("cost")
    grid[1, 0].set_ylabel(f"derivative of the\nmean cost w.r.t. {per}")
    return figure


def _interval(mean: xr.DataArray, error: xr.DataArray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean with the ends of its 95 % interval."""
    return mean.values, (mean - 1.96 * error).values, (mean + 1.96 * error).values
