"""Figures from results; nothing here simulates."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from estimators import ESTIMATORS
from mjx_study.comparison import CompareResult, Row
from mjx_study.contact import DEFAULT_SOLREF, FAMILIES
from mjx_study.results import write_whole

# Okabe and Ito's colours, told apart in print and by colour-blind eyes; markers repeat the distinction.
STYLE: Final = {
    "zobg": ("ZoBG", "#0072B2", "o"),
    "fobg": ("FoBG", "#D55E00", "s"),
    "aobg": ("AoBG", "#009E73", "D"),
    "ivw": ("IVW", "#CC79A7", "^"),
}
TITLES: Final = {
    "penalty": "penalty (impedance 1e-4)",
    "impedance": "impedance 0.5",
    "mujoco": "MuJoCo, default impedance",
    "mujoco_stiff": "MuJoCo, impedance 0.99 to 0.9999",
    "smooth_onset": "smooth onset",
    "mujoco_default": "MuJoCo default",
}
assert set(STYLE) >= set(ESTIMATORS) and set(TITLES) >= set(FAMILIES)


def plot_comparison(result: CompareResult) -> Figure:
    """Variance and relative error against stiffness: a column for each contact family, a line for each estimator."""
    families = result.config.contact
    figure = Figure(figsize=(1.2 + 3.4 * len(families), 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(families), sharex=True, sharey="row", squeeze=False)
    for column, family in zip(axes.T, families, strict=True):
        rows = [row for row in result.rows if row.contact == family]
        _variance_panel(column[0], rows, result.config.estimators)
        _error_panel(column[1], rows, result.config.estimators)
        column[0].set_title(TITLES[family])
        column[1].set_xlabel("contact stiffness K [N/m]")
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


def save_figure(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as PNG and PDF; returns their paths."""
    return [
        write_whole(folder / f"{name}.{kind}", lambda file, kind=kind: figure.savefig(file, format=kind, dpi=150))
        for kind in ("png", "pdf")
    ]


def _variance_panel(axes: Axes, rows: Sequence[Row], estimators: Sequence[str]) -> None:
    for name in estimators:
        label, colour, marker = STYLE[name]
        mine = [row for row in rows if row.estimator == name]
        x, y, lower, upper = _columns(mine, "stiffness", "variance", "variance_lower", "variance_upper")
        _line_with_band(axes, x, y, lower, upper, label=label, color=colour, marker=marker)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(alpha=0.25)


def _error_panel(axes: Axes, rows: Sequence[Row], estimators: Sequence[str]) -> None:
    for name in estimators:
        _, colour, marker = STYLE[name]
        mine = [row for row in rows if row.estimator == name]
        x, y, error = _columns(mine, "stiffness", "relative_error", "relative_error_se")
        _line_with_band(axes, x, y, np.maximum(y - 1.96 * error, y / 10), y + 1.96 * error, color=colour, marker=marker)
    reference = [row for row in rows if row.estimator == estimators[0]]
    x, floor = _columns(reference, "stiffness", "reference_uncertainty")
    axes.plot(x, floor, color="0.4", linestyle=":", marker="_", label="uncertainty of the reference")
    axes.axhline(1, color="0.7", linewidth=0.8)
    axes.set_yscale("log")
    axes.grid(alpha=0.25)


def _line_with_band(axes: Axes, x, y, lower, upper, *, color: str, marker: str, label: str | None = None) -> None:
    axes.plot(x, y, color=color, marker=marker, markersize=4.5, label=label)
    if len(x) > 1:
        axes.fill_between(x, lower, upper, color=color, alpha=0.2, linewidth=0)
    else:
        axes.errorbar(x, y, yerr=[y - lower, upper - y], color=color, capsize=3)


def _columns(rows: Sequence[Row], *names: str) -> list[np.ndarray]:
    """Columns of a table sorted by stiffness; what is not positive and finite cannot be on a logarithmic axis."""
    ordered = sorted(rows, key=lambda row: row.stiffness)
    table = np.array([[getattr(row, name) for name in names] for row in ordered], float).reshape(-1, len(names))
    return list(np.where(np.isfinite(table) & (table > 0), table, np.nan).T)


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
