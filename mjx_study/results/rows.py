"""A study's numbers as rows: gradient estimates, the table of reports and of the terminal, and the names in both."""

import json
import math
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import xarray as xr

from estimators import ENOUGH_EFFECTIVE, ESTIMATORS
from estimators.registry import label_of
from mjx_study.results.kind import kind_of
from mjx_study.results.variables import COORDINATES, DEBIASED, GRADIENTS, ONSETS, Variable
from mjx_study.table import number, with_error

BIASED_P_VALUE: Final = 0.001
"""p-value at which a mean is called biased: the smallest that the test's 999 draws can yield."""
SETTING: Final = ("task", "timestep", "cone", "sigma", "samples")
"""Outer coordinates besides the contact model."""
AXES: Final = (*SETTING, "model", "seed", "estimator")
"""Dimensions along which there is a row for each index."""
COORDINATES_OF_ROWS: Final = (*AXES, "contact", "stiffness")


class Row(SimpleNamespace):
    """One gradient estimate: its coordinates and every scalar variable of `GRADIENTS`; None where not applicable."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"a row has no {name}")

    @property
    def believable(self) -> bool:
        """Whether the batch has enough effective samples for its errors to be meaningful."""
        return self.effective_samples >= ENOUGH_EFFECTIVE

    @property
    def bias_verdict(self) -> str:
        """Result of the test for bias: "biased", "none seen", or "too few effective samples"."""
        if not min(self.effective_samples, self.reference_effective_samples) >= ENOUGH_EFFECTIVE:
            return "too few effective samples"
        return "biased" if self.bias_p_value <= BIASED_P_VALUE else "none seen"

    def as_dict(self) -> dict[str, Any]:
        """All variables by name, derived ones included."""
        return vars(self) | {"variance_seconds": self.variance_seconds, "bias_verdict": self.bias_verdict}

    @property
    def variance_seconds(self) -> float:
        """Variance times seconds per sample: the variance remaining after one second of computing."""
        return self.variance * self.seconds_per_sample


def rows_of(dataset: xr.Dataset) -> list[Row]:
    """Return a row for each computed estimate; contact model, seed and estimator vary fastest."""
    rows = []
    names = [name for name, variable in GRADIENTS.items() if name in dataset and "param" not in variable.dims]
    table, vectors = dataset[names].to_dataframe(dim_order=list(AXES)).reset_index(), []
    for name in (name for name in ("solref", "solimp") if name in dataset):
        values = dataset[name].broadcast_like(dataset["gradient_norm"]).transpose(*AXES, f"{name}_entry")
        table[name] = list(map(tuple, values.values.reshape(len(table), -1).tolist()))
        vectors.append(name)
    computed = table.loc[table["residual"].notna(), [*COORDINATES_OF_ROWS, *vectors, *names]]
    for numbers in computed.to_dict("records"):
        for name in ("alpha", "epsilon", "discrepancy", *ONSETS):
            if math.isnan(numbers.get(name, math.nan)):
                numbers[name] = None
        counts = [name for name in names if GRADIENTS[name].digits == 0 and numbers[name] is not None]
        rows.append(Row(**numbers | {name: int(numbers[name]) for name in counts}))
    return rows


def remains(name: str, value: float, debiased: float, error: float) -> str:
    """Format what remains of one of `DEBIASED` without noise: a bound if no error is detected, "-" if noise explains
    all of it, or if nothing is left and the standard error is unknown."""
    best = 1.0 if name == "cosine" else 0.0
    if math.isnan(debiased) or (debiased == best and math.isnan(error)):
        return "-"
    if not (debiased == best and 0 < error < math.inf):
        return with_error(debiased, error)
    if abs(debiased - value) <= 2 * error:
        return "-"
    decimals = 2 if error >= 0.005 else 4
    above = best - math.ceil(10**decimals * 2 * error) / 10**decimals
    return f"< {number(2 * error, 2)}" if best == 0 else f"> {above:.{decimals}f}"


def onset_of(dataset: xr.Dataset) -> str:
    """Onset term of a study's first-order batches."""
    return json.loads(dataset.attrs["config"]).get("onset", "none")


def estimators_of(dataset: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Label and needs of each estimator of a study, by name, as its plan recorded them."""
    return json.loads(dataset.attrs.get("described", "{}"))


def label_in(dataset: xr.Dataset, name: str) -> str:
    """Label of an estimator in texts and figures of a study; a user-defined one has that which its plan recorded."""
    known = {} if name in ESTIMATORS else estimators_of(dataset).get(name, {})
    return known.get("label") or label_of(name, onset_of(dataset))


def model_name(one: xr.Dataset) -> str:
    """Contact family of a part of a study with one contact model, and its stiffness if it has one."""
    family = one["contact"].item()
    stiffness = one["model"].item().removeprefix(family)
    return f"{family}, K ={stiffness} N/m" if stiffness else family


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
