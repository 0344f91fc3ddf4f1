"""Means of first-order gradients through MJX's contact: as commands judge them, and against slopes by quadrature."""

import json
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from estimators import make_estimator
from mjx_study.cli import main
from mjx_study.diagnose.means import check_mean, check_terms, term_lines
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.quadrature import Line, Means, grid, means
from mjx_study.options.configuration import StudyConfig
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid


def test_estimators_take_their_options(capsys: pytest.CaptureFixture[str]) -> None:
    """A norm that no sample reaches clips none."""
    chosen = ["--estimators", "fobg,fobg_clipped", "--max-norm", "1e9", "--samples", "5", "--json"]
    main(["gradcheck", "tests.carts:walled_cart", "--contact", "penalty", "--stiffness", "10", "--mean", *chosen])
    plain, clipped = json.loads(capsys.readouterr().out)["checks"]
    assert clipped == plain | {"estimator": "fobg_clipped"}


def test_commands_judge_means_with_an_onset_term(capsys: pytest.CaptureFixture[str]) -> None:
    """Of the others `compare` has an error against a reference; a descent is judged where its best seed ends."""

    def printed(command: str, *options: str) -> dict[str, Any]:
        place = ["tests.carts:walled_cart", "--contact", "mujoco_default", "--samples", "40", "--json"]
        main([command, *place, *options])
        return json.loads(capsys.readouterr().out)

    names = "--estimators", "fobg,fobg_onset"
    (judged,) = printed("compare", *names, "--reference-samples", "20")["means"]
    one = "--estimators", "fobg_onset"
    paths = printed("gradcheck", *one, "--mean", "--direction", "means")["checks"]
    largest = max(paths, key=lambda each: abs(each["gap"]))
    assert judged["estimator"] == "fobg_onset" and judged["verdict"] == largest["verdict"]
    assert [judged[name] for name in ("gap", "half_width")] == pytest.approx([largest["gap"], largest["half_width"]])
    plain = StudyConfig(tasks=("tests.carts:walled_cart",), contact=("mujoco_default",), estimators=("fobg",))
    assert check_terms(plan_study(plain)) == []
    found = printed("optimise", *names, "--iterations", "2", "--learning-rate", "0.1", "--evaluation-samples", "20")
    ((end,),) = [run["theta"] for run in found["runs"] if run["estimator"] == "fobg_onset"]
    (at_end,) = found["means"]
    task = make_task("tests.carts:walled_cart").replace(theta=jnp.asarray(end))
    cells, _ = family_grid(task, ("mujoco_default",))
    common = {"samples": 40, "seed": 0, "direction": "means"}
    (check,) = check_mean(task, cells, [make_estimator("fobg_onset")], **common)
    assert at_end["gap"] == pytest.approx(float(check.circulation.gap), rel=1e-9) and at_end["gap"] != judged["gap"]
    (line,) = term_lines([check])
    assert f"the mean of FoBG (onset) is {check.verdict}" in line and "without a reference" in line


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
