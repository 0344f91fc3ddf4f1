"""A study as one self-contained HTML page: warnings, figures, tables, configuration, and the command that made it; and
the methods of its Dataset."""

import base64
import io
import json
from collections.abc import Mapping
from typing import Any, Final

import jinja2
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from mjx_study.plots.study import plot_study
from mjx_study.study.findings import findings_of, rows_of
from mjx_study.study.run import warnings_of
from mjx_study.study.variables import COORDINATES, QUANTITIES, Variable

CAPTIONS: Final = {
    "comparison": "Variance of one gradient sample, and relative error of the mean against the reference.",
    "variance": "Variance of one gradient sample; geometric mean over the seeds.",
    "bias": "Bias of each estimator against an unbiased zeroth-order reference; a triangle is an upper bound where "
    "none can be told from zero.",
    "alpha": "Weight of first-order gradients in the interpolations.",
    "error_against_samples": "Relative error of the mean gradient against the number of samples.",
    "map": "First order against zeroth order over two swept parameters.",
    "achieved": "Cost of the final policies against stiffness.",
    "landscape": "Cost along a line through theta, and the slope that the mean of each estimator has there.",
    "descent": "Cost against iterations, rollouts and seconds.",
}
MEDIANS: Final = "Medians over the seeds, at the largest sample count."
ESTIMATED: Final = ("variance", "effective_samples", "top_share", "relative_error", "debiased_error", "squared_bias")
KINDS: Final[dict[str, tuple[str, str, tuple[str, ...]]]] = {
    "gradients": ("gradient estimates", MEDIANS, (*ESTIMATED, "squared_bias_se", "alpha", "nonfinite")),
    "descents": ("gradient descent", MEDIANS, ("final_cost", "stopped_seeds", "variance", "alpha", "nonfinite")),
    "landscapes": ("landscapes", "At the largest sample count.", ("least_cost", "least_at", "steepest", "nonfinite")),
}
"""Title, what the numbers in the table are, and the quantities in it, by kind of study."""
PRESENT: Final = ("residual", "rollouts", "unconverged")
"""For every kind of study, a variable that is finite in every computed cell."""


@xr.register_dataset_accessor("mjx_study")
class StudyAccessor:
    """Methods of a study's Dataset: `data.mjx_study.table()`, `.findings()`, `.warnings()`, `.plot()`, `.report()`."""

    def __init__(self, dataset: xr.Dataset):
        self._dataset = dataset

    def table(self) -> pd.DataFrame:
        """Return a row per contact model, seed and estimator, without variables over iterations, points or theta."""
        if "variance" in self._dataset:
            return pd.DataFrame([row.as_dict() for row in rows_of(self._dataset)])
        long = {"iteration", "point", "param", "solref_entry", "solimp_entry"}
        short = [name for name, variable in self._dataset.data_vars.items() if not long & set(variable.dims)]
        return self._dataset[short].to_dataframe().reset_index()

    def findings(self) -> list[str]:
        return findings_of(self._dataset)

    def warnings(self) -> tuple[str, ...]:
        return warnings_of(self._dataset)

    def plot(self) -> dict[str, Figure]:
        return plot_study(self._dataset)

    def report(self) -> str:
        return render_report(self._dataset)


def render_report(dataset: xr.Dataset) -> str:
    config = json.loads(dataset.attrs["config"])
    title, summary, names = KINDS[config["kind"]]
    quantities = {name: QUANTITIES[config["kind"]][name] for name in names}
    pages = jinja2.Environment(loader=jinja2.PackageLoader("mjx_study"), autoescape=True, keep_trailing_newline=True)
    return pages.get_template("report.html").render(
        tasks=", ".join(config["tasks"]),
        kind=title,
        models=dataset.sizes["model"],
        warnings=warnings_of(dataset),
        findings=findings_of(dataset),
        figures=[_figure(name, figure) for name, figure in plot_study(dataset).items()],
        summary=summary,
        numbers=_numbers(dataset, quantities),
        meanings={each.heading: each.description for each in quantities.values()},
        config=[[key, _shown(value)] for key, value in sorted(config.items()) if value is not None],
        provenance=_provenance(dataset),
        command=dataset.attrs.get("command"),
    )


def _figure(name: str, figure: Figure) -> tuple[str, str, str]:
    """Name, caption and image of a figure."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    caption = next(text for key, text in CAPTIONS.items() if name.startswith(key))
    return name, caption, base64.b64encode(file.getvalue()).decode()


def _numbers(dataset: xr.Dataset, quantities: Mapping[str, Variable]) -> tuple[list[str], list[list[str]]] | None:
    """Titles of the table of numbers, and a row for each cell and estimator."""
    if not dataset.data_vars:
        return None
    if "smoothed" in dataset:
        dataset = _with_extremes(dataset)
    if "stopped_at" in dataset:
        dataset = dataset.assign(stopped_seeds=dataset["stopped_at"].notnull())
    axes = ("task", "timestep", "cone", "sigma", "model", "estimator")
    outer = [name for name in axes[:4] if dataset.sizes[name] > 1]
    shown = {name: variable for name, variable in quantities.items() if name in dataset}
    last = dataset.isel(samples=-1)
    rows = []
    for picked in np.ndindex(*(dataset.sizes[name] for name in axes)):
        one = last.isel(dict(zip(axes, picked, strict=True)))
        if any(np.isfinite(one[name]).all() for name in PRESENT if name in one):
            place = [_shown(one[name].item()) for name in ("model", *outer, "estimator")]
            rows.append([*place, *(_reduced(variable, one[name]) for name, variable in shown.items())])
    labels = [COORDINATES[name].label if name in COORDINATES else name for name in outer]
    return ["contact model", *labels, "estimator", *(variable.heading for variable in shown.values())], rows


def _with_extremes(dataset: xr.Dataset) -> xr.Dataset:
    """Summarise a landscape by its extremes."""
    least = dataset["smoothed"].fillna(np.inf).argmin("point")
    return dataset.assign(
        least_cost=dataset["smoothed"].min("point"),
        least_at=dataset["position"].isel(point=least),
        steepest=abs(dataset["slope"]).max("point"),
    )


def _reduced(variable: Variable, values: xr.DataArray) -> str:
    """Reduce to a number: counts to their sum, others to the median over the seeds and the last tenth of iterations."""
    array = np.asarray(values.values, float)
    if variable.digits == 0:
        return variable.text(float(np.nansum(array)))
    if "iteration" in values.dims:
        array = np.moveaxis(array, values.dims.index("iteration"), 0)[-max(1, values.sizes["iteration"] // 10) :]
    array = array[np.isfinite(array)]
    return variable.text(float(np.median(array)) if len(array) else None)


def _provenance(dataset: xr.Dataset) -> list[list[str]]:
    environment = json.loads(dataset.attrs["environment"])
    versions = environment.pop("versions")
    found = environment | versions
    if "revision" in dataset.attrs:
        found["revision"] = dataset.attrs["revision"]
    return [[name, _shown(value)] for name, value in found.items()]


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(_shown(each) for each in value)
    return str(value)
