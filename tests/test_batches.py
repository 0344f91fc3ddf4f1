"""Every kind of batch of every task, in MJX and on its reference: the same rollouts seen in different ways."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import estimators
from estimators import ESTIMATORS, make_estimator
from mjx_study.experiment.resolution import check_estimators
from mjx_study.objective import Simulator, simulate
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid
from mjx_study.tasks.task import Task
from tests.carts import cart, launched_cart, steered_cart
from tests.estimators.statistics_helpers import assert_batches_agree

# What each stands for: an open loop; feedback from random starts; parameters that act before the simulation.
CARTS = {"cart": cart, "steered cart": steered_cart, "launched cart": launched_cart}
TASKS = {"pusher": 12, "tennis": 8, "double_pendulum": 10}
SAMPLES = 6


@pytest.fixture(scope="module", params=[*CARTS, *(pytest.param(name, marks=pytest.mark.slow) for name in TASKS)])
def drawn(request: pytest.FixtureRequest) -> tuple[Task, Any, dict[str, Any]]:
    """A task of few steps, its MJX objective, and one batch of every kind from the same keys."""
    name = request.param
    task = CARTS[name]() if name in CARTS else make_task(name, horizon=TASKS[name])
    theta = task.theta + 0.05 * jax.random.normal(jax.random.key(1), task.theta.shape)
    task = task.replace(theta=theta)
    contact = None
    if name in TASKS and task.contact_pair:
        (cell,), _ = family_grid(task, ["penalty"], [task.defaults.stiffnesses[0]])
        contact = cell.contact
    objective = Simulator(task, chunk_size=2).objective(contact)
    keys = jax.random.split(jax.random.key(0), SAMPLES)
    batches = {
        name: getattr(objective, oracle.method)(task.theta, jax.random.clone(keys))
        for name, oracle in estimators.ORACLES.items()
        if name != "corrected"
    }
    batches["corrected"] = batches["differentiation"]  # a program of its own, tests/test_onset_term.py
    return task, objective, batches


def test_the_batches_agree(drawn) -> None:
    """Values, scores and gradients are the same whichever batch they are read from."""
    task, _, batches = drawn
    assert_batches_agree(batches, task.horizon)
    assert batches["steps"].noise_score.shape == (SAMPLES, *task.policy.noise_shape)


def test_costs_to_go_are_sums_of_remaining_costs(drawn) -> None:
    """Their differences are the running costs, which `simulate` gives one by one."""
    task, objective, batches = drawn
    steps = batches["steps"]
    if task.policy.at_start:
        assert steps.value_to_go.shape == (SAMPLES, 1)
        return
    key = jax.random.split(jax.random.key(0), SAMPLES)[2]
    states, controls, *_ = jax.jit(lambda contact: simulate(task, task.theta, contact, key, 1.0))(objective.contact)
    before = jax.tree.map(lambda leaf: leaf[:-1], states)
    running = jax.vmap(task.running_cost)(before, controls)
    np.testing.assert_allclose(-np.diff(steps.value_to_go[2]), running[:-1], rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_every_estimator_runs_on_every_kind_of_task(drawn, name: str) -> None:
    task, _, batches = drawn
    estimator = make_estimator(name, gamma=task.defaults.gamma, sigma=task.sigma, max_norm=1e9, window=task.horizon)
    if name == "delta" and not task.policy.additive:
        with pytest.raises(
            ValueError, match=f"'delta' needs noise that is added to theta itself; {task.name} has a feedback"
        ):
            check_estimators([estimator], task)
        return
    check_estimators([estimator], task)
    estimate = estimator(batches)
    assert estimate.mean.shape == task.theta.shape and np.all(np.isfinite(estimate.mean))
    assert estimate.num_finite == SAMPLES


def test_a_reference_draws_the_noise_that_mjx_draws() -> None:
    """Same keys, same density: the pusher's two simulations differ by the contact's impedance and nothing else.

    `test_pusher` has the same of Gaussian noise.
    """
    task = make_task("pusher", horizon=20).replace(noise="laplace")
    (cell,), _ = family_grid(task, ["penalty"], [100.0])
    assert task.reference is not None
    reference = dataclasses.replace(task.reference(100.0), noise="laplace")
    keys = jax.random.split(jax.random.key(2), 4)
    ours = Simulator(task, chunk_size=2).objective(cell.contact).evaluate(task.theta, keys)
    theirs = reference.evaluate(task.theta, jax.random.clone(keys))
    np.testing.assert_allclose(ours.value, theirs.value, rtol=1e-4)
    np.testing.assert_allclose(ours.score, theirs.score, rtol=1e-12)


@pytest.mark.parametrize("make", [cart, partial(make_task, "pusher", horizon=2)], ids=["cart", "in contact"])
def test_linearising_on_the_tape(make: Callable[..., Task]) -> None:
    """Forward mode through the tape program gives the Jacobians of the Jacobian program."""
    keys = jax.random.split(jax.random.key(4), 2)
    task = make()
    assert task.scene.uses_graph
    small, large = (
        Simulator(each, chunk_size=1).objective(None).linearise(task.theta, jax.random.clone(keys))
        for each in (task, make(adjoint="tape"))
    )
    for one, other in zip(jax.tree.leaves(small), jax.tree.leaves(large), strict=True):
        rounding = 1e-14  # all there is of a solver's residual
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=rounding + 1e-9 * float(jnp.abs(other).max()))
