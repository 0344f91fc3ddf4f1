"""Labelled arrays of a study's numbers, assembled from its document and cells."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from mjx_study.disk import write_whole
from mjx_study.results.kind import find_kind
from mjx_study.results.variables import COORDINATES, THETA, with_metrics

Cells = Mapping[int, tuple[Mapping[str, np.ndarray], Mapping[str, str]]]
"""Arrays by variable of each cell, by index, with the versions of the software that computed them."""


def dataset_of(document: Mapping[str, Any], cells: Cells) -> xr.Dataset:
    """Collect all cells of a study in labelled arrays; NaN where a cell is missing.

    In the document, each cell has the key "at", its index along every outer dimension, and solref and solimp of its
    contact unless the MJCF's apply.
    """
    config, entries = document["config"], document["cells"]
    outer = tuple(entries[0]["at"])
    solver = [
        {name: np.array(each.get(name) or [np.nan] * size) for name, size in (("solref", 2), ("solimp", 5))}
        for each in entries
    ]
    cells = {index: (solver[index] | dict(arrays), by) for index, (arrays, by) in cells.items()}
    axes = dict(document["axes"])
    axes |= {name: [float(value) for value in axes[name]] for name in ("timestep", "sigma")}  # JSON may say 1
    kind = find_kind(config["kind"])
    inner: dict[str, Sequence[Any]] = {"estimator": config["estimators"], "seed": range(config["seeds"])}
    dimensions = axes | inner | kind.axes(config)
    shape = tuple(len(dimensions[name]) for name in outer)
    data: dict[str, Any] = {}
    units = {entry.get("unit", "") for entry in document["resolved"]}
    unit = (units.pop() if len(units) == 1 else "") or THETA
    names = sorted({name for arrays, _ in cells.values() for name in arrays})
    for name, variable in with_metrics(kind.variables, names).items():
        held = {index: arrays[name] for index, (arrays, _) in cells.items() if name in arrays}
        if not held:
            continue
        sizes = np.max([array.shape for array in held.values()], axis=0, initial=0).astype(int)  # params may differ
        within = [len(dimensions.get(dim, range(size))) for dim, size in zip(variable.dims, sizes, strict=True)]
        values = np.full((*shape, *within), np.nan)
        for index, array in held.items():
            at = tuple(entries[index]["at"][dimension] for dimension in outer)
            values[(*at, *(slice(size) for size in array.shape))] = array
        attributes = {"units": unit if variable.unit == THETA else variable.unit, "long_name": variable.description}
        data[name] = ((*outer, *variable.dims), values, attributes)
    used = {dimension for dims, *_ in data.values() for dimension in dims} | set(outer)
    coordinates: dict[str, Any] = {name: (name, list(values)) for name, values in dimensions.items() if name in used}
    coordinates["contact"] = ("model", [model["contact"] for model in document["models"]])
    coordinates["stiffness"] = ("model", [float(model["stiffness"]) for model in document["models"]])
    dataset = xr.Dataset(data, coordinates)
    for name, coordinate in COORDINATES.items():
        dataset[name].attrs = {"units": coordinate.unit, "long_name": coordinate.description}
    dataset.attrs = {
        key: json.dumps(value) if isinstance(value, dict | list) else value
        for key, value in document.items()
        if key not in ("cells", "format") and value is not None
    }
    dataset.attrs["many_parameters"] = int(any(entry.get("parameters", 1) > 1 for entry in document["resolved"]))
    dataset.attrs["missing_cells"] = len(entries) - len(cells)
    dataset.attrs["mixed_versions"] = _mixture([versions for _, versions in cells.values()])
    return dataset


def _mixture(versions: Sequence[Mapping[str, str]]) -> str:
    """Packages that differ in version between cells, with these versions; empty if there are none."""
    names = dict.fromkeys(name for each in versions for name in each)
    split = {name: [part for each in versions for part in each.get(name, "none").split(" and ")] for name in names}
    found = {name: dict.fromkeys(parts) for name, parts in split.items()}
    return ", ".join(f"{name} {' and '.join(parts)}" for name, parts in found.items() if len(parts) > 1)


def write_dataset(dataset: xr.Dataset, path: Path) -> Path:
    """Write a dataset as NetCDF 3, which every NetCDF tool reads."""
    content = dataset.to_netcdf(engine="scipy")
    return write_whole(path, lambda file: file.write(bytes(content)))
