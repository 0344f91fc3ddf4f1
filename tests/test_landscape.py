"""Landscapes: quadrature against closed forms, curves against each other, and what the command says and writes."""

import dataclasses
import json
import shutil
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from scipy import stats
from scipy.integrate import quad

from estimators import NOISES, Differentiation, Evaluation
from mjx_study import cli
from mjx_study.cli.console import curves
from mjx_study.cli.studies import as_document
from mjx_study.execution.run import run_study
from mjx_study.experiment import landscapes, sampling
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.quadrature import Line, applies, closed_form, grid, means
from mjx_study.experiment.resolution import line_of
from mjx_study.options.configuration import StudyConfig
from mjx_study.plots.study import plot_study
from mjx_study.reference import BallWall, FinalCost, Heaviside, smoothed
from mjx_study.results.curves import curves_of
from mjx_study.results.kind import findings_of
from mjx_study.simulation.dynamics import State
from mjx_study.storage.folder import load_study
from mjx_study.tasks import make_task
from mjx_study.tasks.policy import InitialStatePolicy, LinearFeedback
from mjx_study.tasks.task import Task
from tests.carts import WALL, cart
from tests.documents import altered, numbers_of
from tests.reference.functions import Square

POSITION = np.linspace(0.1, 1.4, 7)
SIGMA = 0.1
SCIPY_DENSITIES: dict[str, Any] = {
    "gaussian": stats.norm.pdf,
    "logistic": partial(stats.logistic.pdf, scale=np.sqrt(3) / np.pi),
    "laplace": partial(stats.laplace.pdf, scale=np.sqrt(0.5)),
    "student": partial(stats.t.pdf, df=5, scale=np.sqrt(0.6)),
}
HALF_LINES = ((-np.inf, 0.0), (0.0, np.inf))


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize(("function", "tolerance"), [(Square(), 1e-4), (Heaviside(), 2e-2), (BallWall(), 2e-2)])
def test_quadrature_against_closed_forms(function, tolerance: float, noise: str) -> None:
    """Smooth functions to the reach of the grid; where f jumps, to spacing times density, as the error bound says."""
    points = grid(POSITION[0], POSITION[-1], SIGMA, 4000, noise)
    values, slopes = function.value(points[:, None]), function.gradient(points[:, None])[:, 0]
    found = means(points, values, slopes, POSITION, SIGMA, noise)
    exact = [smoothed(function, np.array([t]), SIGMA, noise) for t in POSITION]
    slope = np.array([point.gradient[0] for point in exact])
    first = np.array([point.gradient[0] - point.jump_term[0] for point in exact])
    scale = np.abs(slope).max()
    np.testing.assert_allclose(found.slope, slope, atol=tolerance * scale)
    np.testing.assert_allclose(found.first, first, atol=tolerance * scale)
    np.testing.assert_allclose(found.smoothed, [point.value for point in exact], rtol=1e-2, atol=1e-3)
    assert np.all(np.abs(found.slope - slope) <= 10 * found.slope_error + 1e-4 * scale)


def test_narrow_noise_has_no_quadrature() -> None:
    """Rather than none of what is sampled."""
    plan = plan_study(config("momentum_transfer", contact=("mujoco_default",), sigma=(1e-3,), horizon=20, points=2))
    assert landscapes.LandscapeComputation(plan)._exact(plan.cells[0], np.array([-1.0, 1.0]), None) is None


def test_quadrature_refuses_grids_that_cannot_serve() -> None:
    for low, high, size, noise, says in (
        (0.0, 1.0, 100, "gaussian", "5.3 sigma"),  # too coarse
        (0.0, 0.1, 1000, "gaussian", "5.3 sigma"),  # too short
        (POSITION[0], POSITION[-1], 1000, "laplace", "9.8 sigma"),  # enough for Gaussian noise only
    ):
        points = grid(low, high, SIGMA, size, "gaussian")
        with pytest.raises(ValueError, match=f"the grid must cover {says} to each side"):
            means(points, points, points, POSITION, SIGMA, noise)


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("theta", [0.0, 0.31])
def test_quadrature_weighs_with_the_noise_s_own_density(noise: str, theta: float) -> None:
    """E|w|^3 and its slope at theta = 0 and off the grid, against SciPy's quadrature and densities."""
    scipy_density = SCIPY_DENSITIES[noise]
    points = grid(theta, theta, SIGMA, 4000, noise)
    found = means(points, np.abs(points) ** 3, 3 * points * np.abs(points), np.array([theta]), SIGMA, noise)

    def mean(function) -> float:
        parts = [quad(lambda z: function(theta + SIGMA * z) * scipy_density(z), *ends) for ends in HALF_LINES]
        return sum(part[0] for part in parts)

    within = {"student": 0.03}.get(noise, 2e-3)  # |w|^3 against t^-6 converges slowly in the grid's reach
    assert found.smoothed == pytest.approx(mean(lambda x: abs(x) ** 3), rel=within)
    assert found.slope == pytest.approx(mean(lambda x: 3 * x * abs(x)), rel=within, abs=1e-6)
    assert found.first == pytest.approx(mean(lambda x: 3 * x * abs(x)), rel=within, abs=1e-6)
    if theta == 0.0 and noise != "gaussian":
        assert found.smoothed / SIGMA**3 > 1.8  # 1.596 for a Gaussian, 2.121 for Laplace


def one_gain(**changes) -> Task:
    """A pusher of two steps whose force is one gain times a coordinate: one parameter, which acts at every step."""
    task = make_task("pusher", horizon=2)
    policy = LinearFeedback(task.horizon, 1, 1, lambda state: state.qpos[:1])
    return task.replace(policy=policy, theta=jnp.zeros(1), reference=None, **changes)


def test_quadrature_is_for_scalar_parameters_that_act_once_from_a_fixed_start() -> None:
    drawn = make_task("momentum_transfer", horizon=2)
    fixed = drawn.start
    for task, says in (
        (make_task("pusher"), "pusher has 200$"),
        (one_gain(), "pusher has 1, the noise on its controls$"),
        (drawn.replace(start=lambda key: fixed), "momentum_transfer has 1, its starts drawn$"),
    ):
        with pytest.raises(ValueError, match=f"quadrature is for a scalar parameter.*; {says}"):
            Line(task)
        assert not applies(task)


def config(task: str | Task, **changes: Any) -> StudyConfig:
    chosen: dict[str, Any] = {"estimators": ("zobg", "fobg"), "seeds": 1} | changes
    return StudyConfig(tasks=(task,), kind="landscapes", **chosen)


@pytest.mark.slow
def test_the_landscape_of_one_gain_is_sampled() -> None:
    found = run_study(config(one_gain(), contact=("penalty",), stiffness=(10.0,), points=2, samples=(3,)))
    assert "exact_slope" not in found and bool(found["slope"].notnull().all())


def test_noise_reaches_quadrature_and_the_reference() -> None:
    """A task's own density, or one that is asked for, weighs; jump terms are its too."""
    task = make_task("momentum_transfer", horizon=2)
    for study in (config(task.replace(noise="laplace"), points=2), config(task, points=2, noise="laplace")):
        (group,) = plan_study(study).groups
        assert group.task.noise == "laplace"
        reference = group.task.analytic(0.0)
        assert isinstance(reference.system, FinalCost) and reference.noise == "laplace"
        edge = np.array([np.pi / 4])
        found = closed_form(reference, edge)
        assert found is not None
        (jump,) = [jump.size for jump in reference.system.function.jumps() if jump.position > 0]  # type: ignore[attr-defined]
        peak = np.sqrt(0.5) / task.sigma  # of Laplace's density; a Gaussian's is 0.4 / sigma
        assert found.slope - found.first == pytest.approx(jump * peak, rel=1e-9)


def shot(horizon: int = 40) -> Task:
    """A cart that starts at 2 cos(theta) [m/s] and meets nothing, beside the reference of a ball that meets a bar."""
    task = cart(lambda state, control: jnp.zeros(()), horizon, wall=WALL)
    ball = make_task("momentum_transfer", horizon=2)

    def start_at(start: State, theta: jax.Array) -> State:
        return dataclasses.replace(start, qpos=jnp.zeros(1), qvel=2 * jnp.cos(theta))

    return task.replace(
        policy=InitialStatePolicy(1, horizon, 1, start_at, "rad"),
        theta=jnp.array([0.5]),
        final_cost=lambda state: state.qpos[0] ** 2,
        reference=ball.reference,
    )


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that the command wrote: the reference, and one contact model."""
    folder = tmp_path_factory.mktemp("landscape") / "out"
    arguments = ["landscape", f"{__name__}:shot", "--points", "5", "--samples", "300", "--span", "0.3,1.2"]
    arguments += ["--contact", "mujoco", "--stiffness", "10000", "--output", str(folder)]
    assert cli.main(arguments) == 0
    return folder


@pytest.fixture(scope="module")
def flown(drawn: Path) -> xr.Dataset:
    return load_study(drawn)


def test_curves_agree_with_quadrature_and_with_each_other(flown: xr.Dataset) -> None:
    """Both estimators see the slope of the mean cost, each within its error."""
    _, (label, curve) = curves_of(flown)
    position = curve["position"].values
    travel = 0.01 * np.sum(0.999 ** np.arange(1, 41))  # per speed, with the cart's damping
    np.testing.assert_allclose(curve["cost"], (2 * np.cos(position) * travel) ** 2, rtol=1e-10)
    slope, error = (curve[name].transpose("estimator", "point").values for name in ("slope", "slope_se"))
    for mean, spread, exact in (
        (curve["smoothed"].values, curve["smoothed_se"].values, curve["exact_smoothed"].values),
        (slope[0], error[0], curve["exact_slope"].values),
        (slope[1], error[1], curve["exact_first"].values),
    ):
        assert np.all(np.abs(mean - exact) < 4.5 * spread)
        assert np.all(4.5 * spread < np.abs(exact).max()), "no power"
    exact = curve["exact_slope"].values
    np.testing.assert_allclose(curve["exact_first"], exact, atol=1e-4 * np.abs(exact).max())
    assert float(curve["nonfinite"].sum()) == 0 and float(curve["residual"]) < 1e-8
    assert label == "mujoco, K = 10000 N/m" and "nowhere differs" in findings_of(flown)[1]


def test_a_reference_that_jumps_is_found_out(flown: xr.Dataset) -> None:
    assert curves_of(flown)[0][0] == "reference, K = 10000 N/m"
    assert "E[FoBG] differs from the mean cost's slope" in findings_of(flown)[0]
    document = json.loads(json.dumps(as_document(flown, curves), allow_nan=False))
    assert len(document["curves"][0]["exact_slope"]) == 5


@pytest.mark.slow
def test_a_direction_through_many_parameters() -> None:
    """Along one force of the pusher: both slopes are the gradient's entry, within their errors."""
    task = make_task("pusher", horizon=10)
    study = config(task, contact=("penalty",), stiffness=(10.0,), direction="3", points=3, samples=(400,))
    line = line_of(task, 3, None, "3", 0)
    np.testing.assert_array_equal(line.direction, np.eye(10)[3])
    assert (line.position[0], line.position[-1]) == pytest.approx((-1.0, 1.0))
    found = run_study(study)
    ((_, curve),) = curves_of(found)
    zeroth, first = (curve["slope"].sel(estimator=name).values for name in ("zobg", "fobg"))
    error = np.hypot(*(curve["slope_se"].sel(estimator=name).values for name in ("zobg", "fobg")))
    assert "exact_slope" not in found and np.all(np.abs(first - zeroth) < 4.5 * error)
    # the cost is nearly 2 theta of control cost along this line
    np.testing.assert_allclose(np.diff(first) / np.diff([-1.0, 0.0, 1.0]), 2, rtol=0.05)


def test_a_plan_makes_no_array_for_each_point() -> None:
    """Each takes a quarter of a millisecond, and all of them may not fit into memory."""
    begun = time.process_time()
    plan_study(config("pusher", points=100_000))
    assert time.process_time() - begun < 8


def test_the_line_goes_through_theta() -> None:
    task = make_task("pusher", horizon=3).replace(theta=jnp.array([1.0, 2.0, 3.0]))
    line = line_of(task, 3, (-1.0, 1.0), "1", 0)
    np.testing.assert_allclose(list(line.thetas(float)), [[1, 1, 3], [1, 2, 3], [1, 3, 3]])
    (group,) = plan_study(config("pusher", horizon=3, theta=(1.0, 2.0, 3.0), points=3)).groups
    assert group.task.theta.tolist() == [1.0, 2.0, 3.0]


def test_random_directions_are_unit_vectors_of_the_seed() -> None:
    task = make_task("pusher", horizon=10)
    lines = [line_of(task, 3, None, None, seed).direction for seed in (0, 0, 1)]
    assert np.linalg.norm(lines[0]) == pytest.approx(1)
    np.testing.assert_array_equal(lines[0], lines[1])
    assert np.any(lines[0] != lines[2])


class Broken:
    """An objective whose samples fail where the noise is positive."""

    num_params = 1

    def evaluate(self, theta, keys) -> Evaluation:
        noise = self._noise(keys)
        return Evaluation(jnp.where(noise > 0, jnp.nan, noise), noise[:, None], jnp.zeros(len(noise)))

    def differentiate(self, theta, keys) -> Differentiation:
        noise = self._noise(keys)
        return Differentiation(noise, jnp.where(noise > 0, jnp.inf, noise)[:, None])

    def _noise(self, keys):
        return jax.vmap(jax.random.normal)(keys)


def test_samples_that_are_not_finite_are_left_out_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: dict[str, Any] = {"contact": ("reference",), "stiffness": (10_000.0,), "span": (0.3, 1.2)}
    plan = plan_study(config(shot(), **chosen, points=2, samples=(50,)))
    plan = dataclasses.replace(plan, cells=plan.cells[:1])
    monkeypatch.setattr(sampling.Objectives, "__call__", lambda *_: Broken())
    monkeypatch.setattr(landscapes, "closed_form", lambda *_: None)
    arrays = numbers_of(plan)
    streams = sampling.cell_keys(0, 1)["order"]
    lost = [int(np.sum(Broken()._noise(jax.random.split(stream[0], 50)) > 0)) for stream in streams]
    assert arrays["nonfinite"].tolist() == [[count] * 2 for count in lost] and min(lost) > 0
    assert np.all(arrays["slope"][1] < 0) and all(np.isfinite(arrays[name]).all() for name in ("slope", "slope_se"))


def test_theta_has_its_unit(drawn: Path, tmp_path: Path) -> None:
    """As the task says, also on the axis; a folder may say nothing of it."""
    shutil.copytree(drawn, tmp_path / "before")
    written = tmp_path / "before" / "study.json"
    resolved = json.loads(written.read_text())["resolved"]
    altered(written, resolved=[{name: each[name] for name in each if name != "unit"} for each in resolved])
    for folder, unit, label in ((drawn, "rad", "theta [rad]"), (tmp_path / "before", "unit of theta", "theta")):
        data = load_study(folder)
        assert data["position"].attrs["units"] == unit
        (figure,) = plot_study(data).values()
        assert {axes.get_xlabel() for axes in figure.axes} == {"", label}
    pusher = run_study(config("pusher", horizon=3, points=2, samples=(4,), contact=("reference",)))
    assert pusher["position"].attrs["units"] == "unit of theta"
