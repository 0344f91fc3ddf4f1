"""A study as one self-contained HTML page: warnings, figures, tables, configuration, and the command that made it; and
the methods of its Dataset."""

import base64
import io
import json
import math
from collections.abc import Mapping
from typing import Any

import jinja2
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from mjx_study.plots.study import drawings_of, plot_study
from mjx_study.results.kind import Drawing, findings_of, kind_of
from mjx_study.results.rows import label_in, model_name, remains
from mjx_study.results.variables import COORDINATES, DEBIASED, Variable
from mjx_study.results.warnings import warnings_of
from mjx_study.table import plural, with_error


@xr.register_dataset_accessor("mjx_study")
class StudyAccessor:
    """Methods of a study's Dataset: `data.mjx_study.table()`, `.findings()`, `.warnings()`, `.plot()`, `.report()`."""

    def __init__(self, dataset: xr.Dataset):
        self._dataset = dataset

    def table(self) -> pd.DataFrame:
        """Return a row per contact model, seed and estimator, without variables over iterations, points or theta."""
        return kind_of(self._dataset).table(self._dataset)

    def findings(self) -> list[str]:
        """Return what the study's intervals support, as sentences."""
        return findings_of(self._dataset)

    def warnings(self) -> tuple[str, ...]:
        """Return warnings about contact models, lost samples and missing cells."""
        return warnings_of(self._dataset)

    def plot(self) -> dict[str, Figure]:
        """Draw the figures that the study has data for, by name."""
        return plot_study(self._dataset)

    def report(self) -> str:
        """Return the study as one HTML page."""
        return render_report(self._dataset)


@np.errstate(over="ignore", invalid="ignore")  # numbers of a motion that explodes
def render_report(dataset: xr.Dataset) -> str:
    config, kind, drawings = json.loads(dataset.attrs["config"]), kind_of(dataset), drawings_of(dataset)
    quantities = {name: kind.quantities[name] for name in kind.columns}
    pages = jinja2.Environment(loader=jinja2.PackageLoader("mjx_study"), autoescape=True, keep_trailing_newline=True)
    return pages.get_template("report.html").render(
        tasks=", ".join(config["tasks"]),
        kind=kind.title,
        models=dataset.sizes["model"],
        warnings=warnings_of(dataset),
        findings=findings_of(dataset),
        figures=[_figure(name, figure, drawings) for name, figure in plot_study(dataset).items()],
        summary=_summary(dataset),
        numbers=_numbers(dataset, quantities),
        meanings={each.heading: each.description for each in quantities.values()},
        config=[[key, _shown(value)] for key, value in sorted(config.items()) if value not in (None, [], "")],
        provenance=_provenance(dataset),
        command=dataset.attrs.get("command"),
    )


def _figure(name: str, figure: Figure, drawings: Mapping[str, Drawing]) -> tuple[str, str, str]:
    """Name, caption and image of a figure."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    caption = next(drawing.caption for key, drawing in drawings.items() if name.startswith(key))
    return name, caption, base64.b64encode(file.getvalue()).decode()


def _summary(dataset: xr.Dataset) -> str:
    """Explain the numbers in the table."""
    seeds, samples = dataset.sizes.get("seed", 1), int(dataset["samples"][-1])
    seed = f"Medians over {seeds} seeds, counts summed" if seeds > 1 else "One seed"
    return (
        f"{seed}; {plural(samples, 'sample')} in a batch; ± one standard error; -: not defined, or explained by noise."
    )


def _numbers(dataset: xr.Dataset, quantities: Mapping[str, Variable]) -> tuple[list[str], list[list[str]]] | None:
    """Titles of the table of numbers, and a row for each cell and estimator; what all rows of a cell share, once."""
    if not dataset.data_vars:
        return None
    kind = kind_of(dataset)
    dataset = kind.summarised(dataset)
    axes = ("task", "timestep", "cone", "sigma", "model", "estimator")
    outer = [name for name in axes[:4] if dataset.sizes[name] > 1]
    shown = {name: variable for name, variable in quantities.items() if name in dataset}
    last = dataset.isel(samples=-1)
    labels = [COORDINATES[name].label if name in COORDINATES else name for name in outer]
    titles = ["contact model", *labels, "estimator", *(variable.heading for variable in shown.values())]
    shared = [True] * (1 + len(outer)) + [False] + ["estimator" not in each.dims for each in shown.values()]
    rows, above = [], None
    for picked in np.ndindex(*(dataset.sizes[name] for name in axes)):
        one = last.isel(dict(zip(axes, picked, strict=True)))
        if one[kind.computed].notnull().all():
            label = label_in(dataset, one["estimator"].item())
            where = [model_name(one), *(_shown(one[name].item()) for name in outer), label]
            row = [*where, *(_text(name, variable, one) for name, variable in shown.items())]
            rows.append(["" if picked[:-1] == above and once else cell for cell, once in zip(row, shared, strict=True)])
            above = picked[:-1]
    filled = [index for index in range(len(titles)) if any(row[index] not in ("", "-") for row in rows)]
    return [titles[index] for index in filled], [[row[index] for index in filled] for row in rows]


def _text(name: str, variable: Variable, one: xr.Dataset) -> str:
    """Format the sum of counts, the median of other numbers over the seeds and the last tenth of iterations, with its
    standard error where that of a single number is known."""
    values, error = one[name], one.get(f"{name}_se")
    error = math.nan if error is None or error.size > 1 else error.item()
    if "iteration" in values.dims and variable.digits:
        values = values.isel(iteration=slice(-max(1, values.sizes["iteration"] // 10), None))
    array = values.values[np.isfinite(values.values)].astype(float)
    if len(array) == 0:
        return "-"
    if variable.digits == 0:
        return variable.text(float(np.sum(array)))
    if name == DEBIASED["relative_error"]:
        return remains("relative_error", float(one["relative_error"].median()), float(np.median(array)), error)
    return with_error(float(np.median(array)), error, variable.digits)


def _provenance(dataset: xr.Dataset) -> list[list[str]]:
    environment = json.loads(dataset.attrs["environment"])
    versions = environment.pop("versions")
    found = environment | versions
    if "revision" in dataset.attrs:
        found["revision"] = dataset.attrs["revision"]
    return [[name, _shown(value)] for name, value in found.items()]


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ", ".join(_shown(each) for each in value)
    return str(value)
