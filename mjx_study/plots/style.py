"""Colours, names, lines with bands, and file formats shared by all figures."""

import itertools
import math
import textwrap
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import ScaledTranslation

from estimators.registry import ESTIMATORS, label_of
from mjx_study.disk import write_whole

OTHERS: Final = (("#882255", "#AA4499", "#332288", "#88CCEE", "#DDCC77", "#661100", "#999933"), "1234+x|_")
"""Colours, of Tol's muted scheme, and markers for estimators that choose none; black and grey are for the rest."""
NO_CONTACT: Final = 1.0
"""Position of models without a stiffness on a stiffness axis [N/m]."""
TITLES: Final = {
    "penalty": "penalty (impedance 1e-4)",
    "impedance": "impedance 0.5",
    "mujoco": "MuJoCo, default impedance",
    "mujoco_stiff": "MuJoCo, impedance 0.99 to 0.9999",
    "smooth_onset": "smooth onset",
    "mujoco_default": "MuJoCo default",
    "hunt_crossley": "Hunt-Crossley",
    "kelvin_voigt": "Kelvin-Voigt",
    "log_barrier": "log barrier",
    "conic": "cone, rigid",
    "mjcf": "as in the MJCF",
    "reference": "analytic reference",
}
"""Names of contact families; others go by their own."""


def style_of(name: str, onset: str = "none") -> tuple[str, str, str]:
    """Label, colour and marker of an estimator under an onset term; the last two by its name if its class has none."""
    (colours, markers), found, drawn = OTHERS, ESTIMATORS.get(name), zlib.crc32(name.encode())
    by_name = colours[drawn % len(colours)], markers[drawn // 7 % len(markers)]
    colour, marker = (found.style if found else None) or by_name
    return label_of(name, onset), colour, marker


def combines(name: str, described: Mapping[str, Any]) -> bool:
    """Whether an estimator combines batches, so that its curve may coincide with another's.

    User-defined ones are not imported: `described` holds what their study recorded, by name.
    """
    needs = ESTIMATORS[name].needs if name in ESTIMATORS else described.get(name, {}).get("needs", ())
    return len(needs) > 1


def robust_limits(curves: Sequence[np.ndarray]) -> tuple[float, float]:
    """Axis limits that exclude the most extreme hundredth of the values."""
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    low, high = np.quantile(values, [0.005, 0.995]) if len(values) else (-1.0, 1.0)
    room = 0.08 * (high - low) or 0.08 * abs(high) or 1.0
    return float(low - room), float(high + room)


STYLES: Final = {
    "screen": {"pdf.fonttype": 42},
    "paper": {
        "font.size": 8.0,
        "axes.linewidth": 0.6,
        "lines.linewidth": 1.0,
        "pdf.fonttype": 42,  # embedded, keeping text as text
        "ps.fonttype": 42,
        "svg.fonttype": "path",  # SVG embeds no fonts
    },
}
"""matplotlib settings by style."""
COLUMN, PAGE = 3.4, 7.0
"""Widths of a paper's column and page [in], for figures with one column of panels and with more."""


def fit_to_paper(figure: Figure) -> None:
    """Fit a figure to a column or page and drop its title, which goes into the caption."""
    width, height = figure.get_size_inches()
    wanted, rows = COLUMN if width <= 5 else PAGE, len({round(axes.bbox.y0) for axes in figure.axes})
    figure.set_size_inches(wanted, max(height * wanted / width, 1.2 * rows + 1.4))
    figure.suptitle("")
    legend_below(figure)
    fit_texts(figure)


LEGEND: Final = 0.4
"""Height of a legend for which figures have room [in]; they grow for a higher one."""


def legend_below(figure: Figure) -> None:
    """Make one legend for all panels below them, where it hides nothing, in as few rows as fit the width."""
    while figure.legends:
        figure.legends[0].remove()
    pairs = [zip(*axes.get_legend_handles_labels(), strict=True) for axes in figure.axes]
    shown: dict[str, Artist] = {}
    for handle, label in itertools.chain(*pairs):
        shown.setdefault(label, handle)  # panels of curves come before those of single models
    for rows in range(1, len(shown) + 1):
        columns, place = -(-len(shown) // rows), "outside lower center"
        legend = figure.legend(shown.values(), shown, loc=place, ncols=columns, frameon=False, fontsize="small")
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            higher = legend.get_window_extent().height / figure.dpi - LEGEND
            figure.set_figheight(figure.get_figheight() + max(0.0, higher))
            break
        legend.remove()


ROOM: Final = 0.95
"""Share of its axes or figure that a text may take; its length differs a little between resolutions."""


def fit_texts(figure: Figure) -> None:
    """Break titles and labels that are longer than their axes or figure; make smaller those that still are."""
    for mend in (_break, _shrink, _shrink):
        if engine := figure.get_layout_engine():
            engine.execute(figure)
        sides = [(text, figure, "width") for text in figure.texts]
        for axes in figure.axes:
            sides += [
                (axes.title, axes, "width"),
                (axes.xaxis.label, axes, "width"),
                (axes.yaxis.label, axes, "height"),
            ]
        ratios = [
            (text, getattr(text.get_window_extent(), side) / (ROOM * getattr(of.bbox, side)))
            for text, of, side in sides
        ]
        longer = [(text, ratio) for text, ratio in ratios if ratio > 1]
        for text, ratio in longer:
            mend(text, ratio)
        if not longer:
            break


def _break(text: Text, ratio: float) -> None:
    lines = text.get_text().split("\n")
    most = max(map(len, lines)) // math.ceil(ratio) + 6
    text.set_text("\n".join(textwrap.fill(line, most, break_long_words=False) for line in lines))


def _shrink(text: Text, ratio: float) -> None:
    text.set_fontsize(float(text.get_fontsize()) / ratio)


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


MOST_POINTS: Final = 15  # maximum number of points of a curve each of which has a marker; of longer curves a few have


def line_with_band(
    axes: Axes, x, y, lower, upper, *, color: str, marker: str, label: str | None = None, hollow: bool = False,
    joined: bool = True, rank: int = 0,
) -> None:  # fmt: skip
    """Draw a line with its interval, or points with bars. A curve that may coincide with another is hollow and dashed.

    Two points are not joined, since nothing was measured in between. Long curves of different rank have their markers
    at different points.
    """
    apart = max(1, len(x) // 5)
    joined = joined and len(x) > 2
    line = ("--" if hollow else "-") if joined else "none"
    face, size = ("none", 7.5) if hollow else (color, 4.5)
    axes.plot(
        x, y, color=color, marker=marker, markersize=size, markerfacecolor=face, linestyle=line, label=label,
        markevery=1 if len(x) <= MOST_POINTS else (rank * max(1, apart // 3) % apart, apart),
    )  # fmt: skip
    if joined:
        axes.fill_between(x, lower, upper, color=color, alpha=0.2, linewidth=0)
    else:
        bars = np.nan_to_num(np.maximum([y - lower, upper - y], 0))
        axes.errorbar(x, y, yerr=bars, color=color, capsize=3, linestyle="none")


ARROWHEAD: Final = 5.5  # height of an arrowhead with the room around it [points]


def mark_clipped(figure: Figure) -> None:
    """Put arrowheads outside finished axes where curves (filled) and intervals (hollow) continue beyond an edge, and
    make room for them."""
    counts = [_mark(axes, figure) for axes in figure.axes]
    titled = [axes.get_title() != "" or axes.get_title("left") != "" for axes in figure.axes]
    above = max((count for (count, _), has in zip(counts, titled, strict=True) if has), default=0)
    below = max(count for _, count in counts)
    for axes in figure.axes:
        for place in ("left", "center"):
            if above and (title := axes.get_title(place)):
                axes.set_title(title, loc=place, pad=ARROWHEAD * (above + 0.5), fontsize="medium")
        if below:
            axes.tick_params("x", pad=ARROWHEAD * (below + 0.5))


def _mark(axes: Axes, figure: Figure) -> tuple[int, int]:
    """Put arrowheads outside an axes; return how many there are at most above each other, at the top and below."""
    caps = {cap for each in axes.containers if isinstance(each, ErrorbarContainer) for cap in each[1]}
    lines = [each for each in axes.lines if each not in caps and each.get_transform() is axes.transData]
    curves: list[tuple[np.ndarray, str, bool]]
    curves = [(np.asarray(each.get_xydata()), to_hex(each.get_color()), True) for each in lines]
    for drawn in axes.collections:
        color = drawn.get_edgecolor() if isinstance(drawn, LineCollection) else drawn.get_facecolor()
        curves += [
            (np.asarray(path.vertices), to_hex(np.ravel(color)[:3].tolist()), False) for path in drawn.get_paths()
        ]
    marked: dict[tuple[float, int], list[str]] = {}
    left, right = axes.get_xlim()
    for (points, color, filled), sign in itertools.product(curves, (-1, 1)):
        beyond = np.flatnonzero(sign * points[:, 1] > sign * axes.get_ylim()[sign > 0])
        if len(points) > 2 * MOST_POINTS + 3:  # with both sides of a band: then one for each stretch
            stretches = np.split(beyond, np.flatnonzero(np.diff(beyond) > 1) + 1)
            beyond = [each[len(each) // 2] for each in stretches if len(each)]
        for x in (x for x in points[beyond, 0].tolist() if left <= x <= right):
            others = marked.setdefault((x, sign), [])
            if color not in others:
                away = ScaledTranslation(0, sign * ARROWHEAD * (0.75 + len(others)) / 72, figure.dpi_scale_trans)
                looks = {"color": color, "markerfacecolor": color if filled else "none", "markersize": 0.8 * ARROWHEAD}
                axes.plot(
                    x, sign > 0, "^" if sign > 0 else "v", transform=axes.get_xaxis_transform() + away, clip_on=False,
                    markeredgewidth=0.8, **looks,
                )  # fmt: skip
                others.append(color)
    if marked:
        axes.plot([], [], "^", color="0.4", markersize=0.8 * ARROWHEAD, label="beyond the axis (hollow: its interval)")
    above, below = (max((len(each) for (_, at), each in marked.items() if at == sign), default=0) for sign in (1, -1))
    return above, below
