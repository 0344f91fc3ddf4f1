"""Landscapes of a study as curves along a line, and where the mean of FoBG differs from the slope of the mean cost."""

from typing import Final

import numpy as np
import xarray as xr

from estimators.registry import label_of
from mjx_study.results.findings import NOTABLE_SHARE
from mjx_study.results.rows import SETTING, model_name, onset_of
from mjx_study.results.variables import THETA
from mjx_study.table import percent

DETECTED_SE: Final = 4.0
"""Standard errors beyond which two means are considered different."""


def curves_of(dataset: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """Computed cells of a study of landscapes: contact model, and its numbers along the line."""
    outer = (*SETTING, "model")
    places = np.ndindex(*(dataset.sizes[name] for name in outer))
    cells = [dataset.isel(dict(zip(outer, place, strict=True))) for place in places]
    return [(model_name(one), one) for one in cells if bool(one["position"].notnull().any())]


def line_of(dataset: xr.Dataset) -> tuple[str, str]:
    """Symbol of the position along a landscape's line, and its unit, empty if it is not known."""
    unit = dataset["position"].attrs.get("units", THETA)
    return "t" if dataset.attrs["many_parameters"] else "theta", "" if unit == THETA else unit


def landscape_findings(dataset: xr.Dataset) -> list[str]:
    """Report where the mean of FoBG differs from the slope of the mean cost, and costs that are least at an end."""
    both, name = {"zobg", "fobg"} <= set(dataset["estimator"].values), label_of("fobg", onset_of(dataset))
    curves = curves_of(dataset)
    found = [f"{label}: {_gap(one, f'E[{name}]')}" for label, one in curves] if both else []
    ends = [label for label, one in curves if int(least_of(one)) in (0, one.sizes["point"] - 1)]
    if ends:
        found.append(f"{', '.join(ends)}: the mean cost is least at an end of the line; --span makes it longer")
    return found


def least_of(dataset: xr.Dataset) -> xr.DataArray:
    """Index of the point with the lowest mean cost, of every curve."""
    return dataset["smoothed"].fillna(np.inf).argmin("point")


def _gap(one: xr.Dataset, mean: str) -> str:
    """Report where the mean of FoBG differs from the slope of the mean cost, by quadrature if available."""
    if "exact_slope" in one and bool(one["exact_slope"].notnull().all()):
        first, slope = one["exact_first"].values, one["exact_slope"].values
        largest = float(np.max(np.abs(slope)))
        error = 3 * (one["exact_slope_error"].values + one["exact_first_error"].values) + NOTABLE_SHARE * largest
        source, uncertainty = "the mean cost's slope", f"more than {percent(NOTABLE_SHARE)} of its largest value"
    else:
        first, slope = (one["slope"].sel(estimator=name).values for name in ("fobg", "zobg"))
        error = DETECTED_SE * np.hypot(*(one["slope_se"].sel(estimator=name).values for name in ("fobg", "zobg")))
        source, uncertainty = "E[ZoBG]", f"more than {DETECTED_SE:g} standard errors"
    seen = np.abs(first - slope) > error
    if not np.any(seen):
        lost = error >= np.nanmax(np.abs(first), initial=0.0)
        blind = f"; at {percent(float(np.mean(lost)))} of the points those exceed all of {mean}: take more --samples"
        return f"{mean} nowhere differs from {source} by {uncertainty}" + blind * bool(np.any(lost))
    name, unit = line_of(one)
    unit = f" {unit}" if unit else ""
    worst = int(np.argmax(np.where(seen, np.abs(first - slope), -np.inf)))
    return (
        f"{mean} differs from {source} by {uncertainty} at {percent(float(np.mean(seen)))} of the points, most at "
        f"{name} = {one['position'].values[worst]:.3g}{unit}, where it is {first[worst]:.3g} in place of "
        f"{slope[worst]:.3g}"
    )
