"""Limits of axes that follow what is finite and stable, and marks at their edges for what cannot be drawn."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from mjx_study.plots.panels import positive, unstable
from mjx_study.results.warnings import EXPLODED

UNDRAWN: Final = "no finite number (below: 0)"
INSET: Final = 0.03
"""Distance of crosses from the edges and half of that between them, as a share of the axis."""
EXTRA: Final = 1e3
"""Maximum ratio by which an axis goes on for contact models that it does not follow."""


LARGEST: Final = 1e140
"""Size to which numbers are limited, and the inverse of the smallest positive one: their squares do not overflow."""


def drawable(values: xr.DataArray) -> xr.DataArray:
    """Numbers that figures can compute with; infinite ones become NaN."""
    if values.dtype.kind != "f":
        return values
    size = abs(values)
    limited = xr.where(size > 0, np.sign(values) * size.clip(1 / LARGEST, LARGEST), values)
    return limited.where(np.isfinite(values)).astype(values.dtype).transpose(*values.dims)


def sane(rows: xr.Dataset, names: Sequence[str]) -> np.ndarray:
    """Mask of the contact models that axes follow: the step is stable, and no value is missing or huge."""
    fit = ~unstable(rows)
    for each in (rows[name] for name in names if name in rows):
        finite = abs(each) < EXPLODED  # and not NaN
        fit &= np.asarray(finite.all([name for name in each.dims if name != "model"]))
    return fit


def limits(part: xr.Dataset, names: Sequence[str], room: float) -> tuple[float, float] | None:
    """Ends of a logarithmic axis for variables: those of sane contact models times `room` to each side, and up to
    `EXTRA` for the others; without sane ones the smallest values up to `EXTRA`. None without positive values."""

    def known(mask: np.ndarray) -> np.ndarray:
        some = part.isel(model=np.flatnonzero(mask))
        values = np.concatenate([positive(some[name]).ravel() for name in names if name in some])
        return values[np.isfinite(values)]

    every = known(np.ones(part.sizes["model"], bool))
    if not len(every):
        return None
    followed = known(sane(part, names))
    low, high = (followed.min(), followed.max()) if len(followed) else (every.min(), every.min())
    every = every[(every >= low / EXTRA) & (every <= high * EXTRA)]
    return float(every.min()) / room, float(every.max()) * room


def mark_undrawn(axes: Axes, x: np.ndarray, values: np.ndarray, style: Mapping[str, Any]) -> None:
    """Mark values that a logarithmic axis cannot show with crosses at its edges: nonfinite ones above, zeros below."""
    values, inset = np.asarray(values, float), INSET * (1 + 2 * style["rank"])
    for missing, at in ((~np.isfinite(values), 1 - inset), (values <= 0, inset)):
        if missing.any():
            axes.plot(
                x[missing], np.full(np.count_nonzero(missing), at), "x", color=style["color"], markersize=5,
                transform=axes.get_xaxis_transform(), label=UNDRAWN,
            )  # fmt: skip
