"""Figures of gradient estimates: variance, error, bias and weights."""

import json
from typing import Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_study.choices import DEFAULT_SOLREF
from mjx_study.plots.panels import (
    MOST_PANELS,
    against_stiffness,
    beside,
    estimators,
    families,
    geometric,
    limits,
    line,
    make_logarithmic,
    make_panels,
    mark_undrawn,
    model_title,
    positive,
    sane,
    shade_unstable,
    stiffness_axis,
)
from mjx_study.plots.style import line_with_band
from mjx_study.results.variables import COORDINATES, GRADIENTS
from mjx_study.table import plural

WHOLE: Final = "as large as the gradient"


def comparison(part: xr.Dataset, title: str) -> Figure:
    """Plot variance above and relative error below, with intervals of one batch; one column per contact family."""
    found, confidence = families(part), json.loads(part.attrs["config"])["confidence"]
    title = f"{title}\ngradient estimates ({100 * confidence:.0f} % intervals)"
    figure, axes = make_panels(2, len(found), 1.2 + 3.4 * len(found), 6.2, title, sharex="col", sharey="row")
    one = part.isel(seed=0).assign(whole=xr.ones_like(part["reference_uncertainty"]))
    for panel, names, room in (
        (axes[0, 0], ["variance"], 100.0),
        (axes[1, 0], ["relative_error", "reference_uncertainty", "whole"], 10.0),
    ):  # limits from the values, since intervals may span thirty decades
        panel.set(yscale="log")
        if ends := limits(one, names, room):
            panel.set_ylim(ends)
    for (above, below), (family, rows) in zip(axes.T, found, strict=True):
        x = stiffness_axis(below, family, rows)
        above.set_title(below.get_title(), fontsize="medium")
        below.set_title("")
        for mine, style in estimators(rows.isel(seed=0)):
            y, lower, upper = (positive(mine["variance" + end]) for end in ("", "_lower", "_upper"))
            line(above, mine, x, y, lower, upper, style)
            mark_undrawn(above, x, mine["variance"].values, style)
            mark_undrawn(below, x, mine["relative_error"].values, style)
            y, error = positive(mine["relative_error"]), np.asarray(mine["relative_error_se"], float)
            lower = np.maximum(y - 1.96 * error, below.get_ylim()[0] / 2)  # just beyond the axis
            line(below, mine, x, y, lower, positive(y + 1.96 * error), style)
        floor, dotted = positive(rows["reference_uncertainty"]), ":" if family and len(x) > 2 else "none"
        below.plot(x, floor, color="0.4", linestyle=dotted, marker="_", label="uncertainty of the reference")
        below.axhline(1, color="0.7", linewidth=0.8, label=WHOLE)
        for panel in (above, below):
            make_logarithmic(panel, x if family else None)
            shade_unstable(panel, family, rows, x)
        _mark_default(above, family, rows)
    axes[0, 0].set_ylabel(GRADIENTS["variance"].label)
    error, samples = GRADIENTS["relative_error"].heading, plural(int(part["samples"]), "sample")
    axes[1, 0].set_ylabel(f"{error} of the mean\nof {samples}")
    return figure


def _mark_default(axes: Axes, family: str, rows: xr.Dataset) -> None:
    """Mark the stiffness of MuJoCo's default time constant in its own family."""
    if family != "mujoco" or "solref" not in rows:
        return
    mass = float(rows["stiffness"][0]) / -float(rows["solref"].isel(model=0, solref_entry=0))
    stiffness = mass / (DEFAULT_SOLREF[0] * DEFAULT_SOLREF[1]) ** 2
    axes.axvline(stiffness, color="0.4", linestyle="--", linewidth=0.8, label="default solref")


def variance(part: xr.Dataset, title: str) -> Figure:
    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in estimators(rows):
            y, lower, upper = geometric(mine["variance"])
            line(axes, mine, x, y, lower, upper, style)
            mark_undrawn(axes, x, np.where(np.isfinite(y), y, mine["variance"].max("seed").values), style)
        if not sane(part, ["variance"]).all() and (ends := limits(part, ["variance"], 10.0)):
            axes.set_ylim(ends)

    seeds = plural(part.sizes["seed"], "seed")
    return against_stiffness(part, f"{title}\nvariance ({seeds}, 95 % intervals)", GRADIENTS["variance"].label, draw)


def bias(part: xr.Dataset, title: str) -> Figure | None:
    if not bool(part["squared_bias"].notnull().any()):
        return None  # needs at least three seeds

    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for rank, (mine, style) in enumerate(estimators(rows)):
            at = beside(axes, x, rank - (rows.sizes["estimator"] - 1) / 2)
            square, error = (np.asarray(mine[name], float) for name in ("squared_bias", "squared_bias_se"))
            low, high = (positive(square + sign * 1.96 * error) ** 0.5 for sign in (-1, 1))
            seen = np.isfinite(low)
            y = np.where(seen, positive(square) ** 0.5, np.nan)
            bars = np.nan_to_num([y - low, high - y])
            joined = (
                ("--" if style["hollow"] else "-")
                if len(x) > 2 and len(np.unique(rows["contact"].values)) == 1
                else "none"
            )
            shown = {name: style[name] for name in ("label", "color", "marker")}
            shown |= {"markerfacecolor": "none", "markersize": 7.5} if style["hollow"] else {"markersize": 4.5}
            axes.errorbar(at, y, yerr=bars, **shown, capsize=2.5, linestyle=joined)
            axes.plot(at[~seen], high[~seen], color=style["color"], marker="v", linestyle="none", alpha=0.45)
            mark_undrawn(axes, at, square + 1.96 * error, style)
        axes.plot([], [], color="0.5", marker="v", linestyle="none", alpha=0.6, label="no bias seen: upper bound")
        axes.axhline(1, color="0.7", linewidth=0.8, label=WHOLE)
        squares = part.assign(whole=xr.ones_like(part["squared_bias"]))
        if not sane(part, ["squared_bias"]).all() and (ends := limits(squares, ["squared_bias", "whole"], 100.0)):
            axes.set_ylim(ends[0] ** 0.5, ends[1] ** 0.5)

    pooled = part.sizes["seed"] * int(part["samples"])
    return against_stiffness(
        part,
        f"{title}\nbias, from {pooled} samples and a zeroth-order reference (95 % intervals)",
        "bias over the norm of the gradient",
        draw,
    )


def alpha(part: xr.Dataset, title: str) -> Figure | None:
    weighed = part.isel(estimator=np.flatnonzero(part["alpha"].notnull().any(["model", "seed"])))
    if weighed.sizes["estimator"] == 0:
        return None

    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in estimators(rows):
            values = mine["alpha"].transpose("model", "seed")
            mean, least, most = (getattr(values, how)("seed").values for how in ("mean", "min", "max"))
            line(axes, mine, x, mean, least, most, style)
            mark_undrawn(axes, x, np.where(values.notnull().any("seed"), 1.0, np.nan), style)
        axes.set_ylim(-0.03, 1.03)

    seeds = plural(part.sizes["seed"], "seed")
    title = f"{title}\nweight of first-order gradients (mean and range of {seeds})"
    return against_stiffness(weighed, title, GRADIENTS["alpha"].label, draw, log=False)


def error_against_samples(part: xr.Dataset, title: str) -> Figure:
    """Plot one panel per contact family, at its middle stiffness."""
    chosen = [rows.isel(model=[rows.sizes["model"] // 2]) for family, rows in families(part) if family]
    chosen += [rows.isel(model=[index]) for family, rows in families(part) if not family
               for index in range(rows.sizes["model"])]  # fmt: skip
    chosen = chosen[:MOST_PANELS]
    title = f"{title}\nerror (95 % intervals over the seeds)"
    figure, grid = make_panels(1, len(chosen), 1.4 + 3.2 * len(chosen), 3.7, title, sharey=True)
    for axes, rows in zip(grid[0], chosen, strict=True):
        x = rows["samples"].values
        for mine, style in estimators(rows):
            y, *interval = geometric(mine["relative_error"].isel(model=0))
            line_with_band(axes, x, y, *interval, **style)
            mark_undrawn(axes, x, y, style)
        floor = float(rows["reference_uncertainty"].mean())
        axes.plot(x, np.full(len(x), floor), ":", color="0.4", label="uncertainty of the reference")
        make_logarithmic(axes, x)
        axes.set_xlabel(COORDINATES["samples"].label)
        axes.set_title(model_title(rows.isel(model=0)), fontsize="medium")
    grid[0, 0].set_ylabel(f"{GRADIENTS['relative_error'].heading} of the mean")
    return figure
