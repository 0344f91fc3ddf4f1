"""Figures of gradient estimates: variance, error, bias and weights."""

import json

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mjx_study.choices import DEFAULT_SOLREF
from mjx_study.plots.panels import (
    MOST_PANELS,
    SWEPT,
    against_stiffness,
    by_family,
    estimators,
    families,
    geometric,
    legend_below,
    line,
    make_logarithmic,
    note,
    panels,
    positions,
    positive,
    shade_unstable,
)
from mjx_study.plots.style import NO_CONTACT, TITLES, line_with_band


def comparison(part: xr.Dataset, title: str) -> Figure:
    """Plot variance above and relative error below, with intervals of one batch; one column per contact family."""
    found, confidence = by_family(part), json.loads(part.attrs["config"])["confidence"]
    title = f"{title}\ngradient estimates (bands: {100 * confidence:.0f} % intervals)"
    figure, axes = panels(2, len(found), 1.2 + 3.4 * len(found), 6.2, title, sharex="col", sharey="row")
    for (above, below), (family, rows) in zip(axes.T, found, strict=True):
        x = positions(rows)
        for mine, style in estimators(rows.isel(seed=0)):
            line_with_band(above, x, *(positive(mine["variance" + end]) for end in ("", "_lower", "_upper")), **style)
            y, error = positive(mine["relative_error"]), np.asarray(mine["relative_error_se"], float)
            lower, upper = positive(np.maximum(y - 1.96 * error, y / 10)), positive(y + 1.96 * error)
            line_with_band(below, x, y, lower, upper, **{**style, "label": None})
        floor = positive(rows["reference_uncertainty"])
        below.plot(x, floor, color="0.4", linestyle=":", marker="_", label="uncertainty of the reference")
        below.axhline(1, color="0.7", linewidth=0.8, label="as large as the gradient")
        for panel in (above, below):
            make_logarithmic(panel, x)
        above.set_title(TITLES.get(family, family))
        below.set_xlabel(SWEPT["stiffness"])
        if not np.any(rows["stiffness"].values):
            below.set_xlabel("")
            below.set_xticks([NO_CONTACT], ["no contact"])
            below.set_xticks([], minor=True)
        _mark_default(above, family, rows)
        shade_unstable((above, below), rows, x)
    known = positive(part["variance"].isel(seed=0))
    if np.any(np.isfinite(known)):  # limits from the variances, since intervals may span thirty decades
        axes[0, 0].set_ylim(np.nanmin(known) / 100, np.nanmax(known) * 100)
    axes[0, 0].set_ylabel("variance of one sample")
    axes[1, 0].set_ylabel(f"relative error of the mean\nof {int(part['samples'])} samples")
    legend_below(figure, columns=2 * len(found))
    return figure


def _mark_default(axes: Axes, family: str, rows: xr.Dataset) -> None:
    """Mark the stiffness of MuJoCo's default time constant in its own family."""
    if family != "mujoco" or "solref" not in rows:
        return
    mass = float(rows["stiffness"][0]) / -float(rows["solref"].isel(model=0, solref_entry=0))
    stiffness = mass / (DEFAULT_SOLREF[0] * DEFAULT_SOLREF[1]) ** 2
    axes.axvline(stiffness, color="0.4", linestyle="--", linewidth=0.8)
    note(axes, stiffness, "default solref", ha="right", fontsize="small", color="0.3")


def variance(part: xr.Dataset, title: str) -> Figure:
    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in estimators(rows):
            line(axes, mine, x, *geometric(mine["variance"]), style)

    seeds = part.sizes["seed"]
    return against_stiffness(
        part, f"{title}\nvariance ({seeds} seeds, 95 % intervals)", "variance of one gradient sample", draw
    )


def bias(part: xr.Dataset, title: str) -> Figure | None:
    if not bool(part["squared_bias"].notnull().any()):
        return None  # needs at least three seeds

    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in estimators(rows):
            square, error = (np.asarray(mine[name], float) for name in ("squared_bias", "squared_bias_se"))
            low, high = (positive(square + sign * 1.96 * error) ** 0.5 for sign in (-1, 1))
            seen = np.isfinite(low)
            y = np.where(seen, positive(square) ** 0.5, np.nan)
            bars = np.nan_to_num([y - low, high - y])
            joined = "-" if len(x) > 2 and len(np.unique(rows["contact"].values)) == 1 else "none"
            shown = {name: style[name] for name in ("label", "color", "marker")}
            shown |= {"markerfacecolor": "none", "markersize": 7.5} if style["hollow"] else {"markersize": 4.5}
            axes.errorbar(x, y, yerr=bars, **shown, capsize=2.5, linestyle=joined)
            axes.plot(x[~seen], high[~seen], color=style["color"], marker="v", linestyle="none", alpha=0.45)
        axes.plot([], [], color="0.5", marker="v", linestyle="none", alpha=0.6, label="no bias seen: upper bound")
        axes.axhline(1, color="0.7", linewidth=0.8)

    pooled = part.sizes["seed"] * int(part["samples"])
    return against_stiffness(
        part,
        f"{title}\nbias, from {pooled} samples and a zeroth-order reference (95 % intervals)",
        "bias over the gradient's norm",
        draw,
    )


def alpha(part: xr.Dataset, title: str) -> Figure | None:
    weighed = part.isel(estimator=np.flatnonzero(part["alpha"].notnull().any(["model", "seed"])))
    if weighed.sizes["estimator"] == 0:
        return None

    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in estimators(rows):
            values = mine["alpha"].transpose("model", "seed").values
            line(axes, mine, x, np.nanmean(values, 1), np.nanmin(values, 1), np.nanmax(values, 1), style)
        axes.set_ylim(-0.03, 1.03)

    return against_stiffness(
        weighed, f"{title}\nweight of first-order gradients (mean and range of the seeds)", "alpha", draw, log=False
    )


def error_against_samples(part: xr.Dataset, title: str) -> Figure:
    """Plot one panel per contact family, at its middle stiffness."""
    chosen = [rows.isel(model=[rows.sizes["model"] // 2]) for family, rows in families(part) if family]
    chosen += [rows.isel(model=[index]) for family, rows in families(part) if not family
               for index in range(rows.sizes["model"])]  # fmt: skip
    chosen = chosen[:MOST_PANELS]
    title = f"{title}\nerror (95 % intervals over the seeds; dotted: of the reference)"
    figure, grid = panels(1, len(chosen), 1.4 + 3.2 * len(chosen), 3.7, title, sharey=True)
    for axes, rows in zip(grid[0], chosen, strict=True):
        x = rows["samples"].values
        for mine, style in estimators(rows):
            line_with_band(axes, x, *geometric(mine["relative_error"].isel(model=0)), **style)
        axes.plot(x, np.full(len(x), float(rows["reference_uncertainty"].mean())), color="0.4", linestyle=":")
        make_logarithmic(axes, x)
        axes.set_xlabel(SWEPT["samples"])
        axes.set_title(str(rows["model"].item()), fontsize="medium")
    grid[0, 0].set_ylabel("relative error of the mean")
    grid[0, 0].legend(frameon=False, fontsize="small")
    return figure
