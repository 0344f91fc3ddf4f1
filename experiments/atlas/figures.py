"""Figures of docs/atlas.md."""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from estimators.confidence import coverage_interval
from experiments.atlas.design import LAWS
from experiments.atlas.table import GROUPS, TOLERANCE, VERDICTS, Table, bodies_meet, plain_is_off, term_acts, verdicts
from mjx_study.diagnose.advice import SMOOTH_SHARE
from mjx_study.results.findings import ERROR_PER_STRENGTH, LEAST_SPREAD, MOST_STRENGTH
from mjx_study.table import percent

COLOURS: Final = {
    "penalty": "#0072B2",
    "impedance": "#56B4E9",
    "mujoco": "#D55E00",
    "mujoco_stiff": "#E69F00",
    "smooth_onset": "#009E73",
}
OF_LAWS: Final = dict(zip(LAWS, ("#0072B2", "#E69F00", "#009E73", "#CC79A7"), strict=True))
TASKS: Final = {
    "momentum_transfer": "#0072B2",
    "ball_wall": "#E69F00",
    "pusher": "#009E73",
    "pusher_apart": "#CC79A7",
    "sliding_box": "#999999",
    "tennis": "#000000",
}
"""Colours of the tasks, in the order of panels."""
BINS: Final = 8
RATIOS: Final = (1e-7, 1e7)  # limits of ratios of variances


def binned(axes: Axes, values: Any, verdict: Any, colour: str) -> None:
    """Draw the share of a verdict in bins of equal numbers of cells, with Wilson intervals."""
    kept = np.isfinite(values) & (values > 0) & np.isfinite(verdict)
    values, verdict = values[kept], verdict[kept]
    if len(values) < 3 * BINS:
        return
    for part in np.array_split(np.argsort(values.to_numpy(), kind="stable"), BINS):
        chosen = verdict.to_numpy()[part] == 1
        middle, low, high = coverage_interval(chosen, 0.95)
        at = float(np.exp(np.mean(np.log(values.to_numpy()[part]))))
        axes.errorbar(
            at,
            middle,
            np.maximum([[middle - low], [high - middle]], 0),
            color=colour,
            marker="o",
            markersize=4,
            capsize=2,
        )


def panels(rows: int, columns: int, width: float = 3.4, height: float = 2.8) -> tuple[Figure, list[Axes]]:
    figure = Figure((width * columns, height * rows + 0.3), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def key(figure: Figure, colours: Mapping[str, str], *more: Line2D) -> None:
    """Draw a legend below the panels."""
    dots = [Line2D([], [], color=colour, marker="o", linewidth=0, label=name) for name, colour in colours.items()]
    columns = len(dots) if not more else 4
    figure.legend(handles=[*dots, *more], loc="outside lower center", ncols=columns, frameon=False)


def symbol_of(group: str) -> str:
    return GROUPS[group][0].replace("^2", "²")


def scatter(axes: Axes, table: Table, x: str, y: str, limits: tuple[float, float]) -> None:
    """Draw a point for each cell, clipped to the limits, coloured by contact family."""
    for name, part in table.groupby("contact", sort=False):
        axes.scatter(part[x], part[y].clip(*limits), s=3, color=COLOURS[name], alpha=0.5, linewidths=0)
    axes.set(xscale="log", yscale="log", xlabel=symbol_of(x), ylim=limits)


def variance_figure(table: Table) -> Figure:
    """Draw the ratio of variances against the share of the stability limit, one panel per task."""
    figure, axes = panels(2, 3)
    for each, name in zip(axes, TASKS, strict=True):
        scatter(each, table[(table.task == name) & table.ratio.notna()], "limit", "ratio", RATIOS)
        each.axhline(1, color="black", linewidth=0.6)
        each.axvline(1, color="black", linewidth=0.6, linestyle=":")
        each.set_title(name)
    key(figure, COLOURS)
    for each in axes[:: len(axes) // 2]:
        each.set_ylabel("variance, first / zeroth order")
    return figure


def bias_figure(table: Table) -> Figure:
    """Draw the decided relative bias of plain first order against four groups, and shares of cells that are off."""
    met = table[bodies_meet(table) & np.isfinite(table.fobg_off)]
    figure, axes = panels(2, 4, 3.0)
    for index, group in enumerate(("h_b", "strength", "crossing", "travel")):
        scatter(axes[index], met, group, "fobg_relative", (1e-3, 1e2))
        axes[index].axhline(TOLERANCE, color="black", linewidth=0.6)
        for name, part in met.groupby("contact", sort=False):
            binned(axes[index + 4], part[group], part.fobg_off, COLOURS[name])
        axes[index + 4].set(xscale="log", xlabel=symbol_of(group), ylim=(-0.03, 1.03))
    axes[0].set_ylabel("relative bias of first order")
    axes[4].set_ylabel(f"share off by more than {percent(TOLERANCE)}")
    key(figure, COLOURS)
    return figure


def onset_figure(table: Table) -> Figure:
    """Draw the share that the onset term leaves of what it adds, where force jumps and plain first order is off."""
    selected = table[term_acts(table)]
    figure, axes = panels(1, 3)
    for each, group in zip(axes, ("strength", "crossing", "limit"), strict=True):
        for name, part in selected.groupby("task", sort=False):
            each.scatter(part[group], part.left.clip(1e-3, 10), s=5, color=TASKS[name], alpha=0.6, linewidths=0)
        each.set(xscale="log", yscale="log", xlabel=symbol_of(group), ylim=(1e-3, 10))
    strength = np.array([SMOOTH_SHARE, MOST_STRENGTH])
    axes[0].plot(strength, ERROR_PER_STRENGTH * strength, color="black", linewidth=0.8)
    axes[1].axvline(1 / LEAST_SPREAD, color="black", linewidth=0.6, linestyle=":")
    axes[0].set_ylabel("bias left / what the term adds")
    key(
        figure,
        TASKS,
        Line2D([], [], color="black", linewidth=0.8, label="bound of findings"),
        Line2D([], [], color="black", linewidth=0.6, linestyle=":", label="narrowest noise"),
    )
    return figure


def timestep_figure(table: Table) -> Figure:
    """Draw the shares of the three verdicts by timestep, one line per task."""
    figure, axes = panels(1, 3)
    for name, cells in table.groupby("task", sort=False):
        steps = [(1e3 * timestep, verdicts(part)) for timestep, part in cells.groupby("timestep")]
        for index, each in enumerate(axes):
            decided = [(x, found[index]) for x, found in steps if len(found[index]) >= BINS]
            if not decided:
                continue
            x, middle, low, high = np.array([(x, *coverage_interval(each, 0.95)) for x, each in decided]).T
            bars = np.maximum([middle - low, high - middle], 0)
            each.errorbar(x, middle, bars, color=TASKS[name], marker="o", markersize=4, capsize=2)
    ticks = [1e3 * timestep for timestep in sorted(table.timestep.unique())]
    for each, title in zip(axes, VERDICTS, strict=True):
        each.set(xscale="log", xlabel="timestep [ms]", title=title, ylim=(-0.03, 1.03))
        each.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        each.minorticks_off()
    axes[0].set_ylabel("share of decided cells")
    key(figure, TASKS)
    return figure


def samples_figure(table: Table) -> Figure:
    """Draw first order's gain in variance times seconds, and the rollouts until its bias costs it the lead."""
    figure, axes = panels(1, 2, 4.4)
    for each, x, y, selected, limits in (
        (axes[0], "limit", "worth", table[table.worth.notna()], (1e-7, 1e7)),
        (axes[1], "strength", "until", table[plain_is_off(table)], (1e-1, 1e5)),
    ):
        for name, part in selected.groupby("task", sort=False):
            each.scatter(part[x], part[y].clip(*limits), s=3, color=TASKS[name], alpha=0.5, linewidths=0)
        each.set(xscale="log", yscale="log", xlabel=symbol_of(x), ylim=limits)
    axes[0].axhline(1, color="black", linewidth=0.6)
    axes[0].set_ylabel("variance x seconds,\nzeroth / first order")
    axes[1].set_ylabel("rollouts until\nzeroth order is ahead")
    key(figure, TASKS)
    return figure


def laws_figure(table: Table, laws: Table) -> Figure:
    """Draw the decided relative bias against the ratio of variances, one panel per task: laws over MuJoCo's default
    impedance."""
    figure, axes = panels(2, 3)
    parts = [
        (table[table.contact == "mujoco"], "#BBBBBB"),
        *((laws[laws.contact == law], OF_LAWS[law]) for law in LAWS),
    ]
    for each, name in zip(axes, TASKS, strict=True):
        for part, colour in parts:
            shown = part[bodies_meet(part) & (part.task == name) & np.isfinite(part.fobg_off)]
            x, y = shown.ratio.clip(*RATIOS), shown.fobg_relative.clip(1e-4, 1e2)
            each.scatter(x, y, s=4, color=colour, alpha=0.6, linewidths=0)
        each.axhline(TOLERANCE, color="black", linewidth=0.6)
        each.axvline(1, color="black", linewidth=0.6)
        each.set(xscale="log", yscale="log", xlim=RATIOS, ylim=(1e-4, 1e2), title=name)
        each.set_xlabel("variance, first / zeroth order")
    for each in axes[:: len(axes) // 2]:
        each.set_ylabel("relative bias of first order")
    key(figure, {"mujoco": "#BBBBBB"} | OF_LAWS)
    return figure


FIGURES: Final = {
    "variance": variance_figure,
    "bias": bias_figure,
    "onset": onset_figure,
    "timestep": timestep_figure,
    "samples": samples_figure,
}
