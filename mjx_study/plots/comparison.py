"""Figures from results; nothing here simulates."""

import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from estimators import ESTIMATORS
from mjx_study.disk import write_whole
from mjx_study.simulation.contact import DEFAULT_SOLREF, FAMILIES
from mjx_study.study.comparison import CompareResult, Row
from mjx_study.study.descents import OptimiseResult, Run
from mjx_study.study.landscapes import Curve, Landscape

# Okabe and Ito's colours, told apart in print and by colour-blind eyes; markers repeat the distinction.
STYLE: Final = {
    "zobg": ("#0072B2", "o"),
    "zobg_antithetic": ("#56B4E9", "v"),
    "zobg_to_go": ("#56B4E9", "P"),
    "zobg_to_go_antithetic": ("#0072B2", "X"),
    "fobg": ("#D55E00", "s"),
    "fobg_clipped": ("#E69F00", "<"),
    "fobg_truncated": ("#E69F00", ">"),
    "aobg": ("#009E73", "D"),
    "ivw": ("#CC79A7", "^"),
    "ivw_h": ("#CC79A7", "p"),
    "total_propagation": ("#000000", "*"),
    "ddcg": ("#009E73", "h"),
    "delta": ("#777777", "d"),
}
OTHERS: Final = (("#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7"), "1234+x|_")
"""Colours and markers of estimators of one's own."""
NO_CONTACT: Final = 1.0
"""Place on a stiffness axis of a task without contact."""
TITLES: Final = {
    "penalty": "penalty (impedance 1e-4)",
    "impedance": "impedance 0.5",
    "mujoco": "MuJoCo, default impedance",
    "mujoco_stiff": "MuJoCo, impedance 0.99 to 0.9999",
    "smooth_onset": "smooth onset",
    "mujoco_default": "MuJoCo default",
    "mjcf": "as in the MJCF",
}
assert set(TITLES) >= set(FAMILIES)


def style_of(name: str) -> tuple[str, str, str]:
    """Label, colour and marker of an estimator; those of one's own depend on the name alone."""
    label = (ESTIMATORS[name].label if name in ESTIMATORS else "") or name.rpartition(":")[2]
    colours, markers = OTHERS
    drawn = zlib.crc32(name.encode())
    return label, *STYLE.get(name, (colours[drawn % len(colours)], markers[drawn // 7 % len(markers)]))


def plot_comparison(result: CompareResult) -> Figure:
    """Variance and relative error against stiffness: a column for each contact family, a line for each estimator."""
    families = result.families
    figure = Figure(figsize=(1.2 + 3.4 * len(families), 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(families), sharex=True, sharey="row", squeeze=False)
    for column, family in zip(axes.T, families, strict=True):
        rows = [row for row in result.rows if row.contact == family]
        _variance_panel(column[0], rows, result.config.estimators)
        _error_panel(column[1], rows, result.config.estimators)
        column[0].set_title(TITLES[family])
        column[1].set_xlabel("contact stiffness K [N/m]")
        if not any(row.stiffness for row in rows):
            column[1].set_xlabel("")
            column[1].set_xticks([NO_CONTACT], ["no contact"])
            column[1].set_xticks([], minor=True)
        _mark_default(column[0], family, rows)
    axes[0, 0].set_ylabel("variance of one sample")
    axes[1, 0].set_ylabel(f"relative error of the mean\nof {result.config.samples} samples")
    axes[0, 0].legend(frameon=False)
    axes[1, 0].legend(frameon=False)
    percent = f"{100 * result.config.confidence:.0f} %"
    figure.suptitle(
        f"{result.config.task}: gradient estimates against contact stiffness "
        f"(sigma = {result.config.sigma:g}, {result.config.horizon} steps; bands: {percent} intervals)",
        fontsize="medium",
    )
    return figure


def plot_landscape(result: Landscape) -> Figure:
    """Cost and smoothed cost above, the slopes that ZoBG and FoBG see below; a column for each contact model."""
    figure = Figure(figsize=(1.2 + 2.9 * len(result.curves), 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(result.curves), sharex=True, sharey="row", squeeze=False)
    t = result.position
    for (above, below), curve in zip(axes.T, result.curves, strict=True):
        above.plot(t, curve.cost, color="0.55", linewidth=1.2, label="cost without noise")
        mean_with_band(above, t, curve.smoothed, curve.smoothed_se, "black", "mean cost with noise")
        for name, mean, error in (
            ("zobg", curve.zeroth, curve.zeroth_se),
            ("fobg", curve.first, curve.first_se),
        ):
            label, colour, _ = style_of(name)
            mean_with_band(below, t, mean, error, colour, f"mean of {label}")
        if curve.exact is not None:
            style = {"color": "black", "linestyle": ":", "linewidth": 1.2}
            below.plot(t, curve.exact.slope, **style, label="slope of the mean cost, quadrature")
            below.plot(t, curve.exact.first, **style | {"color": STYLE["fobg"][0]}, label="mean of FoBG, quadrature")
        above.set_title(_curve_title(curve), fontsize="medium")
        below.axhline(0, color="0.7", linewidth=0.8)
        below.set_xlabel("theta" if len(result.direction) == 1 else f"t along direction {result.config.direction}")
        for panel in (above, below):
            panel.grid(alpha=0.25)
    low, high = robust_limits([array for curve in result.curves for array in (curve.zeroth, curve.first)])
    axes[1, 0].set_ylim(low, high)
    axes[0, 0].set_ylabel("cost")
    axes[1, 0].set_ylabel("slope")
    legend: dict[str, Any] = {}
    for axis in axes.flat:
        handles, labels = axis.get_legend_handles_labels()
        legend |= dict(zip(labels, handles, strict=True))
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=3, frameon=False, fontsize="small")
    config = result.config
    figure.suptitle(
        f"{config.task}: sigma = {config.sigma:g}, {config.samples} samples at each point (bands: 95 %)",
        fontsize="medium",
    )
    return figure


def plot_optimisation(result: OptimiseResult) -> Figure:
    """Cost against iterations, rollouts and seconds, and alpha: a line for each estimator, a band over its seeds."""
    weighed = [run for run in result.runs if np.any(np.isfinite(run.history["alpha"]))]
    figure = Figure(figsize=(3.4 * (4 if weighed else 3) + 0.6, 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 4 if weighed else 3)
    for run in result.runs:
        iterations = np.arange(1, len(run.seconds) + 1)
        for panel, x in zip(axes, (iterations, run.rollouts * iterations, run.seconds), strict=False):
            _seeds(panel, x, run.history["cost"], run)
    for panel, label in zip(axes, ("iteration", "rollouts of one seed", "seconds, all seeds"), strict=False):
        panel.set_xlabel(label)
        panel.grid(alpha=0.25)
        values = np.concatenate([run.history["cost"].ravel() for run in result.runs])
        low, high = robust_limits([values])
        panel.set_ylim(low, high)
    axes[0].set_ylabel("mean cost of the batch")
    if weighed:
        for run in weighed:
            _seeds(axes[3], np.arange(1, len(run.seconds) + 1), run.history["alpha"], run)
        axes[3].set_xlabel("iteration")
        axes[3].set_ylabel("alpha, weight of first-order gradients")
        axes[3].set_ylim(-0.03, 1.03)
        axes[3].grid(alpha=0.25)
    axes[0].legend(frameon=False, fontsize="small")
    config = result.config
    where = "analytic reference" if config.reference else TITLES[config.contact or "mjcf"]
    stiffness = f", K = {config.stiffness:g} N/m" if config.stiffness and not config.reference else ""
    figure.suptitle(
        f"{config.task}: {where}{stiffness}; {config.optimizer}, {config.samples} samples "
        f"({config.seeds} seeds: median, and from least to greatest)",
        fontsize="medium",
    )
    return figure


def _seeds(axes: Axes, x: np.ndarray, values: np.ndarray, run: Run) -> None:
    """Median over the seeds that go on, and their range."""
    label, colour, _ = style_of(run.estimator)
    going = np.any(np.isfinite(values), axis=1)
    x, values = x[going], values[going]
    if len(x):
        axes.plot(x, np.nanmedian(values, axis=1), color=colour, linewidth=1.4, label=label)
        axes.fill_between(
            x, np.nanmin(values, axis=1), np.nanmax(values, axis=1), color=colour, alpha=0.15, linewidth=0
        )


def _curve_title(curve: Curve) -> str:
    if curve.family == "reference":
        return "analytic reference\n(of penalty contact)"
    return f"{TITLES[curve.family]}\nK = {curve.stiffness:g} N/m" if curve.stiffness else TITLES[curve.family]


def mean_with_band(axes: Axes, x, mean, error, color: str, label: str) -> None:
    axes.plot(x, mean, color=color, linewidth=1.6, label=label)
    axes.fill_between(x, mean - 1.96 * error, mean + 1.96 * error, color=color, alpha=0.2, linewidth=0)


def robust_limits(curves: Sequence[np.ndarray]) -> tuple[float, float]:
    """Limits that hold all but the wildest hundredth of the values."""
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    low, high = np.quantile(values, [0.005, 0.995]) if len(values) else (-1.0, 1.0)
    room = 0.08 * (high - low) or 1.0
    return float(low - room), float(high + room)


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG and PDF; returns their paths."""
    return [
        write_whole(folder / f"{name}.{kind}", lambda file, kind=kind: figure.savefig(file, format=kind, dpi=150))
        for kind in ("png", "pdf")
    ]


def _variance_panel(axes: Axes, rows: Sequence[Row], estimators: Sequence[str]) -> None:
    for name in estimators:
        label, colour, marker = style_of(name)
        mine = [row for row in rows if row.estimator == name]
        x, y, lower, upper = _columns(mine, "stiffness", "variance", "variance_lower", "variance_upper")
        line_with_band(axes, x, y, lower, upper, label=label, color=colour, marker=marker)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(alpha=0.25)


def _error_panel(axes: Axes, rows: Sequence[Row], estimators: Sequence[str]) -> None:
    for name in estimators:
        _, colour, marker = style_of(name)
        mine = [row for row in rows if row.estimator == name]
        x, y, error = _columns(mine, "stiffness", "relative_error", "relative_error_se")
        line_with_band(axes, x, y, np.maximum(y - 1.96 * error, y / 10), y + 1.96 * error, color=colour, marker=marker)
    reference = [row for row in rows if row.estimator == estimators[0]]
    x, floor = _columns(reference, "stiffness", "reference_uncertainty")
    axes.plot(x, floor, color="0.4", linestyle=":", marker="_", label="uncertainty of the reference")
    axes.axhline(1, color="0.7", linewidth=0.8)
    axes.set_yscale("log")
    axes.grid(alpha=0.25)


def line_with_band(axes: Axes, x, y, lower, upper, *, color: str, marker: str, label: str | None = None) -> None:
    axes.plot(x, y, color=color, marker=marker, markersize=4.5, label=label)
    if len(x) > 1:
        axes.fill_between(x, lower, upper, color=color, alpha=0.2, linewidth=0)
    else:
        axes.errorbar(x, y, yerr=[y - lower, upper - y], color=color, capsize=3)


def _columns(rows: Sequence[Row], *names: str) -> list[np.ndarray]:
    """Columns of a table sorted by stiffness; what is not positive and finite cannot be on a logarithmic axis."""
    ordered = sorted(rows, key=lambda row: row.stiffness)
    table = np.array([[getattr(row, name) for name in names] for row in ordered], float).reshape(-1, len(names))
    columns = list(np.where(np.isfinite(table) & (table > 0), table, np.nan).T)
    if names[0] == "stiffness":
        columns[0] = np.nan_to_num(columns[0], nan=NO_CONTACT)
    return columns


def _mark_default(axes: Axes, family: str, rows: Sequence[Row]) -> None:
    """Where MuJoCo's default time constant lies among the stiffnesses of its own family."""
    if family != "mujoco" or not rows:
        return
    mass = rows[0].stiffness / -rows[0].solref[0]
    default = mass / (DEFAULT_SOLREF[0] * DEFAULT_SOLREF[1]) ** 2
    axes.axvline(default, color="0.4", linestyle="--", linewidth=0.8)
    axes.annotate(
        "default solref",
        (default, 0.98),
        xycoords=("data", "axes fraction"),
        rotation=90,
        ha="right",
        va="top",
        fontsize="small",
        color="0.3",
    )
