"""Shared parts of study figures: panels by contact family, and estimator lines."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import scipy
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjx_study.plots.style import HOLLOW, NO_CONTACT, TITLES, line_with_band, style_of
from mjx_study.simulation.contact import stable

SWEPT: Final = {
    "stiffness": "contact stiffness K [N/m]",
    "timestep": "timestep h [s]",
    "sigma": "noise sigma",
    "samples": "samples N in a batch",
}
"""Dimensions that can be a figure's axis, with their labels."""
MOST_PANELS: Final = 6


def panels(
    rows: int, columns: int, width: float, height: float, title: str, **shared: Any
) -> tuple[Figure, np.ndarray]:
    """Create a figure with a title over a grid of panels; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize="medium")
    grid = figure.subplots(rows, columns, squeeze=False, **shared)
    for axes in grid.flat:
        axes.grid(alpha=0.25)
    return figure, grid


def a_few(part: xr.Dataset) -> list[int]:
    """Indices of at most `MOST_PANELS` contact models, evenly spread."""
    return np.unique(np.linspace(0, part.sizes["model"] - 1, MOST_PANELS).round().astype(int)).tolist()


def by_family(part: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """Contact models by family, in order of stiffness."""
    contact = part["contact"].values
    names = dict.fromkeys(contact.tolist())
    return [(name, part.isel(model=np.flatnonzero(contact == name)).sortby("stiffness")) for name in names]


def make_logarithmic(axes: Axes, x: np.ndarray | None) -> None:
    """Make y logarithmic over a logarithmic x or none; with fixed limits if nothing is positive."""
    axes.set_yscale("log")
    if min(axes.get_ylim()) <= 0:
        axes.set_ylim(0.1, 10)
    if x is not None:
        axes.set_xscale("log")
        if min(axes.get_xlim()) <= 0:
            axes.set_xlim(min(x) / 1.1, max(x) * 1.1)
        ticks = np.unique(x)
        if len(ticks) <= 5 and ticks[-1] <= 30 * ticks[0]:  # few powers of ten: label the values themselves
            axes.set_xticks(ticks, [f"{each:.4g}" for each in ticks])
            axes.minorticks_off()


def legend_below(figure: Figure, columns: int) -> None:
    """Add one legend for all panels below them, where it hides nothing."""
    shown = {
        label: handle for axes in figure.axes for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    columns = max(2, min(len(shown), columns))
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=columns, frameon=False, fontsize="small")


def note(axes: Axes, x: float, text: str, **style: Any) -> None:
    """Write a label along the upper end of a vertical line."""
    axes.annotate(text, (x, 0.98), xycoords=("data", "axes fraction"), rotation=90, va="top", **style)


def positions(rows: xr.Dataset) -> np.ndarray:
    """Stiffnesses for a logarithmic axis [N/m]."""
    return np.where(rows["stiffness"].values > 0, rows["stiffness"].values, NO_CONTACT)


def families(part: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """Contact models by family, single-stiffness families grouped at the end."""
    found = by_family(part)
    lines = [(family, rows) for family, rows in found if rows.sizes["model"] > 1]
    points = [rows for _, rows in found if rows.sizes["model"] == 1]
    if points:
        lines.append(("", xr.concat(points, "model", data_vars="minimal", coords="minimal", compat="override")))
    return lines


def against_stiffness(
    part: xr.Dataset, title: str, ylabel: str, draw: Callable[[Axes, xr.Dataset, np.ndarray], None], *, log: bool = True
) -> Figure:
    """Plot one panel per contact family."""
    found = families(part)
    figure, grid = panels(1, len(found), 1.4 + 3.2 * len(found), 3.7, title, sharey=True)
    for axes, (family, rows) in zip(grid[0], found, strict=True):
        if family:
            x = positions(rows)
            axes.set(xscale="log", xlabel=SWEPT["stiffness"])
            axes.set_title(TITLES.get(family, family), fontsize="medium")
        else:
            x = np.arange(rows.sizes["model"], dtype=float)
            labels = [TITLES.get(name, name) for name in rows["contact"].values.tolist()]
            axes.set_xticks(x, labels, rotation=20, ha="right", fontsize="small")
            axes.set_xlim(-0.6, len(x) - 0.4)
        draw(axes, rows, x)
        if family:
            shade_unstable((axes,), rows, x)
        if log:
            make_logarithmic(axes, x if family else None)
    grid[0, 0].set_ylabel(ylabel)
    grid[0, 0].legend(frameon=False, fontsize="small")
    return figure


def estimators(rows: xr.Dataset) -> Iterator[tuple[xr.Dataset, dict[str, Any]]]:
    for name in rows["estimator"].values.tolist():
        label, colour, marker = style_of(name)
        style = {"label": label, "color": colour, "marker": marker, "hollow": name in HOLLOW}
        yield rows.sel(estimator=name), style


def line(axes: Axes, rows: xr.Dataset, x: np.ndarray, y, lower, upper, style: Mapping[str, Any]) -> None:
    """Draw a line with a band over stiffnesses, or points with bars over models of one stiffness."""
    if len(np.unique(rows["contact"].values)) == 1 and len(x) > 1:
        line_with_band(axes, x, y, lower, upper, **style)
        return
    bars = np.nan_to_num([y - lower, upper - y])
    axes.errorbar(
        x, y, yerr=bars, color=style["color"], marker=style["marker"], markersize=5, linestyle="none", capsize=3,
        label=style["label"],
    )  # fmt: skip


def positive(values: Any) -> np.ndarray:
    array = np.asarray(values, float)
    return np.where(np.isfinite(array) & (array > 0), array, np.nan)


def geometric(values: xr.DataArray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geometric mean over the seeds, the last dimension, with a 95 % t interval of its logarithm."""
    logs = np.log(positive(values.transpose(..., "seed")))
    count = np.sum(np.isfinite(logs), axis=1)
    usable = count > 0
    mean, half = np.full(len(logs), np.nan), np.zeros(len(logs))
    mean[usable] = np.nanmean(logs[usable], axis=1)
    several = count > 1
    half[several] = np.nanstd(logs[several], axis=1, ddof=1) / np.sqrt(count[several])
    half[several] *= scipy.special.stdtrit(count[several] - 1, 0.975)
    return np.exp(mean), np.exp(mean - half), np.exp(mean + half)


def limit(x: np.ndarray, solref: np.ndarray, first: int, timestep: float) -> float:
    """First unstable stiffness between two of a family: k grows with K, b with its square root or not at all."""
    between = np.geomspace(x[max(first - 1, 0)], x[first], 500)
    k, b = np.interp(between, x, solref[:, 0]), np.interp(np.sqrt(between), np.sqrt(x), solref[:, 1])
    unstable = (float(at) for at, *each in zip(between, k, b, strict=True) if not stable(each, timestep))
    return next(unstable, float(x[first]))


def shade_unstable(along: Sequence[Axes], rows: xr.Dataset, x: np.ndarray) -> None:
    """Shade stiffnesses at which the step gains energy while in contact."""
    if "solref" not in rows:
        return
    known = rows["solref"].transpose("model", "solref_entry").values
    timestep = float(rows["timestep"])
    steady = np.array([np.isnan(each).any() or stable(each.tolist(), timestep) for each in known])
    if steady.all() or not np.any(rows["stiffness"].values):
        return
    left = limit(x, known, int(np.argmin(steady)), timestep)
    for axes in along:
        axes.axvspan(left, x[-1] * 1.15, color="0.5", alpha=0.13, linewidth=0, zorder=0)
    note(along[0], left, "unstable step", fontsize="x-small", color="0.35")
