"""Figures of a study from its Dataset alone."""

import itertools
import re
from collections.abc import Iterator
from functools import partial
from typing import Final

import numpy as np
import xarray as xr
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from estimators.registry import label_of
from mjx_study.plots.panels import UNDRAWN, UNSTABLE, drawable, families, make_panels, number, positive, unstable
from mjx_study.plots.style import TITLES, fit_texts, legend_below, mark_clipped
from mjx_study.results.kind import Drawing, kind_of
from mjx_study.results.rows import onset_of
from mjx_study.results.variables import COORDINATES, Variable
from mjx_study.table import digits_to_tell_apart

MAX_FIGURES: Final = 12  # maximum number of figures of one kind; further tasks, timesteps and noises are dropped
MOST_DECADES: Final = 6  # maximum ratio of FoBG to ZoBG, or of ZoBG to FoBG, that a map tells apart, as a power of ten


def plot_study(dataset: xr.Dataset) -> dict[str, Figure]:
    """Plot the figures that a study has data for, at most `MAX_FIGURES` of a kind, by file name without suffix."""
    figures: dict[str, Figure] = {}
    drawings, computed = drawings_of(dataset), kind_of(dataset).computed
    finite = dataset.map(drawable, keep_attrs=True).assign({computed: dataset[computed]} if drawings else {})
    for name, drawing in drawings.items():
        for suffix, title, part in itertools.islice(_slices(finite, computed, drawing.keep), MAX_FIGURES):
            if (figure := drawing.draw(part, title)) is not None:
                mark_clipped(figure)
                legend_below(figure)
                fit_texts(figure)
                figures[name + suffix] = figure
    return figures


def drawings_of(dataset: xr.Dataset) -> dict[str, Drawing]:
    """Figures of a study's kind, and a map of FoBG over ZoBG if stiffness and another parameter are swept; none without
    numbers."""
    if not dataset.data_vars:
        return {}
    kind = kind_of(dataset)
    found = kind.drawings(dataset)
    swept = [name for name in COORDINATES if len(np.unique(dataset[name].values)) > 1]
    both = {"zobg", "fobg"} <= set(dataset["estimator"].values.tolist())
    if kind.compared and both and len(swept) > 1 and swept[0] == "stiffness":
        draw = partial(_ratio_map, variable=kind.variables[kind.compared], quantity=kind.compared, other=swept[1])
        caption = "First order against zeroth order over stiffness and another swept parameter."
        found[f"map_stiffness_{swept[1]}"] = Drawing(draw, caption, keep=swept[1])
    return found


def _slices(dataset: xr.Dataset, computed: str, keep: str) -> Iterator[tuple[str, str, xr.Dataset]]:
    """Yield parts with one value in every dimension except the contact model, `keep`, and those within a cell, and with
    the contact models for which the variable `computed` is known.

    Each comes with a file-name suffix and a title; of several sample counts, the largest unless kept.
    """
    names = [name for name in ("task", "timestep", "cone", "sigma", "samples") if name != keep]
    choices = [range(dataset.sizes[name]) if name != "samples" else [dataset.sizes[name] - 1] for name in names]
    varied = [name for name in names if dataset.sizes[name] > 1 and name != "samples"]
    texts = {name: _texts(dataset[name].values) for name in names}
    taken: set[str] = set()
    for picked in itertools.product(*choices):
        part = dataset.isel(dict(zip(names, picked, strict=True)))
        known = part[computed].notnull()
        part = part.isel(model=np.flatnonzero(known.any([name for name in known.dims if name != "model"])))
        if part.sizes["model"] == 0:
            continue
        values = {name: texts[name][index] for name, index in zip(names, picked, strict=True)}
        # The texts are from a study.json, which may come from anywhere.
        suffix = "".join("_" + re.sub(r"[^\w.+-]", "-", values[name])[:60] for name in varied)
        suffix += f"_{len(taken)}" if suffix in taken else ""
        taken.add(suffix)
        shown = ["".join(each if each.isprintable() else "?" for each in values["task"])] + [
            f"{variable.heading} = {values[name]} {variable.shown_unit}".rstrip()
            for name, variable in COORDINATES.items()
            if name in values
        ]
        shown += [f"{values['cone']} cone"] if "cone" in varied else []
        yield suffix, ", ".join(shown), part


def _texts(values: np.ndarray) -> list[str]:
    """Names unchanged; numbers with enough digits to distinguish them."""
    if values.dtype.kind not in "iuf":
        return [str(value) for value in values]
    digits = digits_to_tell_apart(values.tolist())
    return [f"{value:.{digits}g}" for value in values.tolist()]


def _ticks(values: np.ndarray) -> list[str]:
    """Values with three digits, or more to distinguish them."""
    digits = digits_to_tell_apart(values.tolist(), least=3)
    return [number(value, digits) for value in values.tolist()]


def _ratio_map(part: xr.Dataset, title: str, variable: Variable, quantity: str, other: str) -> Figure | None:
    """Plot log10 of FoBG over ZoBG against stiffness and `other`, one panel per family; blue where FoBG is smaller."""
    found = [(family, rows) for family, rows in families(part) if family] or families(part)
    ratios = []
    for _, rows in found:
        values = rows[quantity].median("seed")
        ratio = np.log10(positive(values.sel(estimator="fobg")) / positive(values.sel(estimator="zobg")))
        ratios.append(ratio if values.sel(estimator="fobg").dims[0] == other else ratio.T)
    known = np.concatenate(ratios, axis=None)
    if not np.isfinite(known).any():
        return None  # costs may be negative
    title = f"{title}\nwhere first order is ahead (blue) and behind (red)"
    figure, grid = make_panels(1, len(found), 1.8 + 3.2 * len(found), 3.9, title, sharey=True)
    extent = min(MOST_DECADES, max(1e-3, float(np.nanmax(np.abs(known)))))
    mesh = None
    for axes, (family, rows), ratio in zip(grid[0], found, ratios, strict=True):
        axes.grid(visible=False)
        mesh = axes.pcolormesh(
            np.arange(ratio.shape[1] + 1), np.arange(ratio.shape[0] + 1), ratio,
            cmap="RdBu_r", norm=TwoSlopeNorm(0, -extent, extent),
        )  # fmt: skip
        for row, column in np.argwhere(~np.isfinite(ratio)):
            axes.plot(column + 0.5, row + 0.5, "x", color="0.4", markersize=5, label=UNDRAWN)
        shaky = [unstable(rows.isel({other: index})) for index in range(rows.sizes[other])]
        for row, column in np.argwhere(shaky):
            axes.add_patch(Rectangle((column, row), 1, 1, fill=False, hatch="///", linewidth=0, label=UNSTABLE))
        stiffness = _ticks(rows["stiffness"].values)
        axes.set_xticks(np.arange(len(stiffness)) + 0.5, stiffness, rotation=60, ha="right", fontsize="small")
        labels = _ticks(rows[other].values)
        axes.set_yticks(np.arange(len(labels)) + 0.5, labels, fontsize="small")
        axes.set_xlabel(COORDINATES["stiffness"].label)
        axes.set_title(TITLES.get(family, family), fontsize="medium")
    grid[0, 0].set_ylabel(COORDINATES[other].label)
    assert mesh is not None
    below, above = bool(np.nanmin(known) < -extent), bool(np.nanmax(known) > extent)
    beyond = (("neither", "max"), ("min", "both"))[below][above]
    label = f"log$_{{10}}$ of {variable.heading},\n{label_of('fobg', onset_of(part))} over ZoBG"
    figure.colorbar(mesh, ax=list(grid[0]), label=label, extend=beyond)
    return figure
