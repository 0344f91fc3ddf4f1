"""What is measured of a cell, an engine in a scene at a step, and what that shows.

The slope of the mean cost comes from values alone, in two ways: by the score function on one grid, and by differences
of the mean over strata of the noise (the same for both sides). So does the mean of the derivative: over the grid, and
over the strata.
"""

import math
import time
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any, Final

import numpy as np

from experiments.engines.scenes import LENGTH, PIVOT, RADIUS, Scene, Simulate, scene_named

REACH: Final = 5.0  # the grid's half width, in standard deviations
SHIFT: Final = 0.2  # shift of the parameter on each side in differences of the mean, in standard deviations
MANY: Final = {"grid": 400, "strata": 400, "points": 200}
MORE: Final = {"grid": 1600, "strata": 1600, "points": 200}
FEW: Final = {"grid": 100, "strata": 100, "points": 50}
AGREES, DIFFERS = 0.03, 0.1
"""Relative errors of the mean up to which it is called right, and from which wrong; in between it is close."""
STILL: Final = 1e-7  # change of the end with the noise [m] up to which a body is called at rest
POINTS: Final = 0.9
"""Share of the points at which a derivative must be that of differences for it to be called right there."""


def measure(simulate: Simulate, scene: Scene, counts: Mapping[str, int], *, single: bool) -> dict[str, Any]:
    """Return the numbers of a cell.

    Args:
        counts: numbers of rollouts: of the `grid`, of `strata` (three times), of differences at `points` (twice).
        single: whether the engine computes in float32, where differences need longer steps.
    """
    center, sigma = scene.center, scene.sigma
    began = time.perf_counter()
    first = simulate(np.array([center]))
    compiled = time.perf_counter() - began
    z = REACH * (2 * (np.arange(counts["grid"]) + 0.5) / counts["grid"] - 1)
    began = time.perf_counter()
    grid = simulate(center + sigma * z)
    seconds = (time.perf_counter() - began) / len(z)
    slope, mean, variance = _on_grid(z, grid.values, grid.derivatives, sigma)
    coarse = _on_grid(z[::2], grid.values[::2], grid.derivatives[::2], sigma)
    inverse, size = NormalDist().inv_cdf, counts["strata"]
    strata = np.array([inverse((i + 0.5) / size) for i in range(size)])
    below, middle, above = (simulate(center + sigma * (strata + shift)) for shift in (-SHIFT, 0, SHIFT))
    difference = float(np.mean(above.values - below.values)) / (2 * SHIFT * sigma)
    # Points at the middle of the noise, off the grid; a step of the differences that rounding allows.
    thetas = center + sigma * np.array([inverse((i + 0.37) / counts["points"]) for i in range(counts["points"])])
    reach = (2e-3 if single else 1e-5) * sigma
    at = simulate(thetas)
    lower, upper = simulate(thetas - reach), simulate(thetas + reach)
    differences = (upper.values - lower.values) / (2 * reach)
    scale = np.maximum(np.abs(differences), 0.01 * np.sqrt(np.nanmean(differences**2)) + 1e-12)
    # One-sided differences disagree where rounding or a jump does not let them decide, in single precision.
    vague = np.abs(upper.values - 2 * at.values + lower.values) / (2 * reach) if single else np.zeros(len(thetas))
    errors = np.maximum(np.abs(at.derivatives - differences) - vague, 0) / scale
    exact = None if scene.exact is None else float(first.values[0] - scene.exact(np.array(center)))
    nominal = len(thetas) // 2
    return {
        "slope": slope,
        "slope_error": abs(slope - coarse[0]),
        "slope_by_differences": difference,
        "mean": mean,
        "mean_error": abs(mean - coarse[1]),
        "mean_of_strata": float(np.mean(middle.derivatives)),
        "sd": math.sqrt(max(variance, 0)),
        "point_error": float(np.median(errors)),
        "point_share": float(np.mean(errors < (0.1 if single else 0.01))),
        "vague_share": float(np.mean(vague > 0.1 * scale)),
        "nan_share": float(np.mean(~np.isfinite(at.derivatives))),
        "zero_share": float(np.mean((at.derivatives == 0) & (np.abs(differences) > 1e-3 * np.abs(slope) + 1e-9))),
        "seconds_per_gradient": seconds,
        "seconds_to_start": compiled,
        "state": first.positions[0].tolist(),
        "state_error": exact,
        "theta": center,
        "value": float(first.values[0]),
        "derivative": float(first.derivatives[0]),
        "samples": [[float(each[nominal]) for each in (thetas, at.derivatives, differences)]],
        "counts": dict(counts),
        "single": single,
    }


def _on_grid(z: np.ndarray, values: np.ndarray, derivatives: np.ndarray, sigma: float) -> tuple[float, float, float]:
    """Slope of the mean value, mean of the derivative and its variance, under normal noise."""
    width = z[1] - z[0]
    density = np.exp(-(z**2) / 2)
    total = density.sum()
    score = -np.diff(np.exp(-(np.append(z - width / 2, z[-1] + width / 2) ** 2) / 2)) / width
    mean = density @ derivatives / total
    return float(score @ values / total / sigma), float(mean), float(density @ (derivatives - mean) ** 2 / total)


def verdict(cell: Mapping[str, Any]) -> str:
    """Return what one cell shows.

    `right`, at points and on average; `close`, right at points and off by little; `biased`, right at points alone;
    `average`, right on average alone; `wrong`; `none`, no derivatives or NaN everywhere; `no contact`, the body went
    through a plane; `no joint`, the pendulum left its rod; `at rest`, the end does not depend on the parameter; `-`,
    the engine has no such scene; or `unknown`: the two ways to the slope or to the mean differ by more than the verdict
    bears.
    """
    if "error" in cell:
        return "-"
    if (lost := lost_constraint(cell)) is not None:
        return lost
    if cell.get("nan_share") == 1:
        return "none"
    slope, mean = cell["slope"], cell["mean"]
    if not all(math.isfinite(cell[key]) for key in ("slope", "mean", "mean_of_strata", "point_error")):
        return "unknown"
    if max(abs(slope), abs(mean)) * scene_named(cell["scene"]).sigma < STILL:
        return "at rest"
    unsure = max(abs(slope - cell["slope_by_differences"]), cell["slope_error"])
    vague = max(abs(mean - cell["mean_of_strata"]), cell["mean_error"])
    off, scale = abs(mean - slope), max(abs(slope), 1e-9)
    agrees = off < AGREES * scale and abs(slope - cell["slope_by_differences"]) < AGREES * scale
    agrees = agrees and abs(mean - cell["mean_of_strata"]) < AGREES * scale
    differs = off - 2 * (unsure + vague) > DIFFERS * scale
    if cell["point_share"] >= POINTS:
        close = AGREES * scale < off - unsure - vague and off + unsure + vague < DIFFERS * scale
        return "right" if agrees else "biased" if differs else "close" if close else "unknown"
    return "average" if agrees else "wrong" if differs else "unknown"


def lost_constraint(cell: Mapping[str, Any]) -> str | None:
    """Return `no contact` if a cell's body ends with its center within half its radius of a plane, or behind it, and
    `no joint` if a pendulum's length is off by a tenth or NaN."""
    if "state" not in cell:
        return None
    scene, (x, _, z) = scene_named(cell["scene"]), cell["state"][0]
    if scene.bodies[0].shape == "pendulum":
        return None if abs(math.hypot(x, z - PIVOT) - LENGTH) < 0.1 * LENGTH else "no joint"
    return "no contact" if (scene.floor and z < RADIUS / 2) or (scene.wall and x > scene.wall - RADIUS / 2) else None


def combined(cells: Sequence[Mapping[str, Any] | None]) -> str:
    """Return the verdict that a scene's cells share; else each one's, a dash where nothing was measured."""
    found = ["-" if cell is None else verdict(cell) for cell in cells]
    return found[0] if len(set(found)) == 1 else ", ".join(found)
