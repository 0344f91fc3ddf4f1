"""Rollouts of one contact model with the derivatives of another, against the pusher's closed form; and schedules."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from mjx_study.execution.run import run_study
from mjx_study.experiment.descent_rollouts import Backend
from mjx_study.experiment.iteration import begin, schedule_factors
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import estimators_of
from mjx_study.objective import Simulator, simulate
from mjx_study.options.configuration import StudyConfig
from mjx_study.simulation.contact import contact_model, soften, stiffness_from_solref
from mjx_study.simulation.dynamics import State
from mjx_study.tasks import make_task
from tests.pusher_fixtures import NO_NOISE, ImpedancePusher, penalty, sample_keys

FORWARD, BACKWARD = 1000.0, 100.0
HORIZON = 30


def by_hand(task, states, controls) -> np.ndarray:
    """The gradient over controls: costs along the rollout, chained by the closed form's Jacobians at `BACKWARD`."""
    vectors = np.concatenate([states.qpos, states.qvel], axis=1)
    over_state, over_control = ImpedancePusher(BACKWARD, timestep=task.scene.timestep).jacobians(vectors[:-1], controls)
    slopes = jax.jit(jax.vmap(jax.grad(task.running_cost, argnums=(0, 1))))
    of_costs = slopes(jax.tree.map(lambda x: x[:-1], states), controls)
    last = jax.jit(jax.grad(task.final_cost))(jax.tree.map(lambda x: x[-1], states))
    adjoint = np.concatenate([last.qpos, last.qvel])
    found = np.zeros(len(controls))
    for index in reversed(range(len(controls))):
        found[index] = (of_costs[1][index] + over_control[index].T @ adjoint)[0]
        running = np.concatenate([of_costs[0].qpos[index], of_costs[0].qvel[index]])
        adjoint = running + over_state[index].T @ adjoint
    return found


@pytest.mark.parametrize("adjoint", ["graph", pytest.param("tape", marks=pytest.mark.slow)])
def test_costs_are_of_one_contact_and_derivatives_of_the_other(adjoint: str) -> None:
    task = make_task("pusher", horizon=HORIZON, adjoint=adjoint)
    simulator, theta = Simulator(task, chunk_size=1), jnp.linspace(0.1, 0.6, HORIZON)
    stiff, soft = penalty(FORWARD), penalty(BACKWARD)
    surrogate = simulator.objective(dataclasses.replace(stiff, backward=soft), NO_NOISE)
    exact = simulator.objective(stiff, NO_NOISE)
    found, plain = (objective.differentiate(theta, sample_keys(1)) for objective in (surrogate, exact))
    np.testing.assert_array_equal(found.value, plain.value)
    states, controls, *_ = jax.jit(lambda key: simulate(task, theta, stiff, key, 0.0))(sample_keys(1)[0])
    expected = by_hand(task, states, np.asarray(controls))
    np.testing.assert_allclose(found.gradient[0], expected, rtol=2e-4)  # the fixture's impedance is not quite MuJoCo's
    assert np.linalg.norm(plain.gradient[0] - expected) > 0.05 * np.linalg.norm(expected)
    # with itself behind it, a contact model has its exact derivatives
    same = simulator.objective(dataclasses.replace(stiff, backward=stiff), NO_NOISE)
    np.testing.assert_allclose(same.differentiate(theta, sample_keys(1)).gradient, plain.gradient, rtol=1e-9)


@pytest.mark.slow
def test_a_force_at_a_distance_is_felt_before_contact() -> None:
    """Across a gap the exact gradient of where the slider ends is zero; with a margin wider than the gap it is not."""
    task = make_task("pusher", horizon=3)
    assert isinstance(task.start, State)
    task = task.replace(
        start=dataclasses.replace(task.start, qpos=task.start.qpos + jnp.array([0.0, 0.05])),
        running_cost=lambda state, control: jnp.zeros(()),
        final_cost=lambda state: state.qpos[1],
    )
    config = StudyConfig(
        tasks=(task,), contact=("penalty",), stiffness=(FORWARD,), backward=("none", "penalty"), backward_margin=0.1
    )
    exact, distant = (cell.model.contact for cell in plan_study(config).cells)
    simulator, theta = Simulator(task, chunk_size=1), jnp.zeros(3)
    gradients = [
        simulator.objective(contact, NO_NOISE).differentiate(theta, sample_keys(1)).gradient[0]
        for contact in (exact, distant)
    ]
    assert np.all(gradients[0] == 0) and gradients[1][0] > 0


def test_a_study_has_every_backward_model_beside_the_exact_one() -> None:
    """Both roll out the same; the estimates of zeroth order do not know which it is."""
    config = StudyConfig(
        tasks=("pusher",), horizon=5, contact=("penalty", "mujoco_default", "reference"), stiffness=(200.0,),
        backward=("none", "smooth_onset", "penalty"), backward_stiffness=50.0, samples=(4,), seeds=2,
        estimators=("zobg", "fobg"), reference_samples=4, theta=(3.0,) * 5,
    )  # fmt: skip
    assert plan_study(config).compilations == 4  # cost and gradient, exact and not
    data = run_study(config).isel(task=0, timestep=0, cone=0, sigma=0, samples=0)
    assert data["contact"].values.tolist() == [
        "penalty", "mujoco_default", "reference",
        "penalty, backward smooth_onset 50 N/m", "mujoco_default, backward smooth_onset 50 N/m",
        "penalty, backward penalty 50 N/m", "mujoco_default, backward penalty 50 N/m",
    ]  # fmt: skip
    variance = data["variance"].transpose("model", "estimator", "seed").values
    for family, surrogates in ((0, (3, 5)), (1, (4, 6))):
        for other in surrogates:
            np.testing.assert_array_equal(variance[family, 0], variance[other, 0])
            assert not np.any(variance[family, 1] == variance[other, 1])


def test_factors_are_optaxs() -> None:
    np.testing.assert_allclose(schedule_factors("linear_schedule(0.1, 1, 2)", 4), [0.1, 0.55, 1, 1], rtol=1e-7)
    joined = "join_schedules([constant_schedule(0.5), exponential_decay(1.0, 1, decay_rate=0.5)], [2])"
    np.testing.assert_allclose(schedule_factors(joined, 4), [0.5, 0.5, 1, 0.5], rtol=1e-7)
    cosine = optax.cosine_decay_schedule(1.0, 10, alpha=0.1)
    found = schedule_factors("cosine_decay_schedule(1.0, 10, alpha=0.1)", 12)
    np.testing.assert_allclose(found, jax.vmap(cosine)(jnp.arange(12)), rtol=1e-6)
    np.testing.assert_array_equal(schedule_factors(None, 3), np.ones(3))


@pytest.mark.parametrize("solref", [(-1000.0, -20.0), (0.02, 1.0)])
def test_a_softer_contact_keeps_its_damping_ratio(solref: tuple[float, float]) -> None:
    scene = make_task("pusher", horizon=1).scene
    other = contact_model((-400.0, -8.0), scene=scene)
    contact = dataclasses.replace(contact_model(solref, scene=scene), backward=other)
    softer = soften(contact, 0.25)
    for one, quarter in ((contact, softer), (other, softer.backward)):
        assert quarter is not None
        (k, b), (k_of, b_of) = (
            stiffness_from_solref(each.solref.tolist(), effective_mass=1.0) for each in (one, quarter)
        )
        assert k_of == pytest.approx(k / 4) and b_of == pytest.approx(b / 2)


@pytest.mark.parametrize("contact", ["reference", pytest.param("penalty", marks=pytest.mark.slow)])
def test_an_iteration_has_the_stiffness_and_sigma_of_its_schedule(contact: str) -> None:
    """The last of three iterations is that of a study with the scheduled stiffness and noise throughout."""
    common: dict[str, Any] = {
        "tasks": ("pusher",), "kind": "descents", "horizon": 10, "contact": (contact,), "estimators": ("fobg",),
        "seeds": 1, "samples": (3,), "evaluation_samples": 2, "learning_rate": 1e-3, "iterations": 3,
        "theta": (0.5,) * 10,
    }  # fmt: skip
    schedules: dict[str, Any] = {
        "stiffness_schedule": "linear_schedule(1, 0.25, 2)",
        "sigma_schedule": "linear_schedule(1, 3, 2)",
    }
    backends = []
    constant: dict[str, Any] = {"stiffness": (100.0,), "sigma": (0.3,)}
    for changes in ({"stiffness": (400.0,), **schedules}, constant):
        plan = plan_study(StudyConfig(**common | changes))
        backends.append((Backend(plan, plan.cells[0]), plan))
    records = []
    for backend, plan in backends:
        (estimator,) = estimators_of(plan, plan.cells[0])
        state = begin(backend.optimizer, backend.task.theta, 1)
        keys = jax.random.split(jax.random.key(5), 1)
        records.append(backend.iteration(estimator, plan.cells[0].model)(state, keys, 2)[1])
    scheduled, expected = records
    np.testing.assert_allclose(scheduled["cost"], expected["cost"], rtol=1e-12)
    np.testing.assert_allclose(scheduled["gradient_norm"], expected["gradient_norm"], rtol=1e-9)
    assert np.all(scheduled["variance"] > 0)
