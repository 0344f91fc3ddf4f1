"""Where cells lie: every number of a sweep stands under the values that it was computed with."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjx_study.execution.run import run_study
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import StudyCell, StudyPlan
from mjx_study.options.configuration import StudyConfig
from mjx_study.plots.study import plot_study
from mjx_study.storage.folder import load_study
from mjx_study.table import digits_to_tell_apart
from tests.documents import planned_arrays, stub_cells

SMALL: dict[str, Any] = {"tasks": ("pusher",), "contact": ("penalty",), "samples": (4,), "seeds": 1, "horizon": 2}


@pytest.fixture(autouse=True)
def stubbed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells whose numbers say what they were computed with."""

    def compute(plan: StudyPlan, cell: StudyCell) -> dict[str, np.ndarray]:
        seeds = plan.config.seeds, len(plan.config.estimators)
        own = {
            "residual": np.full(seeds[1], cell.model.stiffness),
            "unconverged": np.full(seeds[1], cell.sigma),
            "reference_norm": np.asarray(plan.groups[cell.group].timestep),
            "reference_uncertainty": np.asarray(float(plan.groups[cell.group].task.defaults.gamma)),
            "variance": np.full(seeds, float(cell.samples)),
            "alpha": np.full(seeds, 0.5),
            "squared_bias": np.full(seeds[1], np.nan),
            "variance_lower": np.full(seeds, cell.samples / 2),
            "variance_upper": np.full(seeds, 2.0 * cell.samples),
            **{name: np.ones(seeds) for name in ("relative_error", "relative_error_se")},
        }
        return planned_arrays(plan, cell, **own)

    stub_cells(monkeypatch, compute)


def swept(folder: Path, **changes: Any):
    """The dataset of a stubbed sweep, where each number must be the coordinate that it stands under."""
    plan = plan_study(StudyConfig(**(SMALL | changes)))
    data = run_study(plan, folder)
    assert data.equals(load_study(folder))
    for variable, coordinate in (("residual", "stiffness"), ("unconverged", "sigma"), ("reference_norm", "timestep")):
        held = data[variable].transpose(..., "model" if coordinate == "stiffness" else coordinate)
        values = np.broadcast_to(np.asarray(data[coordinate]), held.shape)
        known = np.asarray(held.notnull())  # tasks of different timesteps leave places empty
        np.testing.assert_array_equal(np.asarray(held)[known], values[known], err_msg=variable)
        each = len(plan.config.estimators) if "estimator" in held.dims else 1
        assert np.sum(known) == each * len(plan.cells), variable
    for dimension in data.dims:
        names = data[dimension].values.tolist()
        assert len({str(name) for name in names}) == len(names), dimension
    return data


def test_stiffnesses_that_six_digits_do_not_tell_apart(tmp_path: Path) -> None:
    data = swept(tmp_path / "log", stiffness=tuple(np.linspace(1000, 1000.1, 21).tolist()))
    assert data.sizes["model"] == 21
    data = swept(tmp_path / "list", stiffness=(1e6, 1e6 + 1, 2e6))
    assert data["model"].values.tolist() == ["penalty 1000000", "penalty 1000001", "penalty 2000000"]


def test_solver_parameters_that_six_digits_do_not_tell_apart(tmp_path: Path) -> None:
    close = ((-1000.0, -5.0), (-1000.0001, -5.0))
    sharp = ((0.9, 0.95, 0.001, 0.5, 2.0), (0.9, 0.95, 0.0010000001, 0.5, 2.0))
    data = swept(tmp_path / "out", contact=(), solref=close, solimp=sharp)
    assert data.sizes["model"] == 4 and len(set(data["contact"].values.tolist())) == 4


def test_noises_and_timesteps_that_six_digits_do_not_tell_apart(tmp_path: Path) -> None:
    data = swept(tmp_path / "out", stiffness=(100.0,), sigma=(0.1, 0.1 + 1e-9), timestep=(0.005, 0.005 + 1e-10))
    assert data.sizes["sigma"] == data.sizes["timestep"] == 2
    figures = plot_study(data)
    assert len([name for name in figures if name.startswith("comparison")]) == 4
    assert len({figure.get_suptitle() for name, figure in figures.items() if name.startswith("comparison")}) == 4


MODULE = """
from mjx_study.tasks.pusher import pusher
from mjx_study.tasks.task import StudyDefaults

def stern(horizon=2, **options):
    return pusher(horizon=horizon, **options).replace(defaults=StudyDefaults(gamma=1.0))

def mild(horizon=2, **options):
    return pusher(horizon=horizon, **options).replace(defaults=StudyDefaults(gamma=2.0))
"""


def test_two_tasks_of_one_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "twins.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    data = swept(tmp_path / "out", tasks=("twins:stern", "twins:mild", "tennis"), stiffness=(100.0,), samples=(4, 8))
    assert data["task"].values.tolist() == ["twins:stern", "twins:mild", "tennis"]
    gammas = data["reference_uncertainty"].max([name for name in data["reference_uncertainty"].dims if name != "task"])
    assert gammas.values.tolist()[:2] == [1.0, 2.0]
    assert len([name for name in plot_study(data) if name.startswith("comparison")]) == 3


def test_a_study_from_elsewhere_names_no_file_outside_a_folder(tmp_path: Path) -> None:
    data = swept(tmp_path / "out", tasks=("pusher", "tennis"), stiffness=(100.0,))
    data = data.assign_coords(task=["../../../x", "a/b\0c"])
    for name in plot_study(data):
        assert "/" not in name and "\0" not in name, name
    long = data.assign_coords(task=["x" * 300, "x" * 300 + "y"])
    names = [name for name in plot_study(long) if name.startswith("comparison")]
    assert len(names) == 2 and max(map(len, names)) < 200


@pytest.mark.parametrize(
    ("values", "digits"), [((1.0, 2.0), 6), ((1e6, 1e6 + 1), 7), ((0.3, 0.1 + 0.2), 17), ((0.1, 0.1), 6), ((), 6)]
)
def test_digits_to_tell_apart(values: tuple[float, ...], digits: int) -> None:
    assert digits_to_tell_apart(values) == digits
    assert len({f"{value:.{digits}g}" for value in values}) == len(set(values))
