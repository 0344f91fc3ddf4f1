"""The table of a study's numbers, in reports and on the terminal."""

import math
from typing import Any

import numpy as np
import xarray as xr

from mjx_study.results.kind import kind_of
from mjx_study.results.rows import label_in, model_name, remains
from mjx_study.results.variables import COORDINATES, DEBIASED, Variable
from mjx_study.table import with_error


def numbers_of(dataset: xr.Dataset) -> tuple[list[str], list[list[str]]] | None:
    """Titles of a study's table, and a row for each cell and estimator; what all rows of a cell share, once."""
    if not dataset.data_vars:
        return None
    kind = kind_of(dataset)
    dataset, quantities = kind.summarised(dataset), kind.quantities
    axes = ("task", "timestep", "cone", "sigma", "model", "estimator")
    outer = [name for name in axes[:4] if dataset.sizes[name] > 1]
    columns = {name: quantities[name] for name in kind.columns if name in dataset}
    last = dataset.isel(samples=-1)
    labels = [COORDINATES[name].label if name in COORDINATES else name for name in outer]
    titles = ["contact model", *labels, "estimator", *(variable.heading for variable in columns.values())]
    shared = [True] * (1 + len(outer)) + [False] + ["estimator" not in each.dims for each in columns.values()]
    rows, above = [], None
    for picked in np.ndindex(*(dataset.sizes[name] for name in axes)):
        one = last.isel(dict(zip(axes, picked, strict=True)))
        if one[kind.computed].notnull().all():
            label = label_in(dataset, one["estimator"].item())
            where = [model_name(one), *(shown(one[name].item()) for name in outer), label]
            row = [*where, *(_text(name, variable, one) for name, variable in columns.items())]
            rows.append(["" if picked[:-1] == above and once else cell for cell, once in zip(row, shared, strict=True)])
            above = picked[:-1]
    filled = [index for index in range(len(titles)) if any(row[index] not in ("", "-") for row in rows)]
    return [titles[index] for index in filled], [[row[index] for index in filled] for row in rows]


def meanings_of(dataset: xr.Dataset) -> dict[str, str]:
    """What the headings of a study's quantities mean."""
    kind = kind_of(dataset)
    return {kind.quantities[name].heading: kind.quantities[name].description for name in kind.columns}


def _text(name: str, variable: Variable, one: xr.Dataset) -> str:
    """Sum of counts, median of others over seeds and the last tenth of iterations; of a single one with error or
    interval."""
    values, error = one[name], one.get(f"{name}_se")
    error = math.nan if error is None or error.size > 1 else error.item()
    if "iteration" in values.dims and variable.digits:
        values = values.isel(iteration=slice(-max(1, values.sizes["iteration"] // 10), None))
    ends = [one[f"{name}_{end}"] for end in ("lower", "upper") if f"{name}_{end}" in one]
    if ends and all(each.size == 1 for each in (values, *ends)) and np.isfinite(values.item()):
        return variable.interval(values.item(), *(each.item() for each in ends))
    array = values.values[np.isfinite(values.values)].astype(float)
    if len(array) == 0:
        return "-"
    if variable.digits == 0:
        return variable.text(float(np.sum(array)))
    if name == DEBIASED["relative_error"]:
        return remains("relative_error", float(one["relative_error"].median()), float(np.median(array)), error)
    return with_error(variable.factor * float(np.median(array)), variable.factor * error, variable.digits)


def shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, list):
        return ", ".join(shown(each) for each in value)
    return str(value)
