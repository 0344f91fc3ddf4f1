"""Figures of a study from its labelled arrays alone."""

import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from scipy import stats

from mjx_study.choices import DEFAULT_SOLREF
from mjx_study.plots.style import (
    HOLLOW,
    NO_CONTACT,
    STYLE,
    TITLES,
    line_with_band,
    mean_with_band,
    robust_limits,
    style_of,
)
from mjx_study.simulation.contact import stable
from mjx_study.table import digits_to_tell_apart

SWEPT: Final = {
    "stiffness": "contact stiffness K [N/m]",
    "timestep": "timestep h [s]",
    "sigma": "noise sigma",
    "samples": "samples N in a batch",
}
"""Dimensions that can be the axis of a figure, with their labels."""
MOST_FIGURES: Final = 12
"""Most figures of one kind; a study with more tasks, timesteps and noises is cut off there."""
MOST_PANELS: Final = 6
MOST_DECADES: Final = 1e7
"""Ratio of the ends of an axis of costs; beyond it a descent counts as diverged."""


def plot_study(dataset: xr.Dataset) -> dict[str, Figure]:
    """Every figure that a study has the numbers for, by file name without its ending."""
    figures: dict[str, Figure] = {}
    if not dataset.data_vars:
        return figures
    quantity = _quantity(dataset)
    kinds: dict[str, Callable[[xr.Dataset, str], Figure | None]] = {
        "final_cost": {"achieved": _achieved, "descent": _descent},
        "variance": {"variance": _variance, "bias": _bias, "alpha": _alpha}
        if dataset.sizes.get("seed", 1) > 1
        else {"comparison": _comparison},
        "smoothed": {"landscape": _landscape},
    }[quantity]
    for kind, draw in kinds.items():
        for suffix, title, part in itertools.islice(_slices(dataset), MOST_FIGURES):
            figure = draw(part, title)
            if figure is not None:
                figures[kind + suffix] = figure
    if quantity == "variance" and dataset.sizes["samples"] > 1:
        for suffix, title, part in itertools.islice(_slices(dataset, keep="samples"), MOST_FIGURES):
            figures["error_against_samples" + suffix] = _error_against_samples(part, title)
    if quantity == "smoothed":
        return figures
    pair = [name for name in SWEPT if _length(dataset, name) > 1][:2]
    if len(pair) == 2 and {"zobg", "fobg"} <= set(dataset["estimator"].values.tolist()):
        for suffix, title, part in itertools.islice(_slices(dataset, keep=pair[1]), MOST_FIGURES):
            figures[f"map_{pair[0]}_{pair[1]}{suffix}"] = _ratio_map(part, title, quantity, pair[1])
    return figures


def _quantity(dataset: xr.Dataset) -> str:
    """The variable that tells what kind of study it is."""
    return next(name for name in ("final_cost", "smoothed", "variance") if name in dataset)


def _length(dataset: xr.Dataset, name: str) -> int:
    return len(np.unique(dataset[name].values))


def _slices(dataset: xr.Dataset, keep: str = "") -> Iterator[tuple[str, str, xr.Dataset]]:
    """Parts with one value along every dimension but the contact model's, `keep`'s, and those within a cell.

    Gives a suffix for file names, a title, and the part; of several sample counts, the largest unless kept.
    """
    names = [name for name in ("task", "timestep", "cone", "sigma", "samples") if name != keep]
    choices = [range(dataset.sizes[name]) if name != "samples" else [dataset.sizes[name] - 1] for name in names]
    varied = [name for name in names if dataset.sizes[name] > 1 and name != "samples"]
    texts = {name: _texts(dataset[name].values) for name in names}
    taken: set[str] = set()
    for picked in itertools.product(*choices):
        part = dataset.isel(dict(zip(names, picked, strict=True)))
        part = part.isel(model=np.flatnonzero(_present(part)))
        if part.sizes["model"] == 0:
            continue
        values = {name: texts[name][index] for name, index in zip(names, picked, strict=True)}
        suffix = "".join(f"_{_for_file(values[name])}" for name in varied)
        suffix += f"_{len(taken)}" if suffix in taken else ""
        taken.add(suffix)
        told = [values["task"]] + [
            f"{label} = {values[name]}{unit}"
            for name, label, unit in (("timestep", "h", " s"), ("sigma", "sigma", ""), ("samples", "N", ""))
            if name in values
        ]
        told += [f"{values['cone']} cone"] if "cone" in varied else []
        yield suffix, ", ".join(told), part


def _texts(values: np.ndarray) -> list[str]:
    """Names as they are, numbers in as many digits as tell them apart."""
    if values.dtype.kind not in "iuf":
        return [str(value) for value in values]
    digits = digits_to_tell_apart(values.tolist())
    return [f"{value:.{digits}g}" for value in values.tolist()]


def _for_file(text: str) -> str:
    """Part of a file's name from what a study.json says, which may come from anywhere."""
    return re.sub(r"[^\w.+-]", "-", text)[:60]


def _ticks(values: np.ndarray) -> list[str]:
    """Values in three digits, or in as many as tell them apart."""
    digits = digits_to_tell_apart(values.tolist(), least=3)
    whole = digits == 3
    return [f"{value:.0f}" if whole and 100 <= value < 1e6 else f"{value:.{digits}g}" for value in values.tolist()]


def _present(part: xr.Dataset) -> np.ndarray:
    """Which contact models have numbers."""
    quantity = part[_quantity(part)]
    return np.asarray(quantity.notnull().any([name for name in quantity.dims if name != "model"]))


def _families(part: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """Contact models by family, those of one stiffness together at the end."""
    contact = part["contact"].values
    found = [(family, part.isel(model=np.flatnonzero(contact == family))) for family in dict.fromkeys(contact.tolist())]
    lines = [(family, rows.sortby("stiffness")) for family, rows in found if rows.sizes["model"] > 1]
    points = [rows for _, rows in found if rows.sizes["model"] == 1]
    if points:
        lines.append(("", xr.concat(points, "model", data_vars="minimal", coords="minimal", compat="override")))
    return lines


def _against_stiffness(
    part: xr.Dataset,
    title: str,
    ylabel: str,
    draw: Callable[[Axes, xr.Dataset, np.ndarray], None],
    *,
    log: bool = True,
) -> Figure:
    """A panel for each contact family."""
    families = _families(part)
    figure = Figure(figsize=(1.4 + 3.2 * len(families), 3.7), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(families), sharey=True, squeeze=False)[0]
    for axes, (family, rows) in zip(panels, families, strict=True):
        if family:
            x = np.where(rows["stiffness"].values > 0, rows["stiffness"].values, NO_CONTACT)
            axes.set_xscale("log")
            axes.set_xlabel(SWEPT["stiffness"])
            axes.set_title(TITLES.get(family, family), fontsize="medium")
        else:
            x = np.arange(rows.sizes["model"], dtype=float)
            labels = [TITLES.get(name, name) for name in rows["contact"].values.tolist()]
            axes.set_xticks(x, labels, rotation=20, ha="right", fontsize="small")
            axes.set_xlim(-0.6, len(x) - 0.4)
        draw(axes, rows, x)
        if family:
            _shade_unstable((axes,), rows, x)
        if log:
            axes.set_yscale("log")
        axes.grid(alpha=0.25)
    panels[0].set_ylabel(ylabel)
    panels[0].legend(frameon=False, fontsize="small")
    figure.suptitle(title, fontsize="medium")
    return figure


def _estimators(rows: xr.Dataset) -> Iterator[tuple[xr.Dataset, dict[str, Any]]]:
    for name in rows["estimator"].values.tolist():
        label, colour, marker = style_of(name)
        style = {"label": label, "color": colour, "marker": marker, "hollow": name in HOLLOW}
        yield rows.sel(estimator=name), style


def _line(axes: Axes, rows: xr.Dataset, x: np.ndarray, y, lower, upper, style: Mapping[str, Any]) -> None:
    """A line with its band over stiffnesses; points with bars over contact models of one stiffness."""
    if len(np.unique(rows["contact"].values)) == 1 and len(x) > 1:
        line_with_band(axes, x, y, lower, upper, **style)
        return
    bars = np.nan_to_num([y - lower, upper - y])
    axes.errorbar(
        x, y, yerr=bars, color=style["color"], marker=style["marker"], markersize=5, linestyle="none", capsize=3,
        label=style["label"],
    )  # fmt: skip


def _positive(values: Any) -> np.ndarray:
    array = np.asarray(values, float)
    return np.where(np.isfinite(array) & (array > 0), array, np.nan)


def _geometric(values: xr.DataArray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Geometric mean over the seeds, the last dimension, with a 95 % t interval of its logarithm."""
    logs = np.log(_positive(values.transpose(..., "seed")))
    count = np.sum(np.isfinite(logs), axis=1)
    usable = count > 0
    mean, half = np.full(len(logs), np.nan), np.zeros(len(logs))
    mean[usable] = np.nanmean(logs[usable], axis=1)
    several = count > 1
    half[several] = np.nanstd(logs[several], axis=1, ddof=1) / np.sqrt(count[several])
    half[several] *= stats.t.ppf(0.975, count[several] - 1)
    return np.exp(mean), np.exp(mean - half), np.exp(mean + half)


def _comparison(part: xr.Dataset, title: str) -> Figure:
    """Variance above, relative error below, with intervals of one batch; a column for each contact family."""
    families = [(family, part.isel(model=np.flatnonzero(part["contact"].values == family)).sortby("stiffness"))
                for family in dict.fromkeys(part["contact"].values.tolist())]  # fmt: skip
    figure = Figure(figsize=(1.2 + 3.4 * len(families), 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(families), sharex="col", sharey="row", squeeze=False)
    for (above, below), (family, rows) in zip(axes.T, families, strict=True):
        x = np.where(rows["stiffness"].values > 0, rows["stiffness"].values, NO_CONTACT)
        for mine, style in _estimators(rows.isel(seed=0)):
            line_with_band(above, x, *(_positive(mine["variance" + end]) for end in ("", "_lower", "_upper")), **style)
            y, error = _positive(mine["relative_error"]), np.asarray(mine["relative_error_se"], float)
            lower, upper = _positive(np.maximum(y - 1.96 * error, y / 10)), _positive(y + 1.96 * error)
            line_with_band(below, x, y, lower, upper, **{**style, "label": None})
        floor = _positive(rows["reference_uncertainty"])
        below.plot(x, floor, color="0.4", linestyle=":", marker="_", label="uncertainty of the reference")
        below.axhline(1, color="0.7", linewidth=0.8)
        for panel in (above, below):
            panel.set(xscale="log", yscale="log")
            panel.grid(alpha=0.25)
        above.set_title(TITLES.get(family, family))
        below.set_xlabel(SWEPT["stiffness"])
        if not np.any(rows["stiffness"].values):
            below.set_xlabel("")
            below.set_xticks([NO_CONTACT], ["no contact"])
            below.set_xticks([], minor=True)
        _mark_default(above, family, rows)
        _shade_unstable((above, below), rows, x)
    samples, config = int(part["samples"]), json.loads(part.attrs["config"])
    known = _positive(part["variance"].isel(seed=0))
    if np.any(np.isfinite(known)):  # of the variances: an interval may span thirty decades
        axes[0, 0].set_ylim(np.nanmin(known) / 100, np.nanmax(known) * 100)
    axes[0, 0].set_ylabel("variance of one sample")
    axes[1, 0].set_ylabel(f"relative error of the mean\nof {samples} samples")
    axes[0, 0].legend(frameon=False)
    axes[1, 0].legend(frameon=False)
    percent = f"{100 * config['confidence']:.0f} %"
    figure.suptitle(f"{title}\ngradient estimates (bands: {percent} intervals)", fontsize="medium")
    return figure


def _shade_unstable(panels: Sequence[Axes], rows: xr.Dataset, x: np.ndarray) -> None:
    """Stiffnesses at which the step gains energy while in contact."""
    if "solref" not in rows:
        return
    known = rows["solref"].transpose("model", "solref_entry").values
    steady = np.array([np.isnan(each).any() or stable(each.tolist(), float(rows["timestep"])) for each in known])
    if steady.all() or not np.any(rows["stiffness"].values):
        return
    first = int(np.argmin(steady))
    left = x[first] if first == 0 else float(np.sqrt(x[first - 1] * x[first]))
    for axes in panels:
        axes.axvspan(left, x[-1] * 1.15, color="0.5", alpha=0.13, linewidth=0, zorder=0)
    panels[0].annotate(
        "unstable step",
        (left, 0.98),
        xycoords=("data", "axes fraction"),
        rotation=90,
        va="top",
        fontsize="x-small",
        color="0.35",
    )


def _mark_default(axes: Axes, family: str, rows: xr.Dataset) -> None:
    """Mark the stiffness of MuJoCo's default time constant among those of its own family."""
    if family != "mujoco" or "solref" not in rows:
        return
    mass = float(rows["stiffness"][0]) / -float(rows["solref"].isel(model=0, solref_entry=0))
    axes.axvline(mass / (DEFAULT_SOLREF[0] * DEFAULT_SOLREF[1]) ** 2, color="0.4", linestyle="--", linewidth=0.8)
    axes.annotate(
        "default solref",
        (mass / (DEFAULT_SOLREF[0] * DEFAULT_SOLREF[1]) ** 2, 0.98),
        xycoords=("data", "axes fraction"),
        rotation=90,
        ha="right",
        va="top",
        fontsize="small",
        color="0.3",
    )


def _variance(part: xr.Dataset, title: str) -> Figure:
    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in _estimators(rows):
            _line(axes, mine, x, *_geometric(mine["variance"]), style)

    seeds = part.sizes["seed"]
    return _against_stiffness(
        part, f"{title}\nvariance ({seeds} seeds, 95 % intervals)", "variance of one gradient sample", draw
    )


def _bias(part: xr.Dataset, title: str) -> Figure | None:
    if not bool(part["squared_bias"].notnull().any()):
        return None  # with fewer than three seeds there is no estimate of it

    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in _estimators(rows):
            square, error = (np.asarray(mine[name], float) for name in ("squared_bias", "squared_bias_se"))
            low, high = (_positive(square + sign * 1.96 * error) ** 0.5 for sign in (-1, 1))
            seen = np.isfinite(low)
            y = np.where(seen, _positive(square) ** 0.5, np.nan)
            bars = np.nan_to_num([y - low, high - y])
            joined = "-" if len(x) > 2 and len(np.unique(rows["contact"].values)) == 1 else "none"
            shown = {name: style[name] for name in ("label", "color", "marker")}
            shown |= {"markerfacecolor": "none", "markersize": 7.5} if style["hollow"] else {"markersize": 4.5}
            axes.errorbar(x, y, yerr=bars, **shown, capsize=2.5, linestyle=joined)
            axes.plot(x[~seen], high[~seen], color=style["color"], marker="v", linestyle="none", alpha=0.45)
        axes.plot([], [], color="0.5", marker="v", linestyle="none", alpha=0.6, label="no bias seen: upper bound")
        axes.axhline(1, color="0.7", linewidth=0.8)

    pooled = part.sizes["seed"] * int(part["samples"])
    return _against_stiffness(
        part,
        f"{title}\nbias, from {pooled} samples and a zeroth-order reference (95 % intervals)",
        "bias over the gradient's norm",
        draw,
    )


def _alpha(part: xr.Dataset, title: str) -> Figure | None:
    weighed = part.isel(estimator=np.flatnonzero(part["alpha"].notnull().any(["model", "seed"])))
    if weighed.sizes["estimator"] == 0:
        return None

    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in _estimators(rows):
            values = mine["alpha"].transpose("model", "seed").values
            _line(axes, mine, x, np.nanmean(values, 1), np.nanmin(values, 1), np.nanmax(values, 1), style)
        axes.set_ylim(-0.03, 1.03)

    return _against_stiffness(
        weighed, f"{title}\nweight of first-order gradients (mean and range of the seeds)", "alpha", draw, log=False
    )


def _error_against_samples(part: xr.Dataset, title: str) -> Figure:
    """A panel for each contact family, at the middle one of its stiffnesses."""
    chosen = [rows.isel(model=[rows.sizes["model"] // 2]) for family, rows in _families(part) if family]
    chosen += [rows.isel(model=[index]) for family, rows in _families(part) if not family
               for index in range(rows.sizes["model"])]  # fmt: skip
    chosen = chosen[:MOST_PANELS]
    figure = Figure(figsize=(1.4 + 3.2 * len(chosen), 3.7), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(chosen), sharey=True, squeeze=False)[0]
    for axes, rows in zip(panels, chosen, strict=True):
        x = rows["samples"].values
        for mine, style in _estimators(rows):
            line_with_band(axes, x, *_geometric(mine["relative_error"].isel(model=0)), **style)
        axes.plot(x, np.full(len(x), float(rows["reference_uncertainty"].mean())), color="0.4", linestyle=":")
        axes.set(xscale="log", yscale="log", xlabel=SWEPT["samples"])
        axes.set_title(str(rows["model"].item()), fontsize="medium")
        axes.grid(alpha=0.25)
    panels[0].set_ylabel("relative error of the mean")
    panels[0].legend(frameon=False, fontsize="small")
    figure.suptitle(f"{title}\nerror (95 % intervals over the seeds; dotted: of the reference)", fontsize="medium")
    return figure


def _ratio_map(part: xr.Dataset, title: str, quantity: str, other: str) -> Figure:
    """log10 of FoBG over ZoBG over two swept parameters, a panel for each contact family; blue where FoBG is less."""
    families = [(family, rows) for family, rows in _families(part) if family] or _families(part)
    figure = Figure(figsize=(1.8 + 3.2 * len(families), 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(families), sharey=True, squeeze=False)[0]
    ratios = []
    for _, rows in families:
        values = rows[quantity].median("seed")
        ratio = np.log10(_positive(values.sel(estimator="fobg")) / _positive(values.sel(estimator="zobg")))
        ratios.append(ratio if values.sel(estimator="fobg").dims[0] == other else ratio.T)
    extent = max(1e-3, float(np.nanmax(np.abs(np.concatenate([ratio.ravel() for ratio in ratios])))))
    mesh = None
    for axes, (family, rows), ratio in zip(panels, families, ratios, strict=True):
        mesh = axes.pcolormesh(
            np.arange(ratio.shape[1] + 1), np.arange(ratio.shape[0] + 1), ratio,
            cmap="RdBu_r", norm=TwoSlopeNorm(0, -min(extent, 6), min(extent, 6)),
        )  # fmt: skip
        stiffness = _ticks(rows["stiffness"].values)
        axes.set_xticks(np.arange(len(stiffness)) + 0.5, stiffness, rotation=60, ha="right", fontsize="small")
        labels = _ticks(rows[other].values)
        axes.set_yticks(np.arange(len(labels)) + 0.5, labels, fontsize="small")
        axes.set_xlabel(SWEPT["stiffness"])
        axes.set_title(TITLES.get(family, family), fontsize="medium")
    panels[0].set_ylabel(SWEPT[other])
    assert mesh is not None
    figure.colorbar(mesh, ax=list(panels), label=f"log10 of {quantity.replace('_', ' ')}, FoBG over ZoBG")
    figure.suptitle(f"{title}\nwhere first order is ahead (blue) and behind (red)", fontsize="medium")
    return figure


def _achieved(part: xr.Dataset, title: str) -> Figure | None:
    """Cost of the final policies above the best one at each contact model; what is far off is at the upper edge."""
    if part.sizes["model"] < 2:
        return None  # the table says it
    best = part["final_cost"].min(["seed", "estimator"])
    excess = part["final_cost"] - best
    middle = excess.median("seed").values
    positive = middle[np.isfinite(middle) & (middle > 0)]
    floor = float(np.min(positive)) / 3 if len(positive) else 1e-3
    ceiling = MOST_DECADES * floor

    def draw(axes: Axes, rows: xr.Dataset, x: np.ndarray) -> None:
        for mine, style in _estimators(rows):
            above = (mine["final_cost"] - best.sel(model=mine["model"])).transpose("model", "seed").values
            lost = ~np.isfinite(above).any(axis=1) | ~(np.nanmedian(np.nan_to_num(above, nan=np.inf), axis=1) < ceiling)
            above = np.clip(np.nan_to_num(above, nan=ceiling), floor, ceiling)
            middle = np.where(lost, np.nan, np.median(above, axis=1))
            _line(axes, mine, x, middle, middle, middle, style)
            seeds = np.where((above > floor) & (above < ceiling), above, np.nan)
            axes.plot(x, seeds, color=style["color"], marker=".", markersize=4, linestyle="none", alpha=0.6)
            axes.plot(x[lost], np.full(lost.sum(), ceiling / 2), color=style["color"], marker="^", linestyle="none")
        axes.plot([], [], color="0.4", marker="^", linestyle="none", label="beyond the axis")
        axes.set_ylim(floor / 1.5, ceiling)

    iterations, seeds = part.sizes["iteration"], part.sizes["seed"]
    return _against_stiffness(
        part,
        f"{title}\ncost after {iterations} iterations ({seeds} seeds as dots, and their median)",
        "cost above the best policy found\nat that contact model",
        draw,
    )


def _descent(part: xr.Dataset, title: str) -> Figure:
    """Cost against iterations, rollouts and seconds, and alpha; a row for each of a few contact models."""
    models = np.unique(np.linspace(0, part.sizes["model"] - 1, MOST_PANELS).round().astype(int))
    columns = 4 if bool(part["alpha"].notnull().any()) else 3
    figure = Figure(figsize=(0.6 + 3.4 * columns, 1.3 + 2.5 * len(models)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(models), columns, squeeze=False)
    for row, model in zip(grid, models, strict=True):
        one = part.isel(model=model)
        curves = []
        for mine, style in _estimators(one):
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
                middle, low, high = (reduce(weight[known], 1) for reduce in (np.nanmedian, np.nanmin, np.nanmax))
                row[3].plot(iteration[known], middle, color=style["color"], linewidth=1.4)
                row[3].fill_between(iteration[known], low, high, color=style["color"], alpha=0.15, lw=0)
            for axes, x in zip(row[:3], xs, strict=True):
                axes.plot(x, np.nanmedian(cost, 1), color=style["color"], label=style["label"], linewidth=1.4)
                axes.fill_between(x, np.nanmin(cost, 1), np.nanmax(cost, 1), color=style["color"], alpha=0.15, lw=0)
        for axes in row:
            axes.grid(alpha=0.25)
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
    figure.suptitle(f"{title} ({part.sizes['seed']} seeds: median, from least to greatest)", fontsize="medium")
    return figure


def _descent_limits(curves: list[np.ndarray], start: float) -> tuple[float, float]:
    """Limits within which a descent goes down; one that blows up leaves them at the top."""
    low, high = robust_limits(curves)
    room = start - low
    return (low, min(high, start + 2 * room)) if room > 0 else (low, high)


def _landscape(part: xr.Dataset, title: str) -> Figure:
    """Cost and mean cost along the line above, the slope that each estimator sees below; a column for a few models."""
    models = np.unique(np.linspace(0, part.sizes["model"] - 1, MOST_PANELS).round().astype(int))
    figure = Figure(figsize=(1.6 + 2.9 * len(models), 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(2, len(models), sharex=True, sharey="row", squeeze=False)
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
            dotted = {"linestyle": ":", "linewidth": 1.2}
            below.plot(t, one["exact_slope"], color="black", **dotted, label="slope of the mean cost, quadrature")
            first = STYLE["fobg"][0]
            below.plot(t, one["exact_first"], color=first, **dotted, label="mean of FoBG, quadrature")
        for mine, style in _estimators(one):
            slopes.append(mine["slope"].values)
            mean, error = mine["slope"].values, mine["slope_se"].values
            mean_with_band(below, t, mean, error, style["color"], f"mean of {style['label']}")
        family, stiffness = one["contact"].item(), float(one["stiffness"])
        spring = f"\nK = {stiffness:g} N/m" if stiffness else ""
        above.set_title(f"{TITLES.get(family, family)}{spring}", fontsize="medium")
        below.axhline(0, color="0.7", linewidth=0.8)
        below.set_xlabel(along)
        for axes in (above, below):
            axes.grid(alpha=0.25)
    low, high = robust_limits(slopes)  # and a slope that is wild beside that of the mean cost leaves the axes
    if steepest > 0:
        low, high = max(low, -10 * steepest), min(high, 10 * steepest)
    grid[1, 0].set_ylim(low, high)
    grid[0, 0].set_ylabel("cost")
    grid[1, 0].set_ylabel("slope along the line")
    legend: dict[str, Any] = {}
    for axes in grid.flat:
        found, labels = axes.get_legend_handles_labels()
        legend |= dict(zip(labels, found, strict=True))
    columns = max(2, min(len(legend), 2 * len(models)))
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=columns, frameon=False, fontsize="small")
    figure.suptitle(f"{title} at each point (bands: 95 %)", fontsize="medium")
    return figure
