"""Draw docs/engines.png: the mean of the derivatives over the slope, by engine and timestep of the toss.

python -m experiments.engines.figure
"""

from matplotlib.figure import Figure

from experiments.engines.catalog import ENGINES
from experiments.engines.judge import verdict
from experiments.engines.page import CELLS, cells
from experiments.engines.scenes import TIMESTEPS
from experiments.pages import save_figure


def main() -> None:
    """Draw what is decided; the others are left out, and named."""
    found = cells(CELLS)
    toss = {key: cell for key, cell in found.items() if key[1] == "toss"}
    names = [name for name in ENGINES if any(key[0] == name and "slope" in cell for key, cell in toss.items())]
    figure = Figure(figsize=(7, 0.4 * len(names) + 1), layout="constrained")
    axes = figure.subplots()
    for i, step in enumerate(TIMESTEPS):
        for row, name in enumerate(names):
            cell = toss.get((name, "toss", step), {})
            ratio = cell["mean"] / cell["slope"] if "slope" in cell else float("nan")
            at = row + 0.4 * i - 0.2
            said = verdict(cell) if "slope" in cell else "not measured"
            if -1 < ratio < 12 and said != "no contact":
                faint = 0.4 if said == "unknown" else 1.0
                axes.barh(at, ratio, 0.38, color=f"C{i}", alpha=faint, label=f"{1000 * step:g} ms" if not row else None)
            else:
                kept = said in ("not measured", "no contact")
                axes.text(1.1, at, said if kept else "not shown: NaN, below -1 or above 12", va="center", fontsize=7)
    axes.axvline(1, color="black", linewidth=1)
    axes.set_yticks(range(len(names)), [ENGINES[name].label for name in names])
    axes.invert_yaxis()
    axes.set_xlabel("E[FoBG] / slope of the mean cost\n(right: 1; pale: undecided)")
    axes.legend(loc="lower right")
    save_figure(figure, "engines")


if __name__ == "__main__":
    main()
