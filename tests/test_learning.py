"""The comparison of docs/robots.md: its gradients in windows, and its table."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_study
from estimators import Differentiation, Evaluation, make_estimator
from experiments import DATA, DOCS, learning
from experiments.quadruped import walk
from mjx_study.objective import Simulator
from mjx_study.tasks.network import with_network


def test_windows_cut_the_adjoint_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four pieces that are never cut give the gradient of a whole rollout, shorter windows another of the same cost."""
    task = with_network(mjx_study.make_task("sliding_box", horizon=8), (3,), jax.random.key(1))
    task = task.replace(theta=task.theta + 0.3)
    monkeypatch.setitem(learning.PIECES, task.name, 4)
    keys = lambda: jax.random.split(jax.random.key(0), 3)  # noqa: E731
    whole = Simulator(task, chunk_size=3).objective(None).differentiate(task.theta, keys())
    first_order = jax.jit(lambda window: learning.Pieces(task, window).differentiate(task.theta, keys()))
    uncut, cut = first_order(4), first_order(1)
    np.testing.assert_allclose(uncut.value, whole.value, rtol=1e-9)
    np.testing.assert_allclose(uncut.gradient, whole.gradient, rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(cut.value, uncut.value)
    assert np.max(np.abs(cut.gradient - uncut.gradient)) > 0.01 * np.max(np.abs(uncut.gradient))


def test_a_bound_that_is_a_value_is_that_of_the_estimator() -> None:
    """Batches whose weight no bound, a bound, and a bound below the radius decide."""
    values, scores, gradients = (jnp.array(np.random.default_rng(0).normal(size=(each, 50))) for each in (1, 3, 3))
    zeroth = Evaluation(values[0], scores.T, jnp.zeros(50), jnp.zeros(50))
    first = Differentiation(values[0], 1 + gradients.T, jnp.zeros(50))
    batches = {"evaluation": zeroth, "differentiation": first}
    free = make_estimator("aobg", baseline="leave_one_out")(batches)
    assert free.alpha and free.alpha.epsilon is not None and free.alpha.discrepancy is not None
    weights = [0.0]
    for gamma in (0.9 * free.alpha.epsilon, free.alpha.epsilon + 0.3 * free.alpha.discrepancy, np.inf):
        found = jax.jit(learning.bounded)(batches, gamma)
        expected = make_estimator("aobg", baseline="leave_one_out", gamma=float(gamma))(batches)
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-12)
        weights.append(float(found.alpha.alpha))
    assert weights[1] == 0 < weights[2] < weights[3]


def test_the_page_has_the_tables_of_the_data() -> None:
    lines = [json.loads(line) for line in (DATA / "learning.jsonl").read_text().splitlines()]
    for name in learning.TASKS:
        for written in (learning.table, learning.grid_table):
            assert written(lines, name) in (DOCS / "robots.md").read_text()
    law, default = (
        next(line for line in lines if (line["what"], line["method"]) == ("spread", method))
        for method in ("fobg_law", "fobg")
    )
    (half, rare, _), (usual, far, _) = law["quantiles"], default["quantiles"]
    written = (DOCS / "robots.md").read_text()
    assert f"longer than {rare:,.0f} (MuJoCo's default: {far:.0f}; medians {half:.0f} and {usual:.0f})" in " ".join(
        written.split()
    )
    assert f"cosines of {min(law['cosines']):.2f} to {max(law['cosines']):.2f}" in written
    assert learning.best(lines, "walk", "fobg_onset") == [0.01, 8]
    assert learning.best(lines, "hopper", "fobg_onset")[0] > 2 * learning.best(lines, "hopper", "fobg")[0]


def test_a_quadruped_stands_in_the_c_engine() -> None:
    """A network whose output is zero keeps the stance, at about the cost of standing still."""
    task = walk(horizon=1)
    cost, distance = learning.execute(task, np.asarray(task.theta)[None], seconds=0.4, starts=2)
    assert cost.shape == distance.shape == (1, 2)
    assert np.all((cost > 0.5) & (cost < 4.0)) and np.all(np.abs(distance) < 0.2)
