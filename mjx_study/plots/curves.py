"""Figures of a landscape and of an optimisation."""

from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mjx_study.plots.style import STYLE, TITLES, mean_with_band, robust_limits, style_of
from mjx_study.study.landscapes import Curve, Landscape


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


def _curve_title(curve: Curve) -> str:
    if curve.family == "reference":
        return "analytic reference\n(of penalty contact)"
    return f"{TITLES[curve.family]}\nK = {curve.stiffness:g} N/m" if curve.stiffness else TITLES[curve.family]
