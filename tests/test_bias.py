"""The bias of first-order gradients through MJX's contact, against the slope of the mean cost by quadrature."""

import numpy as np
import pytest

from mjx_study.experiment.quadrature import Line, Means, grid, means
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid


def measured(name: str, families: tuple[str, ...], position: np.ndarray, size: int) -> dict[str, Means]:
    task = make_task(name)
    line, points = Line(task), grid(position.min(), position.max(), task.sigma, size, task.noise)
    cells, _ = family_grid(task, families, [10000.0])
    return {cell.family: means(points, *line(points, cell.contact), position, task.sigma, task.noise) for cell in cells}


@pytest.mark.slow
def test_momentum_transfer() -> None:
    """Right where the damping begins smoothly or there is none; of the wrong sign with MuJoCo's default."""
    found = measured("momentum_transfer", ("penalty", "smooth_onset", "mujoco_default"), np.array([0.5]), 1500)
    for family in ("penalty", "smooth_onset"):
        here = found[family]
        error = here.slope_error + here.first_error
        assert np.all(np.abs(here.first - here.slope) < 3 * error + 0.01 * np.abs(here.slope))
        assert np.all(3 * error < 0.2 * np.abs(here.slope)), "no power"
    default = found["mujoco_default"]
    assert default.slope < -0.9 and default.first > 0.7
    assert np.all(default.slope_error + default.first_error < 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["ball_wall", "ball_wall:dome"])
def test_ball_wall(variant: str) -> None:
    """The landing alone, short of any wall, hides the slope behind the onset of the floor's damping."""
    families = ("penalty", "smooth_onset", "mujoco_default", "mujoco_stiff")
    for family, here in measured(variant, families, np.array([0.2]), 2000).items():
        assert here.slope == pytest.approx(-0.0105, rel=0.05) and here.slope_error < 1e-4
        if family == "smooth_onset":
            assert here.first == pytest.approx(here.slope, rel=0.02) and here.first_error < 0.01 * np.abs(here.slope)
        else:
            assert np.abs(here.first) < 0.1 * np.abs(here.slope)
