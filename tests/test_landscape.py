"""Landscapes: quadrature against closed forms, curves against each other, and what the command says and writes."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators import Differentiation, Evaluation
from mjx_study import cli, landscape
from mjx_study.cli import landscape as command
from mjx_study.cli import options
from mjx_study.landscape import LandscapeConfig, plan_landscape
from mjx_study.quadrature import Line, grid, means
from mjx_study.reference import BallWall, Heaviside, Quadratic, smoothed
from mjx_study.tasks import make_task


@pytest.fixture(autouse=True)
def configured(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' own settings stand: JAX takes its devices once per process."""
    monkeypatch.setattr(options, "configure", lambda **_: None)


POSITION = np.linspace(0.1, 1.4, 7)
SIGMA = 0.1


@pytest.mark.parametrize(
    ("function", "tolerance"),
    [(Quadratic(np.array([[3.0]]), np.array([-1.0])), 1e-4), (Heaviside(), 2e-2), (BallWall(), 2e-2)],
)
def test_quadrature_against_closed_forms(function, tolerance: float) -> None:
    """Smooth functions to the reach of 5 sigma; where f jumps, to spacing times density, as the error bound says."""
    points = grid(POSITION[0], POSITION[-1], SIGMA, 4000)
    found = means(points, function.value(points[:, None]), function.gradient(points[:, None])[:, 0], POSITION, SIGMA)
    exact = [smoothed(function, np.array([t]), SIGMA) for t in POSITION]
    slope = np.array([point.gradient[0] for point in exact])
    first = np.array([point.gradient[0] - point.jump_term[0] for point in exact])
    scale = np.abs(slope).max()
    np.testing.assert_allclose(found.slope, slope, atol=tolerance * scale)
    np.testing.assert_allclose(found.first, first, atol=tolerance * scale)
    np.testing.assert_allclose(found.smoothed, [point.value for point in exact], rtol=1e-2, atol=1e-3)
    assert np.all(np.abs(found.slope - slope) <= 10 * found.slope_error + 1e-4 * scale)


def test_quadrature_refuses_grids_that_cannot_serve() -> None:
    points = grid(0.0, 1.0, SIGMA, 100)
    with pytest.raises(ValueError, match="the grid must cover 4 sigma"):
        means(points, points, points, POSITION[:2], SIGMA)
    points = grid(0.0, 0.1, SIGMA, 1000)
    with pytest.raises(ValueError, match="the grid must cover 4 sigma"):
        means(points, points, points, POSITION, SIGMA)
    with pytest.raises(ValueError, match="quadrature is for a decision of one number; pusher has 200"):
        Line(make_task("pusher"))


def flight(**options) -> landscape.LandscapePlan:
    """40 steps of a shot ball, before it meets anything: x = v cos(theta) t, and everything is smooth."""
    config = LandscapeConfig(task="momentum_transfer", contact=("mujoco",), span=(0.3, 1.2), **options)
    task = make_task("momentum_transfer", horizon=40)
    return plan_landscape(config, task.replace(final_cost=lambda state: state.qpos[0] ** 2, sigma=0.1))


@pytest.fixture(scope="module")
def flown() -> landscape.Landscape:
    """The reference, and one contact model."""
    return landscape.landscape(flight(points=5, samples=300))


def test_curves_agree_with_quadrature_and_with_each_other(flown: landscape.Landscape) -> None:
    """Both estimators see the slope of the mean cost, each within its error."""
    _, curve = flown.curves
    np.testing.assert_allclose(curve.cost, (2 * np.cos(flown.position) * 40 * 0.002) ** 2, rtol=1e-10)
    assert curve.exact is not None
    for mean, error, exact in (
        (curve.smoothed, curve.smoothed_se, curve.exact.smoothed),
        (curve.zeroth, curve.zeroth_se, curve.exact.slope),
        (curve.first, curve.first_se, curve.exact.first),
    ):
        assert np.all(np.abs(mean - exact) < 4.5 * error)
        assert np.all(4.5 * error < np.abs(exact).max()), "no power"
    np.testing.assert_allclose(curve.exact.first, curve.exact.slope, atol=1e-4 * np.abs(curve.exact.slope).max())
    assert curve.nonfinite == 0 and curve.residual < 1e-8
    assert curve.label == "mujoco, K = 10000 N/m" and "nowhere differs" in flown.findings()[1]


def test_a_reference_that_jumps_is_found_out(flown: landscape.Landscape) -> None:
    assert flown.curves[0].label == "reference"
    assert "E[FoBG] differs from the mean cost's slope" in flown.findings()[0]
    document = json.loads(json.dumps(flown.as_json(), allow_nan=False))
    assert len(document["curves"][0]["exact"]["slope"]) == 5


def test_a_direction_through_many_parameters() -> None:
    """Along one force of the pusher: both slopes are the gradient's entry, within their errors."""
    task = make_task("pusher", horizon=10)
    config = LandscapeConfig(
        task="pusher", contact=("penalty",), stiffness=(10.0,), direction="3", points=3, samples=400, reference=False
    )
    plan = plan_landscape(config, task)
    np.testing.assert_array_equal(plan.line.direction, np.eye(10)[3])
    assert plan.config.span == pytest.approx((-1.0, 1.0))
    (curve,) = landscape.landscape(plan).curves
    gap, error = curve.difference
    assert curve.exact is None and np.all(np.abs(gap) < 4.5 * error)
    # the cost is nearly 2 theta of control cost along this line
    np.testing.assert_allclose(np.diff(curve.first) / np.diff([-1.0, 0.0, 1.0]), 2, rtol=0.05)


def test_the_line_goes_through_theta() -> None:
    task = make_task("pusher", horizon=3)
    common: dict[str, Any] = {"direction": "1", "points": 3, "span": (-1.0, 1.0)}
    plan = plan_landscape(LandscapeConfig(task="pusher", theta=(1.0, 2.0, 3.0), **common), task)
    np.testing.assert_allclose(plan.line.thetas, [[1, 1, 3], [1, 2, 3], [1, 3, 3]])
    named = plan_landscape(LandscapeConfig(task="pusher", **common))
    assert named.task.horizon == 200 and np.all(np.asarray(named.line.thetas[1]) == np.asarray(named.task.theta))
    with pytest.raises(ValueError, match="theta has one entry, and the line is its range: give --span"):
        plan_landscape(LandscapeConfig(task="ball_wall", theta=(1.0,)))


def test_random_directions_are_unit_vectors_of_the_seed() -> None:
    task = make_task("pusher", horizon=10)
    plans = [plan_landscape(LandscapeConfig(task="pusher", seed=seed), task) for seed in (0, 0, 1)]
    assert np.linalg.norm(plans[0].line.direction) == pytest.approx(1)
    np.testing.assert_array_equal(plans[0].line.direction, plans[1].line.direction)
    assert np.any(plans[0].line.direction != plans[2].line.direction)


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


def test_samples_that_are_not_finite_are_left_out_and_counted() -> None:
    keys = [jax.random.split(key, 50) for key in jax.random.split(jax.random.key(0))]
    lost = sum(int(np.sum(Broken()._noise(jax.random.clone(batch)) > 0)) for batch in keys)
    point = landscape._point(Broken(), jnp.zeros(1), np.ones(1), keys)
    assert point["nonfinite"] == lost > 0
    assert point["first"] < 0 and all(np.isfinite(value) for value in point.values())


def test_the_command_prints_and_writes(
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    flown: landscape.Landscape,
) -> None:
    plans = []

    def computed(plan, progress):
        plans.append(plan)
        return flown

    monkeypatch.setattr(command, "landscape", computed)
    arguments = ["landscape", "ball_wall", "--points", "3", "--samples", "8", "--contact", "penalty"]
    assert cli.main([*arguments, "--output", str(tmp_path)]) == 0
    (plan,) = plans
    assert plan.config.span == (0.0, 1.5) and plan.config.points == 3 and plan.config.contact == ("penalty",)
    printed = capsys.readouterr().out
    assert "where the mean cost is least" in printed and "mujoco, K = 10000 N/m" in printed
    assert sorted(path.name for path in tmp_path.iterdir()) == ["landscape.json", "landscape.pdf", "landscape.png"]
    document = json.loads((tmp_path / "landscape.json").read_text())
    assert document["config"]["span"] == [0.3, 1.2] and document["environment"]["precision"] == "float64"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--points", "1"], "points must be at least 2"),
        (["--samples", "2"], "samples must be at least 3"),
        (["--span", "1,0"], "span must be two numbers, the lower one first"),
        (["--span", "1"], "span must be two numbers"),
        (["--seed", "-1"], "seed must not be negative"),
        (["--contact", ""], "no contact model"),
        (["--sigma", "0"], "sigma must be positive"),
        (["--contact", "spring"], "unknown contact family"),
    ],
)
def test_bad_options_get_one_line(capsys: pytest.CaptureFixture[str], arguments: list[str], says: str) -> None:
    assert cli.main(["landscape", "ball_wall", *arguments]) == 2
    printed = capsys.readouterr()
    assert says in printed.err and printed.err.count("\n") == 1 and printed.out == ""


def test_directions_are_checked(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["landscape", "pusher", "--direction", "200"]) == 2
    assert "direction must be random or a parameter's index, 0 to 199" in capsys.readouterr().err
