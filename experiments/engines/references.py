"""Reader of data/reference-gradients.npz and its index, with NumPy alone: copy this file to test a simulator.

An entry is a dictionary: scene, timestep [s], theta, sigma; position [bodies, 3] and value (the cost) at the end of the
rollout at theta, its derivative; and, under normal noise sigma of theta, mean_value, mean_derivative and slope, that of
mean_value. Each of these five numbers has its uncertainty, and position one of all its components, in `uncertainty`.
`index["scenes"]` has what to simulate: MJCF, the state at the start, which number of it theta replaces, steps and cost.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

NUMBERS = ("value", "derivative", "mean_value", "mean_derivative", "slope")


def read(stem: str | Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the index and the entries of STEM.json and STEM.npz."""
    index = json.loads(Path(stem).with_suffix(".json").read_text())
    with np.load(Path(stem).with_suffix(".npz")) as arrays:
        columns = {name: arrays[name] for name in arrays.files}
    entries = []
    for row, entry in enumerate(index["entries"]):
        numbers = {name: float(columns[name][row]) for name in (*NUMBERS, "theta", "sigma", "timestep")}
        position = columns["position"][row, : index["scenes"][entry["scene"]]["bodies"]]
        uncertainty = {name: float(columns[f"{name}_uncertainty"][row]) for name in (*NUMBERS, "position")}
        entries.append({**entry, **numbers, "position": position, "uncertainty": uncertainty})
    return index, entries


def deviations(entry: dict[str, Any], found: dict[str, Any]) -> dict[str, float]:
    """Return by how many uncertainties numbers of the same names differ from an entry's."""
    least = {name: entry["uncertainty"][name] + 1e-12 for name in found}
    return {name: float(np.max(np.abs(found[name] - entry[name])) / least[name]) for name in found}
