"""Sweeps: labelled numbers that are right, and folders that survive whatever happens to a process."""

import json
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import estimators
from estimators import AlphaOrder, DiscontinuityGated
from mjx_study import cli
from mjx_study.cli.sweep import sweep_fields
from mjx_study.execution.run import run_study
from mjx_study.experiment.gradients import GradientComputation
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import StudyError, estimators_of
from mjx_study.objective import Simulator, simulate
from mjx_study.options.configuration import StudyConfig
from mjx_study.results.warnings import warnings_of
from mjx_study.simulation.contact import stiffness_from_solref
from mjx_study.storage.folder import load_study
from mjx_study.tasks import make_task
from tests.documents import same
from tests.test_options import refused

pytestmark = pytest.mark.usefixtures("shared_programs")

SMALL: dict[str, Any] = {
    "tasks": ("pusher",), "contact": ("penalty", "mujoco"), "stiffness": (10.0, 1000.0), "samples": (4, 8), "seeds": 3,
    "horizon": 20, "chunk_size": 24,
}  # fmt: skip
LINE: dict[str, Any] = {
    "points": 3, "span": (-0.5, 0.5), "direction": "3", "samples": (4,), "seeds": 2, "estimators": ("zobg", "aobg"),
}  # fmt: skip


def config(**changes: Any) -> StudyConfig:
    of_gradients: dict[str, Any] = {} if {"iterations", "points"} & changes.keys() else {"reference_samples": 6}
    return StudyConfig(**(SMALL | of_gradients | changes))


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study") / "undisturbed"
    run_study(plan_study(config()), folder)
    return folder


def test_results_are_labelled(undisturbed: Path) -> None:
    data = load_study(undisturbed)
    assert dict(data.sizes) == {
        "task": 1, "timestep": 1, "cone": 1, "model": 4, "sigma": 1, "samples": 2, "estimator": 3, "seed": 3,
        "param": 20, "solref_entry": 2, "solimp_entry": 5,
    }  # fmt: skip
    assert data["contact"].values.tolist() == ["penalty", "penalty", "mujoco", "mujoco"]
    assert data["stiffness"].attrs["units"] == "N/m" and data["timestep"].attrs["units"] == "s"
    for name, variable in ((str(name), each) for name, each in data.data_vars.items()):
        alpha_only = name in ("alpha", "epsilon", "discrepancy")
        there = (variable.sel(estimator="aobg") if alpha_only else variable).notnull()
        hidden = name.startswith("debiased_cosine")  # where there is more noise than signal
        assert bool(there.any() if hidden else there.all()), name
    config_kept = json.loads(data.attrs["config"])
    assert config_kept["stiffness"] == [10.0, 1000.0] and config_kept["kind"] == "gradients"


@pytest.fixture(scope="module")
def by_hand() -> Simulator:
    """Of the same task, with chunks of another size."""
    return Simulator(make_task("pusher", horizon=20), chunk_size=5)


def test_numbers_are_those_of_the_estimators(undisturbed: Path, by_hand: Simulator) -> None:
    """One seed of one cell by hand, with keys that the configuration determines."""
    data = load_study(undisturbed)
    task = by_hand.task
    plan = plan_study(config())
    cell = next(cell for cell in plan.cells if cell.model.label == "mujoco, K = 1000 N/m" and cell.samples == 8)
    objective = by_hand.objective(cell.model.contact)
    zeroth, first, *_ = jax.random.split(jax.random.key(0), 5)
    keys = [jax.random.split(jax.random.split(stream, 3)[1], 8) for stream in (zeroth, first)]
    found = data.sel(model="mujoco 1000", samples=8, seed=1).squeeze()
    low = estimators.zeroth_order(objective.evaluate(task.theta, keys[0]), "zero_noise")
    high = estimators.first_order(objective.differentiate(task.theta, keys[1]))
    assert float(found["variance"].sel(estimator="zobg")) == pytest.approx(float(low.variance), rel=1e-8)
    assert float(found["variance"].sel(estimator="fobg")) == pytest.approx(float(high.variance), rel=1e-6)
    assert float(found["gradient_norm"].sel(estimator="fobg")) == pytest.approx(
        float(jnp.linalg.norm(high.mean)), rel=1e-8
    )
    assert float(found["residual"].max()) < 1e-6 and float(found["unconverged"].sum()) == 0


def test_a_cell_is_sampled_beside_the_statistics_of_the_last_one(undisturbed: Path, tmp_path, monkeypatch) -> None:
    plan = plan_study(config())
    begun = [threading.Event() for _ in (*plan.cells, "done")]

    def beside(self: GradientComputation, call: Callable[[], Any]) -> Any:
        following = sum(each.is_set() for each in begun)

        def late() -> Any:
            assert following == len(plan.cells) or begun[following].wait(30), "the next cell waits for statistics"
            return call()

        return self._statistics.submit(late)

    monkeypatch.setattr(GradientComputation, "_in_order", beside)
    data = run_study(plan, tmp_path / "study", lambda done, total, what: begun[done].set())
    assert same(data, load_study(undisturbed))


# Disturbances. The command runs in processes of its own, which are killed, starved and raced; on one device, not two.

ARGUMENTS = ["pusher", "--contact", "penalty,mujoco", "--stiffness", "10,1000", "--samples", "4,8", "--seeds", "3",
             "--horizon", "20", "--reference-samples", "6", "--chunk-size", "24",
             "--devices", "1"]  # fmt: skip


def process(folder: Path, *more: str, **kwargs: Any) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "mjx_study", "sweep", *ARGUMENTS, "--output", str(folder), *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **kwargs)


@pytest.mark.slow
def test_two_processes_share_a_study_and_a_third_has_nothing_to_do(undisturbed: Path, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    both = [process(folder), process(folder, "--devices", "2")]
    said = [running.communicate()[0] for running in both]
    assert [running.returncode for running in both] == [0, 0]
    computed = [int(re.search(r"computed (\d+) cells", text).group(1)) for text in said]  # type: ignore[union-attr]
    assert sum(computed) == 8
    assert same(load_study(folder), load_study(undisturbed))
    assert load_study(folder).attrs["command"].startswith("mjx-study sweep pusher --contact")
    plan = plan_study(config())
    assert run_study(plan, folder).attrs["computed_cells"] == 0


def copy_of(folder: Path, to: Path) -> Path:
    return shutil.copytree(folder, to, ignore=shutil.ignore_patterns("results.nc", "study.lock"))


def test_a_folder_without_its_study_json_is_refused(
    undisturbed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copy_of(undisturbed, tmp_path / "out")
    (folder / "study.json").unlink()
    with pytest.raises(StudyError, match="cells of a study without its study.json"):
        run_study(plan_study(config()), folder)
    assert "holds no study: there is no study.json" in refused(["plot", str(tmp_path)], capsys)
    (tmp_path / "study.json").write_text(json.dumps({"format": 99, "config": {}, "cells": []}))
    with pytest.raises(StudyError, match="is of format 99; this program reads 4"):
        load_study(tmp_path)


def test_landscapes_are_labelled_and_right(by_hand: Simulator) -> None:
    """One point by hand: both batches of it are taken together, and slopes are along one force."""
    data = run_study(config(**LINE))
    assert data.sizes["point"] == 3 and "seed" not in data.dims
    cell = data.sel(model="mujoco 1000", samples=4).squeeze()
    np.testing.assert_allclose(cell["position"], [-0.5, 0.0, 0.5])
    task, plan = by_hand.task, plan_study(config(**LINE))
    contact = next(each.model.contact for each in plan.cells if each.model.label == "mujoco, K = 1000 N/m")
    objective = by_hand.objective(contact)
    zeroth, first, *_ = jax.random.split(jax.random.key(0), 5)
    keys = [
        jnp.concatenate([jax.random.split(each, 4) for each in jax.random.split(stream, 2)])
        for stream in (zeroth, first)
    ]
    theta = task.theta.at[3].add(0.5)
    low = estimators.zeroth_order(objective.evaluate(theta, keys[0]), "zero_noise")
    high = estimators.first_order(objective.differentiate(theta, keys[1]))
    found = cell.isel(point=2)
    slopes = found["slope"].sel(estimator="zobg"), found["slope_se"].sel(estimator="zobg")
    along = np.asarray(low.per_sample)[:, 3]
    assert float(slopes[0]) == pytest.approx(np.mean(along), rel=1e-8)
    assert float(slopes[1]) == pytest.approx(np.std(along, ddof=1) / 8**0.5, rel=1e-8)
    mixed = estimators_of(plan, plan.cells[0])[plan.config.estimators.index("aobg")](
        {"evaluation": objective.evaluate(theta, jax.random.clone(keys[0])),
         "differentiation": objective.differentiate(theta, jax.random.clone(keys[1]))}
    )  # fmt: skip
    assert float(found["slope"].sel(estimator="aobg")) == pytest.approx(float(mixed.mean[3]), rel=1e-8)
    assert abs(float(mixed.mean[3]) - float(high.mean[3])) < abs(np.mean(along) - float(high.mean[3]))
    silent = simulate(task.replace(theta=theta), theta, contact, jax.random.key(0), 0.0)[2]
    assert float(found["cost"]) == pytest.approx(float(silent), rel=1e-10)


# The command's text, figures and page.


def test_a_timestep_keeps_the_duration() -> None:
    """Half the step, twice as many; a horizon that is given stands."""
    small = make_task("pusher")
    plan = plan_study(config(timestep=(0.005, 0.0025), horizon=None))
    assert [group.task.horizon for group in plan.groups] == [small.horizon, 2 * small.horizon]
    plan = plan_study(config(timestep=(0.0025,), horizon=7))
    assert [group.task.horizon for group in plan.groups] == [7]


def test_contact_models_in_mujocos_terms() -> None:
    solref, solimp = ((-1000.0, -5.0), (0.02, 1.0)), ((0.9, 0.95, 0.001, 0.5, 2.0),)
    plan = plan_study(config(contact=(), stiffness=None, solref=solref, solimp=solimp))
    models = [cell.model for cell in plan.cells if cell.samples == 4]
    assert [model.family for model in models] == [
        "solref -1000 -5 solimp 0.9 0.95 0.001 0.5 2", "solref 0.02 1 solimp 0.9 0.95 0.001 0.5 2"
    ]  # fmt: skip
    mass = make_task("pusher").effective_mass
    assert models[0].stiffness == pytest.approx(stiffness_from_solref([-1000.0, -5.0], effective_mass=mass)[0])


def test_the_example_of_the_page_runs(undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).parents[1] / "docs" / "studies.md").read_text()
    _, code = re.findall(r"```py\n(.*?)```", page, re.DOTALL)
    (toml,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    copy_of(undisturbed, tmp_path / "out")
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    exec(code, found)
    assert found["ahead"].dims == ("model",) and bool(found["ahead"].all())  # so few steps are calm at any stiffness
    (tmp_path / "study.toml").write_text(toml)
    parsed = cli.parser().parse_args(["sweep", "--config", "study.toml", "--output", "x"])
    assert len(plan_study(StudyConfig(**sweep_fields(parsed))).cells) == 52


def test_every_option_of_an_estimator_reaches_its_cells() -> None:
    shared: Any = {"baseline": "leave_one_out", "weights": "cross_fitted"}
    options = shared | {"gamma": 3.0, "tolerance": 0.1, "failure_probability": 0.2}
    plan = plan_study(config(estimators=("aobg", "ddcg"), **options))
    assert estimators_of(plan, plan.cells[0]) == (
        AlphaOrder(gamma=3.0, failure_probability=0.2, **shared),
        DiscontinuityGated(sigma=plan.cells[0].sigma, tolerance=0.1, **shared),
    )
    with pytest.raises(ValueError, match="at least 4 samples, two in each half; got 3"):
        plan_study(config(samples=(3, 10), weights="cross_fitted"))


def test_a_study_warns_of_batches_that_are_too_small_to_tell(undisturbed: Path) -> None:
    data = load_study(undisturbed)
    enough = data.assign(effective_samples=data["effective_samples"] * 0 + 3.0)
    assert not any("effective samples" in message for message in warnings_of(enough))
    few = enough.assign(effective_samples=enough["effective_samples"].where(enough["seed"] > 0, 2.9))
    (message,) = [message for message in warnings_of(few) if "effective samples" in message]
    batches = few["effective_samples"].size // few.sizes["seed"]
    assert message.startswith(f"fewer than 3 effective samples in batches: {batches};")
    assert "marked ? in the table of compare" in message
