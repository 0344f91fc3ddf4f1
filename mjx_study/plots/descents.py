"""Figures of descents: the costs they reach, and their progress."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_study.plots.panels import a_few, against_stiffness, estimators, line, panels
from mjx_study.plots.style import robust_limits

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
        for axes in row[:3] if curves else ():
            axes.set_ylim(*_descent_limits(curves, float(one["start_cost"])))
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


def _descent_limits(curves: list[np.ndarray], start: float) -> tuple[float, float]:
    """Axis limits for decreasing costs; a descent that diverges leaves them at the top."""
    low, high = robust_limits(curves)
    room = start - low
    return (low, min(high, start + 2 * room)) if room > 0 else (low, high)
