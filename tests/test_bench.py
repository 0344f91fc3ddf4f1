"""The benchmark measures what it says, and its ratios hold."""

import json

import jax
import mujoco
import numpy as np
import pytest

from mjx_study import bench, cli
from mjx_study.objective import Simulator, simulate
from mjx_study.runtime import environment, local_devices
from mjx_study.simulation.engine import engine_model
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid, single_contact

RATIOS = {"gradient_per_value", "rollouts_over_stock", "rollouts_over_engine", "speedup_over_stock"}


@pytest.mark.parametrize(
    ("task", "further"),
    [
        ("tests.carts:walled_cart", {"speedup_over_engine", "onset_per_gradient"}),
        pytest.param("tennis", {"speedup_over_engine", "onset_per_gradient"}, marks=pytest.mark.slow),
        pytest.param("double_pendulum", set(), marks=pytest.mark.slow),
    ],
)
def test_bench_prints_its_ratios_and_the_machine(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, task: str, further: set[str]
) -> None:
    """Open loop, feedback from random starts, and a launch without contact by Runge-Kutta; of the samples of a seed."""
    keys, stock = [], bench.stock_programs
    monkeypatch.setattr(bench, "stock_programs", lambda *given: keys.append(given[2]) or stock(*given))
    assert cli.main(["bench", task, "--horizon", "3", "--samples", "6", "--seed", "3", "--json"]) == 0
    expected = jax.random.key_data(jax.random.split(jax.random.key(3), 6))
    np.testing.assert_array_equal(jax.random.key_data(keys[0]), expected)
    document = json.loads(capsys.readouterr().out)
    assert set(document["ratios"]) == RATIOS | further
    assert all(ratio > 0 for ratio in document["ratios"].values())
    assert document["environment"]["processor"] and document["gradient_memory"] > document["value_memory"] > 0


def test_bench_warns_of_its_contact(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    report = bench.BenchReport("pusher", 6, 3, "penalty", dict.fromkeys(bench.TIMED, 1.0), 1.0, 1.0, environment())
    report.environment["native"] = "none"
    monkeypatch.setattr(bench, "run_bench", lambda *_: report)
    stiff = ["bench", "pusher", "--samples", "6", "--contact", "penalty", "--stiffness", "1e6"]
    assert cli.main(stiff) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("warning: ")]
    assert cli.main([*stiff, "--json"]) == 0
    assert [f"warning: {each}" for each in json.loads(capsys.readouterr().out)["warnings"]] == [line]


@pytest.mark.slow
def test_stock_mjx_runs_the_same_samples() -> None:
    """The rival's costs are ours: same starts, noise of the task's own density, policy and contact."""
    task = make_task("tennis", horizon=5).replace(noise="laplace")
    (cell,), _ = family_grid(task, ["mujoco"], [4000.0])
    keys = jax.random.split(jax.random.key(0), 4)
    values, _ = bench.stock_programs(task, cell.contact, keys, local_devices())
    ours = Simulator(task, chunk_size=2).objective(cell.contact).evaluate(task.theta, jax.random.clone(keys))
    for devices in (local_devices(), local_devices()[:1]):
        np.testing.assert_allclose(values(devices), ours.value, rtol=1e-10)


def test_the_engines_rollouts_are_ours() -> None:
    """Same starts, controls and contact: the states after every step, but for what solvers leave over."""
    task = make_task("tests.carts:cart", horizon=5)
    keys = jax.random.split(jax.random.key(0), 4)
    count, run = bench.engine_rollouts(task, None, keys, 2)
    states, *_ = jax.vmap(lambda key: simulate(task, task.theta, None, key, 1.0))(jax.random.clone(keys))
    nq = task.scene.host.nq
    assert count == 4
    np.testing.assert_allclose(run()[..., 1 : 1 + nq], states.qpos[:, 1:], rtol=0, atol=1e-9)


def test_the_engines_rival_computes_a_gradient() -> None:
    """Of the sum of the last state, by differences: the same as perturbing one control, or the start, by hand."""
    task = make_task("pusher", horizon=20)
    (cell,), _ = family_grid(task, ["mujoco"], [100.0])
    start, controls = (np.array([0.0, 1.0]), np.zeros(2)), np.full((20, 1), 0.1)
    over_start, over_controls = bench.gradient_of_engine(bench.engine_model(task.scene, cell.contact), start, controls)

    def last(speed: float, controls: np.ndarray) -> float:
        host = engine_model(task.scene, cell.contact)
        data = mujoco.MjData(host)
        data.qpos[:], data.qvel[0] = start[0], speed
        for control in controls:
            data.ctrl[:] = control
            mujoco.mj_step(host, data)
        return float(np.sum(data.qpos) + np.sum(data.qvel))

    for index in (0, 7, 19):
        step = 1e-4 * np.eye(20)[:, index : index + 1]
        difference = (last(0.0, controls + step) - last(0.0, controls - step)) / 2e-4
        assert over_controls[index, 0] == pytest.approx(difference, rel=1e-5)
    assert over_start[2] == pytest.approx((last(1e-5, controls) - last(-1e-5, controls)) / 2e-5, rel=1e-4)


@pytest.mark.slow
def test_gradients_are_as_fast_as_promised() -> None:
    """Ratios of one run; the machine should be quiet."""
    with jax.debug_key_reuse(False):  # all contenders run with the same keys
        task = make_task("pusher")
        report = bench.run_bench(task, 1000, single_contact(task)[0])
    assert report.ratios["gradient_per_value"] <= 3.5
    assert report.ratios["speedup_over_stock"] >= 2
    assert report.ratios["speedup_over_engine"] >= 1
    assert report.gradient_memory < 40
