"""Colours, names, lines with bands, and file formats shared by all figures."""

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estimators.estimator import label_of
from mjx_study.choices import FAMILIES
from mjx_study.disk import write_whole

# Okabe-Ito colours, distinguishable in print and by colour-blind readers; markers repeat the distinction.
STYLE: Final = {
    "zobg": ("#0072B2", "o"),
    "zobg_antithetic": ("#56B4E9", "v"),
    "zobg_to_go": ("#56B4E9", "P"),
    "zobg_to_go_antithetic": ("#0072B2", "X"),
    "fobg": ("#D55E00", "s"),
    "fobg_onset": ("#000000", "s"),
    "fobg_clipped": ("#E69F00", "<"),
    "fobg_truncated": ("#E69F00", ">"),
    "aobg": ("#009E73", "D"),
    "aobg_onset": ("#777777", "D"),
    "ivw": ("#CC79A7", "^"),
    "ivw_h": ("#CC79A7", "p"),
    "total_propagation": ("#000000", "*"),
    "ddcg": ("#009E73", "h"),
    "delta": ("#777777", "d"),
}
OTHERS: Final = (("#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7"), "1234+x|_")
"""Colours and markers for user-defined estimators."""
NO_CONTACT: Final = 1.0
"""Position of tasks without contact on a stiffness axis."""
TITLES: Final = {
    "penalty": "penalty (impedance 1e-4)",
    "impedance": "impedance 0.5",
    "mujoco": "MuJoCo, default impedance",
    "mujoco_stiff": "MuJoCo, impedance 0.99 to 0.9999",
    "smooth_onset": "smooth onset",
    "mujoco_default": "MuJoCo default",
    "mjcf": "as in the MJCF",
    "reference": "analytic reference",
}
assert set(TITLES) >= set(FAMILIES)


def style_of(name: str) -> tuple[str, str, str]:
    """Label, colour and marker of an estimator; user-defined ones depend on the name alone."""
    colours, markers = OTHERS
    drawn = zlib.crc32(name.encode())
    return label_of(name), *STYLE.get(name, (colours[drawn % len(colours)], markers[drawn // 7 % len(markers)]))


def mean_with_band(axes: Axes, x, mean, error, color: str, label: str) -> None:
    axes.plot(x, mean, color=color, linewidth=1.6, label=label)
    axes.fill_between(x, mean - 1.96 * error, mean + 1.96 * error, color=color, alpha=0.2, linewidth=0)


def robust_limits(curves: Sequence[np.ndarray]) -> tuple[float, float]:
    """Axis limits that exclude the most extreme hundredth of the values."""
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    low, high = np.quantile(values, [0.005, 0.995]) if len(values) else (-1.0, 1.0)
    room = 0.08 * (high - low) or 1.0
    return float(low - room), float(high + room)


STYLES: Final = {
    "screen": {"pdf.fonttype": 42},
    "paper": {
        "font.size": 8.0,
        "axes.linewidth": 0.6,
        "lines.linewidth": 1.0,
        "pdf.fonttype": 42,  # embedded, keeping text as text
        "svg.fonttype": "none",
    },
}
"""matplotlib settings by style."""
COLUMN, PAGE = 3.4, 7.0
"""Widths of a paper's column and page [in], for figures with one column of panels and with more."""


def fit_to_paper(figure: Figure) -> None:
    """Fit a figure to a column or page and drop its title, which goes into the caption."""
    width, height = figure.get_size_inches()
    wanted = COLUMN if width < 5 else PAGE
    figure.set_size_inches(wanted, height * wanted / width)
    figure.suptitle("")


def save_figure(figure: Figure, folder: Path, name: str, formats: Sequence[str] = ("png", "pdf")) -> list[Path]:
    """Write a figure in some of `FIGURE_FORMATS` with a single layout; return the paths."""
    engine, written = figure.get_layout_engine(), []
    for kind in formats:
        path = folder / f"{name}.{kind}"
        written.append(write_whole(path, lambda file, kind=kind: figure.savefig(file, format=kind, dpi=150)))
        if engine is not None:
            figure.set_layout_engine("none")
    figure.set_layout_engine(engine or "none")
    return written


def save_figures(figures: Mapping[str, Figure], folder: Path, formats: Sequence[str] = ("png", "pdf")) -> list[Path]:
    """Write figures by name; see `save_figure`."""
    return [path for name, figure in figures.items() for path in save_figure(figure, folder, name, formats)]


def line_with_band(
    axes: Axes, x, y, lower, upper, *, color: str, marker: str, label: str | None = None, hollow: bool = False
) -> None:
    """Draw a line with its interval. A curve that may coincide with another is dashed with hollow markers.

    Two points are not joined, since nothing was measured in between.
    """
    joined = len(x) > 2
    line = ("--" if hollow else "-") if joined else "none"
    face, size = ("none", 7.5) if hollow else (color, 4.5)
    axes.plot(
        x, y, color=color, marker=marker, markersize=size, markerfacecolor=face, linestyle=line, label=label
    )  # fmt: skip
    if joined:
        axes.fill_between(x, lower, upper, color=color, alpha=0.2, linewidth=0)
    else:
        bars = np.nan_to_num(np.maximum([y - lower, upper - y], 0))
        axes.errorbar(x, y, yerr=bars, color=color, capsize=3, linestyle="none")


HOLLOW: Final = ("aobg", "ivw", "ivw_h", "ddcg", "total_propagation")
"""Interpolating estimators, whose curves may coincide with others."""
