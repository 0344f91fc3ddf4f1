"""Figure of docs/scaling.md."""

from typing import Any, Final

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from experiments.scaling.cost import BASE
from mjx_study.plots.style import style_of

PANELS: Final = {
    "samples": "samples of a call",
    "horizon": "steps of a rollout",
    "dof": "degrees of freedom",
    "contacts": "contacts",
    "devices": "devices (CPU: cores)",
}
"""Axes of the figure's panels, with their labels."""


def scaling_figure(documents: list[dict[str, Any]]) -> Figure:
    """Draw a row of panels; lines of a second machine are dashed, of a third dotted, gradients wide and hollow."""
    figure = Figure(figsize=(2.6 * len(PANELS), 3.2), layout="constrained")
    panels = dict(zip(PANELS, figure.subplots(1, len(PANELS)), strict=True))
    names = {"gradient": ("gradients", *style_of("fobg")[1:]), "value": ("rollouts", *style_of("zobg")[1:])}
    wide = {"ms": 7.5, "markerfacecolor": "none", "linewidth": 3.0, "alpha": 0.6}
    units: list[str] = []
    for document, line in zip(documents, ("-", "--", ":"), strict=False):
        environment = document["environment"]
        on_cpu = environment["backend"] == "cpu"
        device = "one core" if on_cpu else environment["device_kind"].removeprefix("NVIDIA ").split(" ")[0]
        base = document["base"]
        units.append(f"{base['samples']:,} at once on {device}")
        for axis, label in PANELS.items():
            for kind, (name, colour, marker) in names.items():
                rows = [row for row in document["measured"] if row["axis"] == axis and row["kind"] == kind]
                if not rows:
                    continue
                axes, each = panels[axis], [row["ratio"] / row["samples"] / row["steps"] for row in rows]
                if axis == "devices":
                    each = [rows[0]["seconds"] / row["seconds"] for row in rows]
                positions, text = [row["at"] for row in rows], f"{name}, {device}"
                style = {"ms": 4} if kind == "value" else wide
                axes.plot(positions, each, line, color=colour, marker=marker, label=text, **style)
                axes.set(xlabel=label)
    for axis, axes in panels.items():
        positions = sorted({row["at"] for each in documents for row in each["measured"] if row["axis"] == axis})
        axes.set(xscale="log", yscale="log")
        if axis == "devices":
            axes.plot(positions, positions, color="0.7", linewidth=0.8, zorder=0)
            axes.set(ylabel="speedup over one device")
            axes.set_yticks(positions, [str(at) for at in positions])
        else:
            low, high = axes.get_ylim()
            axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 20 * low else (1, 3), numticks=12))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.grid(alpha=0.25)
        if axis != "samples":
            axes.set_xticks(positions, [str(at) for at in positions])
        axes.minorticks_off()
    next(iter(panels.values())).set_ylabel("time of a step, over the unit")
    unit = f"unit: a step of a rollout of {BASE} of {documents[0]['base']['steps']} steps"
    figure.supxlabel(f"{unit}, {', '.join(units)}", fontsize="small")
    next(iter(panels.values())).legend(fontsize=7)
    return figure
