"""Tables of docs/first-order-bias.md: means and spread of first-order gradients with surrogate derivatives.

    python -m experiments.relaxed

Half an hour on two cores, by quadrature.
"""

import dataclasses
import math

import numpy as np

from experiments.pages import markdown_row
from mjx_study.claims.laboratory import EFFORTS, RELAXATIONS, Laboratory, Landscape, Slopes
from mjx_study.reference import FinalCost
from mjx_study.runtime import configure
from mjx_study.table import markdown_table

ANGLES = {"momentum_transfer": (0.3, 0.5, 0.7), "ball_wall": (0.2, 0.7, 0.9)}
FAMILIES = ("mujoco_default", "mujoco_stiff")
STIFFNESS = 10_000.0
TREATMENTS: dict[str, dict[str, str]] = {"exact": {}, "onset term": {"onset": "linear"}} | {
    name: {"relaxed": name} for name in RELAXATIONS
}


def standard_deviation(at: Slopes) -> float:
    """Return the standard deviation of one first-order gradient, by quadrature over the landscape."""
    system, sigma = at.objective.system, at.objective.sigma
    assert isinstance(system, FinalCost) and isinstance(system.function, Landscape)
    table = system.function
    weight = np.exp(-0.5 * ((table.points - at.theta) / sigma) ** 2)
    mean = float(np.average(table.slopes, weights=weight))
    return math.sqrt(float(np.average((table.slopes - mean) ** 2, weights=weight)))


def main() -> None:
    """Print the tables."""
    configure()
    lab = Laboratory(dataclasses.replace(EFFORTS["quick"], density=120))
    for task, angles in ANGLES.items():
        header = [task, "contact", *(f"{angle}: E[FoBG] / slope, deviation" for angle in angles)]
        print("\n" + markdown_table([], header))
        for family in FAMILIES:
            for name, treatment in TREATMENTS.items():
                row = [name, f"`{family}`"]
                for angle in angles:
                    at = lab.slopes(task, family, angle, stiffness=STIFFNESS, **treatment)  # type: ignore[arg-type]
                    share, error = at.first / at.gradient, sum(at.errors)
                    row.append(f"{share:.3g} ± {error:.1g}, {standard_deviation(at) / abs(at.gradient):.2g}")
                print(markdown_row(*row), flush=True)


if __name__ == "__main__":
    main()
