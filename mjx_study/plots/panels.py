"""Shared parts of study figures: panels by contact family, estimator lines, and axes whose limits follow what is finite
and stable, with marks at their edges for what cannot be drawn."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import scipy
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjx_study.plots.style import NO_CONTACT, TITLES, combines, line_with_band, style_of
from mjx_study.results.rows import estimators_of, label_in
from mjx_study.results.variables import COORDINATES
from mjx_study.results.warnings import EXPLODED
from mjx_study.simulation.contact import stable

UNSTABLE: Final = "unstable step"
MOST_PANELS: Final = 6
"""Maximum number of contact models in a figure that has a panel, a row or a column for each."""
SHIFT_RATIO: Final = 1.05
"""Ratio of the stiffnesses at which neighbouring estimators are drawn where they would hide each other."""
UNDRAWN: Final = "no finite number (below: 0)"
INSET: Final = 0.03  # distance of crosses from the edges and half of that between them, as a share of the axis
EXTRA: Final = 1e3  # maximum ratio by which an axis goes on for contact models that it does not follow
LARGEST: Final = 1e140
"""Size to which numbers are limited, and the inverse of the smallest positive one: their squares do not overflow."""


def make_panels(
    rows: int, columns: int, width: float, height: float, title: str, **shared: Any
) -> tuple[Figure, np.ndarray]:
    """Create a figure with a title over a grid of panels; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize="medium", parse_math=False)
    grid = figure.subplots(rows, columns, squeeze=False, **shared)
    for axes in grid.flat:
        axes.grid(alpha=0.25)
    return figure, grid


def a_few(part: xr.Dataset) -> list[int]:
    """Indices of at most `MOST_PANELS` contact models, evenly spread."""
    return np.unique(np.linspace(0, part.sizes["model"] - 1, MOST_PANELS).round().astype(int)).tolist()


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
            axes.set_xticks(ticks, [number(each) for each in ticks])
            axes.minorticks_off()


def number(value: Any, digits: int = 4) -> str:
    """Format a tick or a stiffness; whole numbers in groups of three."""
    return f"{value:,.0f}" if digits <= 4 and 1000 <= value < 1e6 else f"{value:.{digits}g}"


def model_title(one: xr.Dataset, between: str = ", ") -> str:
    """Name of a contact model, with its stiffness if it has one."""
    family, stiffness = str(one["contact"].item()), float(one["stiffness"])
    return TITLES.get(family, family) + (f"{between}{number(stiffness)}\N{NO-BREAK SPACE}N/m" if stiffness > 0 else "")


def families(part: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """Contact models by family, in order of stiffness; families of a single stiffness grouped at the end."""
    contact = part["contact"].values
    found = [
        (name, part.isel(model=np.flatnonzero(contact == name)).sortby("stiffness"))
        for name in dict.fromkeys(contact.tolist())
    ]
    lines = [(family, rows) for family, rows in found if rows.sizes["model"] > 1]
    points = [rows for _, rows in found if rows.sizes["model"] == 1]
    if points:
        lines.append(("", xr.concat(points, "model", data_vars="minimal", coords="minimal", compat="override")))
    return lines


def against_stiffness(
    part: xr.Dataset, title: str, ylabel: str, draw: Callable[[Axes, xr.Dataset, np.ndarray], None], *, log: bool = True
) -> Figure:
    found = families(part)
    figure, grid = make_panels(1, len(found), 1.4 + 3.2 * len(found), 3.9, title, sharey=True)
    for axes, (family, rows) in zip(grid[0], found, strict=True):
        x = stiffness_axis(axes, family, rows)
        draw(axes, rows, x)
        shade_unstable(axes, family, rows, x)
        if log:
            make_logarithmic(axes, x if family else None)
    grid[0, 0].set_ylabel(ylabel)
    return figure


def stiffness_axis(axes: Axes, family: str, rows: xr.Dataset) -> np.ndarray:
    """Make x the stiffness of a family, or its models if it is one of `families` without a name; return positions."""
    if family:
        axes.set(xscale="log", xlabel=COORDINATES["stiffness"].label)
        axes.set_title(TITLES.get(family, family), fontsize="medium")
        return np.where(rows["stiffness"].values > 0, rows["stiffness"].values, NO_CONTACT)
    x = np.arange(rows.sizes["model"], dtype=float)
    labels = [model_title(rows.isel(model=index), ",\n") for index in range(len(x))]
    turned = {"rotation": 20, "ha": "right"} if len(x) > 1 else {}
    axes.set_xticks(x, labels, **turned, fontsize="small")
    axes.set_xlim(-0.6, len(x) - 0.4)
    return x


def beside(axes: Axes, x: np.ndarray, rank: float) -> np.ndarray:
    """Move positions to the right, by so many estimators, or to the left."""
    return x * SHIFT_RATIO**rank if axes.get_xscale() == "log" else x + (SHIFT_RATIO - 1) * rank


def estimators(rows: xr.Dataset) -> Iterator[tuple[xr.Dataset, dict[str, Any]]]:
    described = estimators_of(rows)
    for rank, name in enumerate(rows["estimator"].values.tolist()):
        _, colour, marker = style_of(name)
        hollow = combines(name, described)
        style = {"label": label_in(rows, name), "color": colour, "marker": marker, "hollow": hollow, "rank": rank}
        yield rows.sel(estimator=name), style


def line(axes: Axes, rows: xr.Dataset, x: np.ndarray, y, lower, upper, style: Mapping[str, Any]) -> None:
    """Draw a line with a band over stiffnesses, or points with bars over models of one stiffness."""
    line_with_band(axes, x, y, lower, upper, **style, joined=len(np.unique(rows["contact"].values)) == 1)


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


def unstable(rows: xr.Dataset) -> np.ndarray:
    """Mask of contact models with which the step gains energy while in contact."""
    if "solref" not in rows:
        return np.zeros(rows.sizes["model"], bool)
    known, timestep = rows["solref"].transpose("model", "solref_entry").values.tolist(), float(rows["timestep"])
    return np.array([not np.isnan(each).any() and not stable(each, timestep) for each in known])


def shade_unstable(axes: Axes, family: str, rows: xr.Dataset, x: np.ndarray) -> None:
    """Shade where the step is unstable: stiffnesses of a family from the limit on, or single models."""
    mask = unstable(rows)
    spans = [(each - 0.5, each + 0.5) for each in x[mask]]
    if family and mask.any():
        solref = rows["solref"].transpose("model", "solref_entry").values
        spans = [(limit(x, solref, int(np.argmax(mask)), float(rows["timestep"])), x[-1] * 1.15)]
    for left, right in spans:
        axes.axvspan(left, right, color="0.5", alpha=0.13, linewidth=0, zorder=0, label=UNSTABLE)


def drawable(values: xr.DataArray) -> xr.DataArray:
    """Numbers that figures can compute with; infinite ones become NaN."""
    if values.dtype.kind != "f":
        return values
    size = abs(values)
    limited = xr.where(size > 0, np.sign(values) * size.clip(1 / LARGEST, LARGEST), values)
    return limited.where(np.isfinite(values)).astype(values.dtype).transpose(*values.dims)


def sane(rows: xr.Dataset, names: Sequence[str]) -> np.ndarray:
    """Mask of the contact models that axes follow: the step is stable, and no value is missing or huge."""
    fit = ~unstable(rows)
    for each in (rows[name] for name in names if name in rows):
        finite = abs(each) < EXPLODED  # and not NaN
        fit &= np.asarray(finite.all([name for name in each.dims if name != "model"]))
    return fit


def limits(part: xr.Dataset, names: Sequence[str], room: float) -> tuple[float, float] | None:
    """Ends of a logarithmic axis for variables: those of sane contact models times `room` to each side, and up to
    `EXTRA` for the others; without sane ones the smallest values up to `EXTRA`. None without positive values."""

    def known(mask: np.ndarray) -> np.ndarray:
        some = part.isel(model=np.flatnonzero(mask))
        values = np.concatenate([positive(some[name]).ravel() for name in names if name in some])
        return values[np.isfinite(values)]

    every = known(np.ones(part.sizes["model"], bool))
    if not len(every):
        return None
    followed = known(sane(part, names))
    low, high = (followed.min(), followed.max()) if len(followed) else (every.min(), every.min())
    every = every[(every >= low / EXTRA) & (every <= high * EXTRA)]
    return float(every.min()) / room, float(every.max()) * room


def mark_undrawn(axes: Axes, x: np.ndarray, values: np.ndarray, style: Mapping[str, Any]) -> None:
    """Mark values that a logarithmic axis cannot show with crosses at its edges: nonfinite ones above, zeros below."""
    values, inset = np.asarray(values, float), INSET * (1 + 2 * style["rank"])
    for missing, at in ((~np.isfinite(values), 1 - inset), (values <= 0, inset)):
        if missing.any():
            axes.plot(
                x[missing], np.full(np.count_nonzero(missing), at), "x", color=style["color"], markersize=5,
                transform=axes.get_xaxis_transform(), label=UNDRAWN,
            )  # fmt: skip
