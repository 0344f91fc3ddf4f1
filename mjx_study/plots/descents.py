"""Figures of descents, the costs they reach and their progress, and of landscapes."""

import json
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_study.plots.panels import a_few, against_stiffness, estimators, legend_below, line, panels
from mjx_study.plots.style import STYLE, TITLES, mean_with_band, robust_limits

MOST_DECADES: Final = 1e7
"""Maximum ratio of the ends of a cost axis; beyond it a descent counts as diverged."""


def achieved(part: xr.Dataset, title: str) -> Figure | None:
    """Plot final policy costs above the best one of each contact model; outliers are at the upper edge."""
    if part.sizes["model"] < 2:
        return None  # the table shows it
    best = part["final_cost"].min(["seed", "estimator"])
    excess = part["final_cost"] - best
    middle = excess.median("seed").values
    positive = middle[np.isfinite(middle) & (middle > 0)]
    floor = float(np.min(positive)) / 3 if len(positive) else 1e-3
    ceiling = MOST_DECADES * floor

    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in estimators(rows):
            above = (mine["final_cost"] - best.sel(model=mine["model"])).transpose("model", "seed").values
            lost = ~np.isfinite(above).any(axis=1) | ~(np.nanmedian(np.nan_to_num(above, nan=np.inf), axis=1) < ceiling)
            above = np.clip(np.nan_to_num(above, nan=ceiling), floor, ceiling)
            middle = np.where(lost, np.nan, np.median(above, axis=1))
            line(axes, mine, x, middle, middle, middle, style)
            seeds = np.where((above > floor) & (above < ceiling), above, np.nan)
            axes.plot(x, seeds, color=style["color"], marker=".", markersize=4, linestyle="none", alpha=0.6)
            axes.plot(x[lost], np.full(lost.sum(), ceiling / 2), color=style["color"], marker="^", linestyle="none")
        axes.plot([], [], color="0.4", marker="^", linestyle="none", label="beyond the axis")
        axes.set_ylim(floor / 1.5, ceiling)

    iterations, seeds = part.sizes["iteration"], part.sizes["seed"]
    return against_stiffness(
        part,
        f"{title}\ncost after {iterations} iterations ({seeds} seeds as dots, and their median)",
        "cost above the best policy found\nat that contact model",
        draw,
    )


def descent(part: xr.Dataset, title: str) -> Figure:
    """Plot cost against iterations, rollouts and seconds, and alpha; one row for each of a few contact models."""
    models, columns = a_few(part), 4 if bool(part["alpha"].notnull().any()) else 3
    title = f"{title} ({part.sizes['seed']} seeds: median, from least to greatest)"
    figure, grid = panels(len(models), columns, 0.6 + 3.4 * columns, 1.3 + 2.5 * len(models), title)
    for row, model in zip(grid, models, strict=True):
        one = part.isel(model=model)
        curves = []
        for mine, style in estimators(one):
            cost = mine["cost"].transpose("iteration", "seed").values
            going = np.any(np.isfinite(cost), axis=1)
            if not going.any():
                continue
            cost, iteration = cost[going], mine["iteration"].values[going]
            curves.append(np.nanmedian(cost, 1))
            xs = iteration, iteration * float(mine["rollouts"]), mine["seconds"].values[going]
            weight = mine["alpha"].transpose("iteration", "seed").values[going]
            known = np.any(np.isfinite(weight), axis=1)
            if known.any():
                _median_and_range(row[3], iteration[known], weight[known], style)
            for axes, x in zip(row[:3], xs, strict=True):
                _median_and_range(axes, x, cost, style)
        if curves:
            start, (low, high) = float(one["start_cost"]), robust_limits(curves)
            room = start - low
            for axes in row[:3]:  # a descent that diverges leaves them at the top
                axes.set_ylim(low, min(high, start + 2 * room) if room > 0 else high)
        for axes in row[3:]:
            axes.set_ylim(-0.03, 1.03)
            axes.set_ylabel("alpha, weight of first order", fontsize="small")
        row[0].set_ylabel("mean cost of the batch", fontsize="small")
        row[0].set_title(one["model"].item(), loc="left", fontsize="medium")
    grid[0, 0].legend(frameon=False, fontsize="small")
    labels = ("iteration", "rollouts of one seed", "seconds, all seeds", "iteration")
    for axes, label in zip(grid[-1], labels, strict=False):
        axes.set_xlabel(label)
    return figure


def _median_and_range(axes: Axes, x: np.ndarray, values: np.ndarray, style: Mapping[str, Any]) -> None:
    """Median and range over the seeds, the second dimension."""
    axes.plot(x, np.nanmedian(values, 1), color=style["color"], label=style["label"], linewidth=1.4)
    axes.fill_between(x, np.nanmin(values, 1), np.nanmax(values, 1), color=style["color"], alpha=0.15, lw=0)


def landscape(part: xr.Dataset, title: str) -> Figure:
    """Plot cost and mean cost along the line above, estimators' slopes below; one column for each of a few models."""
    models, title = a_few(part), f"{title} at each point (bands: 95 %)"
    figure, grid = panels(2, len(models), 1.6 + 2.9 * len(models), 6.2, title, sharex=True, sharey="row")
    slopes, steepest = [], 0.0
    direction = json.loads(part.attrs["config"])["direction"] or "random"
    along = f"t, along direction {direction}" if part.attrs["many_parameters"] else "theta"
    for (above, below), model in zip(grid.T, models, strict=True):
        one = part.isel(model=model)
        t = one["position"].values
        steepest = max(steepest, float(np.nanmax(np.abs(np.gradient(one["smoothed"].values, t)), initial=0.0)))
        above.plot(t, one["cost"], color="0.55", linewidth=1.2, label="cost without noise")
        mean_with_band(above, t, one["smoothed"].values, one["smoothed_se"].values, "black", "mean cost with noise")
        if "exact_slope" in one and bool(one["exact_slope"].notnull().any()):
            above_all = {"linestyle": "none", "markerfacecolor": "none", "markersize": 4, "zorder": 3}
            below.plot(t, one["exact_slope"], "ok", **above_all, label="slope of the mean cost, quadrature")
            first = {"color": STYLE["fobg"][0], "marker": STYLE["fobg"][1]}
            below.plot(t, one["exact_first"], **first, **above_all, label="mean of FoBG, quadrature")
        for mine, style in estimators(one):
            slopes.append(mine["slope"].values)
            mean, error = mine["slope"].values, mine["slope_se"].values
            mean_with_band(below, t, mean, error, style["color"], f"mean of {style['label']}")
        family, stiffness = one["contact"].item(), float(one["stiffness"])
        spring = f"\nK = {stiffness:g} N/m" if stiffness else ""
        above.set_title(f"{TITLES.get(family, family)}{spring}", fontsize="medium")
        below.axhline(0, color="0.7", linewidth=0.8)
        below.set_xlabel(along)
    low, high = robust_limits(slopes)  # slopes far beyond that of the mean cost leave the axes
    if steepest > 0:
        low, high = max(low, -10 * steepest), min(high, 10 * steepest)
    grid[1, 0].set_ylim(low, high)
    grid[0, 0].set_ylabel("cost")
    grid[1, 0].set_ylabel("slope along the line")
    legend_below(figure, columns=2 * len(models))
    return figure
