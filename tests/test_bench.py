"""The benchmark measures what it says, and its ratios hold."""

import json

import mujoco
import numpy as np
import pytest

from mjx_study import bench, cli
from mjx_study.contact import family_model
from mjx_study.tasks import make_task


@pytest.fixture(autouse=True)
def configured(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' own settings stand: JAX takes its devices once per process."""
    monkeypatch.setattr(cli, "configure", lambda **_: None)


def test_bench_prints_its_ratios_and_the_machine(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench", "pusher", "--horizon", "3", "--samples", "6", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert set(document["ratios"]) == {"gradient_per_value", "speedup_over_stock", "speedup_over_engine"}
    assert all(ratio > 0 for ratio in document["ratios"].values())
    assert document["environment"]["processor"] and document["gradient_memory"] > 0


def test_the_engines_rival_computes_a_gradient() -> None:
    """Of the sum of the last state, by differences: the same as perturbing one control by hand."""
    task = make_task("pusher", horizon=20)
    contact = family_model("mujoco", task.scene, stiffness=100.0, effective_mass=task.effective_mass)
    gradient = bench._engine_gradient(task, contact).ravel()

    def last(theta: np.ndarray) -> float:
        host, data = bench._engine_start(task, contact)
        for control in theta:
            data.ctrl[:] = control
            mujoco.mj_step(host, data)
        return float(np.sum(data.qpos) + np.sum(data.qvel))

    for index in (0, 7, 19):
        step = 1e-4 * np.eye(20)[index]
        difference = (last(np.asarray(task.theta) + step) - last(np.asarray(task.theta) - step)) / 2e-4
        assert gradient[index] == pytest.approx(difference, rel=1e-5)


def test_plans_refuse_what_the_rivals_cannot_run() -> None:
    task = make_task("pusher", horizon=3)
    with pytest.raises(ValueError, match="samples must be at least 1"):
        bench.plan_bench(task, 0)
    with pytest.raises(ValueError, match="open loops from a fixed start"):
        bench.plan_bench(task.replace(start=lambda key: task.start), 10)


@pytest.mark.slow
def test_gradients_are_as_fast_as_promised() -> None:
    """Ratios of one run; the machine should be quiet."""
    report = bench.bench(bench.plan_bench(make_task("pusher"), 1000))
    assert report.ratios["gradient_per_value"] <= 3.5
    assert report.ratios["speedup_over_stock"] >= 2
    assert report.ratios["speedup_over_engine"] >= 1
    assert report.gradient_memory < 40
