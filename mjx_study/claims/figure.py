"""Matrix of verdicts as a figure."""

from typing import Any, Final

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from mjx_study.claims.ledger import VERDICTS, columns, matrix
from mjx_study.plots.style import TITLES

COLOURS: Final = {"holds": "#0072B2", "fails": "#E69F00", "reversed": "#D55E00", "undecided": "#DDDDDD"}
SIGNS: Final = {"holds": "+", "fails": "×", "reversed": "−", "undecided": "?"}
"""Signs that distinguish verdicts without colours."""


def draw_matrix(document: dict[str, Any]) -> Figure:
    """Draw a square for each claim and family, with a strip for each system."""
    rows = matrix(document)
    shown = columns(rows)
    figure = Figure(figsize=(3.6 + 0.5 * len(shown), 1.9 + 0.24 * len(rows)), layout="constrained")
    axes = figure.subplots()
    for down, row in enumerate(rows.values()):
        for across, family in enumerate(shown):
            verdicts = row.get(family, [])
            for index, verdict in enumerate(verdicts):
                width = 0.92 / len(verdicts)
                left = across - 0.46 + index * width
                axes.add_patch(Rectangle((left, down - 0.44), width, 0.88, color=COLOURS[verdict], linewidth=0))
                colour = "black" if verdict == "undecided" else "white"
                middle = left + width / 2
                axes.text(middle, down, SIGNS[verdict], ha="center", va="center", color=colour, fontsize=8)
    axes.set_xlim(-0.5, len(shown) - 0.5)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xticks(range(len(shown)), [TITLES[name] for name in shown], rotation=40, ha="left", fontsize=8)
    axes.set_yticks(range(len(rows)), list(rows), fontsize=8)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)
    handles = [Rectangle((0, 0), 1, 1, color=COLOURS[verdict]) for verdict in VERDICTS]
    labels = [f"{SIGNS[verdict]} {verdict}" for verdict in VERDICTS]
    figure.legend(handles, labels, loc="outside lower center", ncols=len(VERDICTS), frameon=False, fontsize=8)
    return figure
