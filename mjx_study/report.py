"""A study as one self-contained HTML page: warnings, figures, tables, configuration, and the command that made it."""

import base64
import html
import io
import itertools
import json
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import xarray as xr

from mjx_study.plots.study import SWEPT, plot_study
from mjx_study.study.run import warnings_of

STYLE: Final = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 0.15rem 0.7rem; text-align: right; border-bottom: 1px solid #eee; } th { border-color: #999; }
td:first-child, th:first-child { text-align: left; }
.wide { overflow-x: auto; } .warning { background: #fff4d6; padding: 0.4rem 0.8rem; margin: 0.3rem 0; }
figure { margin: 1.5rem 0; } figure img { max-width: 100%; } figcaption { color: #555; font-size: 13px; }
code, pre { background: #f4f4f4; padding: 0.1rem 0.3rem; } pre { padding: 0.6rem; overflow-x: auto; }
"""
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
KINDS: Final = {"gradients": "gradient estimates", "descents": "gradient descent", "landscapes": "landscapes"}
SUMMARY: Final = {
    "gradients": "Medians over the seeds, at the largest sample count.",
    "descents": "Medians over the seeds, at the largest sample count.",
    "landscapes": "At the largest sample count.",
}
PRESENT: Final = ("residual", "rollouts", "unconverged")
"""For every kind of study, a variable that is finite wherever a cell has been computed."""
COLUMNS: Final = {
    "variance": "variance",
    "effective_samples": "effective samples",
    "top_share": "top share",
    "relative_error": "relative error",
    "debiased_error": "debiased",
    "squared_bias": "squared bias",
    "squared_bias_se": "± (standard error)",
    "alpha": "alpha",
    "nonfinite": "nan",
    "least_cost": "least mean cost",
    "least_at": "at t",
    "steepest": "steepest slope",
    "final_cost": "final cost, median",
    "stopped_at": "stopped seeds",
}


def report(dataset: xr.Dataset) -> str:
    config = json.loads(dataset.attrs["config"])
    tasks = ", ".join(config["tasks"])
    kind = KINDS[config["kind"]]
    warnings = warnings_of(dataset)
    parts = [
        f"<h1>{_text(tasks)}: {kind} through {dataset.sizes['model']} contact models</h1>",
        *_paragraphs("warning", warnings),
        "<h2>Figures</h2>",
        *_figures(dataset),
        "<h2>Numbers</h2>",
        f"<p>{SUMMARY[config['kind']]} <code>results.nc</code> has all numbers.</p>",
        _numbers(dataset),
        "<h2>Configuration</h2>",
        _table(
            ["option", "value"], [[key, _shown(value)] for key, value in sorted(config.items()) if value is not None]
        ),
        "<h2>Provenance</h2>",
        _table(["what", "value"], _provenance(dataset)),
        "<h2>To run it again</h2>",
        _again(dataset),
    ]
    head = f'<meta charset="utf-8"><title>{_text(tasks)}: {kind}</title><style>{STYLE}</style>'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n' + "\n".join(parts) + "\n</body></html>\n"


def _again(dataset: xr.Dataset) -> str:
    if command := dataset.attrs.get("command"):
        return f"<pre>{_text(command)}</pre>"
    return "<p>It was run from Python: <code>run_study</code> with the configuration above.</p>"


def _figures(dataset: xr.Dataset) -> list[str]:
    found = []
    for name, figure in plot_study(dataset).items():
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=110)
        caption = next(text for key, text in CAPTIONS.items() if name.startswith(key))
        data = base64.b64encode(file.getvalue()).decode()
        found.append(
            f'<figure><img alt="{_text(name)}" src="data:image/png;base64,{data}">'
            f"<figcaption>{_text(caption)}</figcaption></figure>"
        )
    return found or ["<p>No figure yet: no cell is computed.</p>"]


def _numbers(dataset: xr.Dataset) -> str:
    """The table of numbers, a row for each cell and estimator."""
    if not dataset.data_vars:
        return ""
    if "smoothed" in dataset:
        dataset = _with_extremes(dataset)
    outer = [name for name in ("task", "timestep", "cone", "sigma") if dataset.sizes[name] > 1]
    variables = [name for name in COLUMNS if name in dataset]
    last = dataset.isel(samples=-1)
    rows = []
    for picked in itertools.product(*(range(dataset.sizes[name]) for name in outer)):
        part = last.isel(dict(zip(outer, picked, strict=True)))
        part = part.squeeze([name for name in ("task", "timestep", "cone", "sigma") if name in part.dims])
        for model, estimator in itertools.product(part["model"].values, part["estimator"].values):
            one = part.sel(model=model, estimator=estimator)
            numbers = [_reduced(name, one[name]) for name in variables]
            if any(np.isfinite(one[name]).all() for name in PRESENT if name in one):
                place = [_shown(part[name].item()) for name in outer]
                rows.append([str(model), *place, str(estimator), *map(_shown, numbers)])
    titles = ["contact model", *(SWEPT.get(name, name) for name in outer), "estimator"]
    return _table([*titles, *(COLUMNS[name] for name in variables)], rows)


def _with_extremes(dataset: xr.Dataset) -> xr.Dataset:
    """A landscape summarised by its extremes."""
    least = dataset["smoothed"].fillna(np.inf).argmin("point")
    found = {
        "least_cost": dataset["smoothed"].min("point"),
        "least_at": dataset["position"].isel(point=least),
        "steepest": abs(dataset["slope"]).max("point"),
        "nonfinite": dataset["nonfinite"].sum("point"),
    }
    return dataset.drop_vars(["nonfinite"]).assign(found)


def _reduced(name: str, values: xr.DataArray) -> float:
    """One number for all seeds, and for the last tenth of the iterations."""
    array = np.asarray(values.values, float)
    if name == "stopped_at":
        return float(np.sum(np.isfinite(array)))
    if name == "nonfinite":
        return float(np.nansum(array))
    if "iteration" in values.dims:
        array = np.moveaxis(array, values.dims.index("iteration"), 0)[-max(1, values.sizes["iteration"] // 10) :]
    array = array[np.isfinite(array)]
    return float(np.median(array)) if len(array) else float("nan")


def _provenance(dataset: xr.Dataset) -> list[list[str]]:
    environment = json.loads(dataset.attrs["environment"])
    versions = environment.pop("versions")
    rows = [[name, _shown(value)] for name, value in environment.items()]
    rows += [[name, version] for name, version in versions.items()]
    return rows + [["revision", dataset.attrs["revision"]]] if "revision" in dataset.attrs else rows


def _paragraphs(kind: str, texts: Sequence[str]) -> list[str]:
    return [f'<p class="{kind}">{_text(text)}</p>' for text in texts]


def _table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{_text(title)}</th>" for title in titles)
    body = "\n".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(_shown(each) for each in value)
    return str(value)


def _text(text: str) -> str:
    return html.escape(str(text))
