"""Optimisation: it goes down, goes on where it stopped, stops where it must, and compiles once."""

import dataclasses
import json
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import estimators
from estimators import ESTIMATORS, Differentiation, FirstOrder
from mjx_study import cli
from mjx_study.execution.run import run_study
from mjx_study.experiment import descent_rollouts, descents, plan, sampling
from mjx_study.experiment import iteration as descent
from mjx_study.experiment.descent_rollouts import Backend
from mjx_study.experiment.iteration import REASONS, begin, make_optimizer
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import StudyPlan, estimators_of
from mjx_study.options.configuration import StudyConfig
from mjx_study.options.files import POLICY_OPTIONS
from mjx_study.reference import ReferenceObjective, Tennis, roll_out
from mjx_study.results.kind import findings_of
from mjx_study.results.variables import HISTORY
from mjx_study.tasks import TASKS, make_task
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import StudyDefaults
from tests.faults import Killed, kill_after

pytestmark = pytest.mark.usefixtures("shared_programs")

SHORT: dict[str, Any] = {
    "horizon": 60, "iterations": 6, "seeds": 2, "samples": (5,), "evaluation_samples": 8, "learning_rate": 0.01,
}  # fmt: skip
OUTER = ("task", "timestep", "cone", "model", "sigma", "samples")


def config(task: str = "pusher", **changes: Any) -> StudyConfig:
    chosen: dict[str, Any] = {"contact": ("penalty",), "stiffness": (100.0,), "kind": "descents"} | SHORT | changes
    return StudyConfig(tasks=(task,), **chosen)


def on_reference(task: str, **changes: Any) -> StudyConfig:
    chosen: dict[str, Any] = {"stiffness": (make_task(task).defaults.middle_stiffness,), "seeds": 3} | changes
    return StudyConfig(tasks=(task,), kind="descents", contact=("reference",), **chosen)


def descend(study: StudyConfig | StudyPlan, folder: Path | None = None) -> xr.Dataset:
    """The single cell of a study."""
    return run_study(study, folder).isel(dict.fromkeys(OUTER, 0))


@pytest.fixture(scope="module")
def short(shared_programs: None) -> xr.Dataset:
    """Two estimators through MJX, six iterations of two seeds."""
    return descend(config(estimators=("zobg", "aobg")))


def test_a_run_has_its_whole_history(short: xr.Dataset) -> None:
    assert short["theta"].transpose("estimator", "seed", "param").shape == (2, 2, 60)
    assert all(short[name].transpose("iteration", "seed", "estimator").shape == (6, 2, 2) for name in HISTORY)
    assert np.all(np.diff(short["seconds"].values, axis=0) > 0) and bool(short["stopped_at"].isnull().all())
    cost = short["cost"]
    assert bool((cost.isel(iteration=-1) < cost.isel(iteration=0)).all())
    assert bool((short["final_cost"] < short["start_cost"] - 4 * short["start_cost_se"]).all())
    alpha = short["alpha"]
    assert bool(alpha.sel(estimator="zobg").isnull().all()) and bool((alpha.sel(estimator="aobg") > 0.5).all())
    assert short["rollouts"].values.tolist() == [6, 11]
    assert short["sigma"].item() == 0.1


def test_a_weight_of_zero_throughout_is_told() -> None:
    """At the stiffnesses where it holds in all iterations of all seeds, and not of inverse variances, unbounded."""
    few = {"iterations": 2, "seeds": 2, "samples": (4,), "evaluation_samples": 2, "stiffness": (10.0, 30.0)}
    study = on_reference("pusher", **SHORT | few | {"estimators": ("aobg", "ivw")})
    stuck = run_study(dataclasses.replace(study, gamma=1e-9))
    (sentence,) = findings_of(stuck)
    assert sentence == (
        "reference: AoBG equals ZoBG throughout at K = 10, 30 N/m: alpha is 0 in every iteration, usually because its "
        "bound gamma is below epsilon, the radius of ZoBG's mean (then increase --gamma or --samples), else since no "
        "first-order variance is finite"
    )
    once = stuck["alpha"].where((stuck["stiffness"] != 10) | (stuck["seed"] != 1) | (stuck["iteration"] != 2), 0.1)
    assert "throughout at K = 30 N/m: " in findings_of(stuck.assign(alpha=once))[0]
    assert findings_of(run_study(study)) == [] == findings_of(stuck.drop_vars("alpha"))


def test_seeds_are_those_of_runs_of_one(short: xr.Dataset) -> None:
    """The first seed's run does not depend on how many there are beside it."""
    alone = descend(config(estimators=("zobg",), seeds=1))["theta"].sel(estimator="zobg")
    both = short["theta"].sel(estimator="zobg")
    np.testing.assert_allclose(alone.sel(seed=0), both.sel(seed=0), rtol=1e-10)
    assert not np.allclose(both.sel(seed=0), both.sel(seed=1), rtol=1e-6)


def test_seeds_on_a_reference_do_not_depend_on_those_drawn_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """All at once, two at a time, one at a time, and the first alone; with feedback and random starts."""
    few = {"iterations": 2, "seeds": 3, "evaluation_samples": 2, "learning_rate": 1e-5, "estimators": ("aobg",)}
    study = on_reference("tennis", **SHORT | few | {"horizon": 20})
    together = descend(study)["theta"]
    for most in (10, 1):
        monkeypatch.setattr(descent_rollouts, "TOGETHER", most)
        np.testing.assert_allclose(descend(study)["theta"], together, rtol=1e-7)
    alone = descend(dataclasses.replace(study, seeds=1))["theta"]
    np.testing.assert_allclose(alone.sel(seed=0), together.sel(seed=0), rtol=1e-7)
    assert not np.allclose(together.sel(seed=0), together.sel(seed=1), rtol=1e-5, atol=0)


def test_an_iteration_is_gradient_descent_on_the_estimate() -> None:
    """The first step by hand: theta minus the learning rate times the estimate with the same keys."""
    planned = plan_study(config(estimators=("aobg",), iterations=1))
    (group,), (cell,) = planned.groups, planned.cells
    objective = sampling.Simulator(group.task, chunk_size=planned.chunk_size).objective(cell.model.contact)
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), 1), 0)
    estimate = estimators.estimate(estimators_of(planned, cell)[0], objective, group.task.theta, key, 5)
    run = descend(planned).sel(estimator="aobg", seed=1)
    np.testing.assert_allclose(run["theta"], group.task.theta - 0.01 * estimate.mean, rtol=1e-10)
    assert run["gradient_norm"].values[0] == pytest.approx(float(jnp.linalg.norm(estimate.mean)), rel=1e-9)


def test_a_killed_run_goes_on_from_the_last_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No iteration before it is computed again; test_kinds compares the numbers."""
    study = config(estimators=("zobg",), contact=("reference",), iterations=15)
    with monkeypatch.context() as patch, pytest.raises(Killed):
        kill_after(patch, lambda path, count: path.name == "00000.part.npz")
        patch.setattr(descents, "SAVE_SECONDS", 0.0)
        run_study(study, tmp_path)
    reports: list[int] = []
    run_study(study, tmp_path, lambda done, total, what: reports.append(done))
    assert min(reports[1:-1]) > descents.REPORT_EVERY


def test_a_seed_that_diverges_stops_and_the_others_go_on() -> None:
    """One iteration by hand of three seeds: fine, not finite, already stopped."""
    optimizer = make_optimizer("sgd", 0.1, 0.0)
    state = begin(optimizer, jnp.array([1.0, 2.0]), 4)
    state = dataclasses.replace(state, reason=jnp.array([0, 0, 3, 0]), first_cost=jnp.array([1.0, 1.0, 1.0, 1e-3]))
    value = jnp.ones((4, 5)).at[3].set(1e6)
    gradient = jnp.ones((4, 5, 2)).at[1].set(jnp.nan)
    batches = {"differentiation": jax.vmap(lambda f, g: Differentiation(f, g))(value, gradient)}
    advance = jax.vmap(lambda state, batches: descent.advance_one(state, batches, FirstOrder(), optimizer))
    after, record = advance(state, batches)
    np.testing.assert_allclose(after.theta, [[0.9, 1.9], [1, 2], [1, 2], [1, 2]])
    assert after.reason.tolist() == [0, 1, 3, 4]
    np.testing.assert_array_equal(np.isnan(record["cost"]), [False, False, True, False])
    assert record["nonfinite"][1] == 5


def test_a_metric_without_a_finite_value_is_nan() -> None:
    found = {"way": np.array([1.0, np.nan, 3.0]), "none": np.array([np.nan, np.inf])}
    system = SimpleNamespace(observe=lambda theta, keys: found)
    rollouts: Any = SimpleNamespace(
        simulator=None, task=SimpleNamespace(analytic=lambda _: system), _evaluation_keys=lambda: None
    )
    model = ContactPoint("reference", 1.0, None)
    np.testing.assert_equal(Backend.metrics(rollouts, jnp.zeros(1), model), {"none": np.nan, "way": 2.0})


def test_a_diverging_run_keeps_its_history_and_says_why() -> None:
    """A learning rate that is far too large, on the analytic pusher."""
    study = config(estimators=("fobg",), learning_rate=1.0, iterations=400, contact=("reference",), seeds=2)
    run = descend(study).isel(estimator=0)
    assert bool(((run["stopped_at"] > 1) & (run["stopped_at"] < 400)).all())
    assert all(REASONS[int(code)] for code in run["reason"].values)
    assert bool(run["cost"].isel(iteration=-1).isnull().all()) and bool(run["cost"].isel(iteration=0).notnull().all())


@pytest.mark.parametrize("name", [name for name, each in ESTIMATORS.items() if "corrected" not in each.needs])
def test_every_estimator_optimises(name: str) -> None:
    changes: dict[str, Any] = {"fobg_clipped": {"max_norm": 1e3}, "fobg_truncated": {"window": 40}}.get(name, {})
    cost = descend(config(estimators=(name,), contact=("reference",), **changes))["cost"]
    assert bool((cost.isel(iteration=-1) < cost.isel(iteration=0)).all())


@pytest.mark.parametrize("task", TASKS)
def test_every_task_has_a_recipe_that_plans(task: str) -> None:
    planned = plan_study(StudyConfig(tasks=(task,), kind="descents"))
    (group,) = planned.groups
    assert group.recipe == group.task.defaults.recipe and planned.cells[0].samples == group.task.defaults.recipe.samples  # type: ignore[union-attr]


def test_a_task_without_recipe_or_reference_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    bare = make_task("pusher", horizon=3).replace(defaults=StudyDefaults(), reference=None)
    monkeypatch.setattr(plan, "task_with_options", lambda *_, **__: bare)
    with pytest.raises(ValueError, match="`learning_rate` must be given, with `samples`: pusher has no recipe$"):
        plan_study(config(horizon=3, samples=None, learning_rate=None))
    (group,) = plan_study(config(horizon=3)).groups
    assert group.recipe is not None and group.recipe.decay == 0.0
    with pytest.raises(ValueError, match="pusher has no analytic reference"):
        plan_study(config(horizon=3, contact=("reference",)))


@pytest.mark.slow
def test_outcomes_of_tennis_are_what_happened() -> None:
    """A ball was hit where the reference counts an impact; in MJX the paddle's corners count too."""
    task = make_task("tennis")
    keys = jax.random.split(jax.random.key(4), 100)
    reference = task.reference(5000.0)  # type: ignore[misc]
    assert isinstance(reference, ReferenceObjective) and task.metrics is not None
    starts, noise = reference._draw(keys)
    rollout = roll_out(reference.system, starts, noise, np.zeros((3, 7)))
    assert isinstance(reference.system, Tennis)
    impacts = sum(reference.system.impacts(rollout.states[:, step], noise[:, step]) for step in range(200))
    found = reference.observe(task.theta, jax.random.clone(keys))
    np.testing.assert_array_equal(found["hit"], impacts > 0)
    assert 0.5 < np.mean(found["hit"]) < 1
    away = np.linalg.norm(rollout.states[:, -1, :2] - [0.0, 2.5], axis=1)
    np.testing.assert_allclose(found["distance [m]"], away, rtol=1e-12)
    chosen: dict[str, Any] = {"contact": ("penalty",), "stiffness": (task.defaults.middle_stiffness,)}
    planned = plan_study(StudyConfig(tasks=("tennis",), kind="descents", **chosen))
    backend, (cell,) = Backend(planned, planned.cells[0]), planned.cells
    hit = np.asarray(backend._observe(task.theta, cell.model.contact, jax.random.clone(keys))["hit"])
    assert np.mean(hit[found["hit"] == 1]) > 0.97 and np.mean(hit) < np.mean(found["hit"]) + 0.15


@pytest.mark.slow
def test_outcomes_of_the_sliding_box_tell_who_is_aboard() -> None:
    """Pushed gently the block stays on the box, pushed hard it falls; MJX and the reference agree."""
    for force, aboard in ((0.05, 1.0), (1.0, 0.0)):
        for contact in ("mujoco", "reference"):
            chosen: dict[str, Any] = {"contact": (contact,), "stiffness": (1000.0,), "evaluation_samples": 3}
            planned = plan_study(StudyConfig(tasks=("sliding_box",), kind="descents", **chosen))
            (cell,) = planned.cells
            assert Backend(planned, cell).metrics(jnp.full(400, force), cell.model) == {"aboard": aboard}


def test_policies_are_written_and_replayed(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """As they are, and without the digest as somebody changed them."""
    options = "--reference --horizon 8 --iterations 4 --seeds 2 --samples 4 --evaluation-samples 5 --output"
    assert cli.main(["optimise", "pusher", *options.split(), str(tmp_path)]) == 0
    assert "pusher: analytic reference, K = 550 N/m; sgd" in capsys.readouterr().out
    policies = [tmp_path / f"policy-{name}.json" for name in ("zobg", "fobg", "aobg")]
    assert {path.name for path in tmp_path.iterdir()} >= {"descent.png", *(path.name for path in policies)}
    kept = json.loads(policies[1].read_text())
    assert {"task", "theta", "digest", *POLICY_OPTIONS} <= kept.keys()
    del kept["digest"]
    (changed := tmp_path / "changed.json").write_text(json.dumps(kept | {"timestep": 0.0025, "solver": "cg"}))
    for path, timestep in ((policies[1], 0.005), (changed, 0.0025)):
        capsys.readouterr()
        replay = ["rollout", "pusher", "--theta", str(path), "--frames", "1", "--json", "--output", str(tmp_path)]
        assert cli.main(replay) == 0
        facts = json.loads(capsys.readouterr().out)
        assert facts["theta"] == kept["theta"] and facts["duration"] == pytest.approx(8 * timestep)


HOP = """<mujoco><worldbody><body name="ball"><joint name="z" type="slide" axis="0 0 1"/><geom size=".1"/></body>
</worldbody><actuator><motor joint="z"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    ("chosen", "offered"),
    [
        ("pusher --contact mujoco_default --network 128,128 --estimators zobg", True),
        ("pusher --contact mujoco --backward smooth_onset --estimators fobg", True),
        ("hop.xml --estimators zobg", False),
    ],
    ids=["a contact without stiffness, and many parameters", "surrogate gradients", "a file"],
)
def test_the_command_that_shows_the_best_policy_runs(
    chosen: str, offered: bool, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it is printed; a file has none, for rollout moves it as its MJCF says."""
    monkeypatch.chdir(tmp_path)
    Path("hop.xml").write_text(HOP)
    few = "--horizon 2 --iterations 1 --learning-rate 0.01 --samples 3 --seeds 1 --evaluation-samples 2 --output out"
    assert cli.main(["optimise", *chosen.split(), *few.split()]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("to see the best policy: ")]
    assert len(told) == offered
    for line in told:
        (program, *command) = shlex.split(line.removeprefix("to see the best policy: "))
        assert program == "mjx-study" and cli.main([*command, "--renderer", "drawing", "--frames", "1"]) == 0


def test_a_descent_that_ends_above_its_start_is_reported() -> None:
    """Steps that are far too long, and short ones."""
    for rate, above in ((1.0, True), (1e-4, False)):
        study = config(estimators=("zobg", "fobg"), learning_rate=rate, iterations=3, contact=("reference",))
        found = findings_of(run_study(study))
        assert [each for each in found if "ZoBG, FoBG end above the start" in each] == (found[:1] if above else [])
