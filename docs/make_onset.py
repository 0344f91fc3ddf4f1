"""Prints the tables of docs/onset-correction.md on `momentum_transfer` and `ball_wall`, by quadrature.

Run as python docs/make_onset.py; half an hour on one core, nothing is kept.
"""

import numpy as np

from estimators import NOISES
from mjx_study.runtime import configure
from mjx_study.simulation.contact import family_model
from mjx_study.study.quadrature import Line, Means, grid, means
from mjx_study.tasks import make_task
from mjx_study.tasks.task import Task

ANGLES = {"momentum_transfer": (0.3, 0.5, 0.7), "ball_wall": (0.2, 0.7, 0.9)}
TREATMENTS = ("none", "linear", "jump")
TIMESTEPS = (0.004, 0.002, 0.001, 0.0005)
POINTS = 20_000


def measure(task: Task, angles: tuple[float, ...]) -> tuple[Means, list[list[float]]]:
    """Means at the angles through MuJoCo's default contact; deviations there of one ZoBG and one FoBG sample."""
    contact = family_model("mujoco_default", task.scene, effective_mass=task.effective_mass)
    position = np.array(angles)
    points = grid(position.min(), position.max(), task.sigma, POINTS, task.noise)
    values, slopes = Line(task)(points, contact)
    noise, deviations = NOISES[task.noise], []
    for at in position:
        w = (points - at) / task.sigma
        zeroth = (values - np.interp(at, points, values)) * w / task.sigma  # Gaussian noise
        deviations.append([_deviation(each, noise.density(w)) for each in (zeroth, slopes)])
    return means(points, values, slopes, position, task.sigma, task.noise), deviations


def _deviation(samples: np.ndarray, weights: np.ndarray) -> float:
    mean = np.average(samples, weights=weights)
    return float(np.average((samples - mean) ** 2, weights=weights) ** 0.5)


def main() -> None:
    """Print Markdown."""
    configure(cpu_devices=1)
    for name, angles in ANGLES.items():
        found = {onset: measure(make_task(name).replace(onset=onset), angles) for onset in TREATMENTS}
        plain, deviations = found["none"]
        _print(f"`{name}`", [f"{angle} rad" for angle in angles])
        _print("slope", _with_errors(plain.slope, plain.slope_error))
        for onset, (each, _) in found.items():
            _print(onset, _with_errors(each.first, each.first_error))
        _print("deviation: ZoBG", [f"{zeroth:.3g}" for zeroth, _ in deviations])
        each = [[own[index][1] for _, own in found.values()] for index in range(len(angles))]
        _print("FoBG, linear, jump", [", ".join(f"{value:.2g}" for value in row) for row in each])
        for onset in ("linear", "jump"):
            ratios = [(zeroth / own[1]) ** 2 for (zeroth, _), own in zip(deviations, found[onset][1], strict=True)]
            _print(f"variance of ZoBG over {onset}", [f"{ratio:.2g}" for ratio in ratios])
    _print("`momentum_transfer`, h", [f"{angle} rad" for angle in ANGLES["momentum_transfer"]])
    for timestep in TIMESTEPS:
        steps = round(0.002 / timestep * make_task("momentum_transfer").horizon)
        task = make_task("momentum_transfer", timestep=timestep, horizon=steps)
        for onset in ("linear", "jump"):
            each, _ = measure(task.replace(onset=onset), ANGLES["momentum_transfer"])
            _print(f"{onset}, {1e3 * timestep:g} ms", [f"{error:.2%}" for error in abs(each.first / each.slope - 1)])


def _with_errors(values: np.ndarray, errors: np.ndarray) -> list[str]:
    return [f"{value:.5f} ± {error:.1g}" for value, error in zip(values, errors, strict=True)]


def _print(name: str, cells: list[str]) -> None:
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
