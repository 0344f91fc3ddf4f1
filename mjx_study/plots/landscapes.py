"""Figure of landscapes: costs along a line, and the estimators' mean slopes."""

import json

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from mjx_study.plots.panels import a_few, estimators, legend_below, panels
from mjx_study.plots.style import STYLE, TITLES, mean_with_band, robust_limits


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
