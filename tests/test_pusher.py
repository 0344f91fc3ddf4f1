"""The pusher in MJX against its closed form: rollouts, gradients of the whole cost, and the paper's variances.

Two closed forms are used. `ImpedancePusher` has MuJoCo's impedance and must agree to rounding at any stiffness;
`Pusher`, the study's reference, is its limit and must be approached linearly as the impedance falls.

Along a direction of the controls the penalty cost is exactly quadratic while no contact event changes, since the
dynamics are affine between events. A difference quotient is then only rounding away from the derivative, and one that
straddles an event is recognised by the closed form's events. At an event of a contact with impedance d the force jumps
by d times the relative acceleration: differences across it measure the jump divided by the step, which no gradient
contains.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators import first_order, variance_interval, zeroth_order
from mjx_study.objective import SamplePrograms, Simulator
from mjx_study.reference import Pusher, ReferenceObjective, roll_out, value_and_gradients
from mjx_study.simulation.contact import ContactModel, family_model
from tests.pusher_fixtures import (
    HORIZON,
    INPUTS,
    SIGMA,
    START,
    ImpedancePusher,
    contact_events,
    cost,
    cost_and_gradient,
    directions,
    penalty,
    pusher_simulator,
    pusher_task,
    relative,
    sample_keys,
)

STABLE = [10.0, 100.0, 1000.0]
EPS = np.finfo(float).eps


@pytest.fixture
def simulator() -> Simulator:
    return pusher_simulator()


def mujoco_default() -> ContactModel:
    task = pusher_task()
    return family_model("mujoco_default", task.scene, effective_mass=task.effective_mass)


def gradient_of(system: Pusher, controls: np.ndarray) -> np.ndarray:
    return value_and_gradients(system, START, controls)[1].controls.ravel()


# Rollouts


@functools.cache
def states_program():
    """States of a noise-free rollout, the last included, through the task's own cost function."""
    programs, key = SamplePrograms(pusher_task()), jax.random.key_data(jax.random.key(0))
    program = jax.jit(lambda theta, contact: programs.cost(theta, contact, 1.0, key, 0.0)[1][0])

    def states(contact: ContactModel, controls: np.ndarray) -> np.ndarray:
        visited = program(jnp.asarray(controls.ravel()), contact)
        return np.concatenate([visited.qpos, visited.qvel], axis=1)

    return states


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("stiffness", [10.0, 1000.0])
def test_rollout_matches_the_reference_at_the_rate_of_the_impedance(stiffness, name):
    """Near the limit at impedance 1e-4, exact at equal impedance, and an error of order one in it.

    The impedance takes the share d of a_0 = |u| / m, a step in the drive of an oscillator of frequency sqrt(K / m_eff):
    each velocity moves by d a_0 / (2 frequency), and twice that is allowed: 7e-6 m/s at K = 10, u = 0.1.
    An error c d (1 + e d + ...) has the slope 1 + log10(1 + e d) over a decade. What e is follows from the law: the
    impedance removes the share d of the relative acceleration at each of H = 200 steps, so e d is at most about H d / 2
    = 1 at d = 1e-2 and 0.1 at 1e-3, and slopes lie within log10(1.1) = 0.04 and log10(2) = 0.3 of one.
    """
    controls, errors = INPUTS[name], []
    limit = roll_out(Pusher(stiffness), START, controls).states
    for impedance in (1e-4, 1e-3, 1e-2):
        states = states_program()(penalty(stiffness, impedance), controls)
        exact = roll_out(ImpedancePusher(stiffness, impedance=impedance), START, controls).states
        np.testing.assert_allclose(states, exact, rtol=0, atol=1e-11)  # K = 1000 amplifies rounding 1e4-fold
        errors.append(np.abs(states - limit).max())
    assert errors[0] < 1e-4 * np.abs(controls).max() / 0.1 * np.sqrt(0.05 / stiffness)
    lower, upper = np.diff(np.log10(errors))
    assert lower == pytest.approx(1, abs=0.04)
    assert upper == pytest.approx(1, abs=0.3)


# Gradients of the whole cost


@pytest.mark.parametrize("name", ["constant", "swell"])
def test_gradient_against_differences_mujoco_default(simulator, name):
    """MuJoCo's own contact: the impedance depends on penetration, so there is truncation, of second order in the step.

    Its events are not known in closed form. A difference that straddled one would be off by the jump over the step,
    and disagree between the steps and between the two sides; both are asked for.
    """
    contact, controls = mujoco_default(), INPUTS[name]
    value, gradient = cost_and_gradient(simulator, contact, controls)
    size = np.linalg.norm(gradient)
    for direction in directions(4, (0, 50, HORIZON - 1)):
        for step in (1e-2, 1e-3, 1e-4):
            ahead, behind = (cost(simulator, contact, controls + s * step * direction[:, None]) for s in (1, -1))
            assert abs((ahead - behind) / (2 * step) - gradient @ direction) <= 1e-6 * size
            # One-sided quotients differ by step times curvature; the Hessian's norm is about 2 R + 2 Q (h^2 / m)^2 H^3
            # = 2 + 0.1 * 200^3 * (2.5e-4)^2 * 20 / 0.1, below 100.
            assert abs(ahead - 2 * value + behind) / step <= 100 * step + 4 * HORIZON * EPS * value / step


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("stiffness", STABLE)
def test_gradient_against_the_hand_derived_one(simulator, stiffness, name):
    _, gradient = cost_and_gradient(simulator, penalty(stiffness), INPUTS[name])
    assert relative(gradient, gradient_of(Pusher(stiffness), INPUTS[name])) < 1e-3
    assert relative(gradient, gradient_of(ImpedancePusher(stiffness), INPUTS[name])) < 1e-11


@pytest.mark.parametrize("name", INPUTS)
def test_gradient_at_an_unstable_stiffness(simulator, name):
    """K = 1e4 (h^2 k = 5): every touch amplifies, and gradients reach 1e14. They are still exact.

    The limit d -> 0 is no yardstick here: at 200 steps an impedance of 1e-4 makes and breaks contact at other steps (5
    to 12 of 201 states), and the gradients differ by 80 % to 570 %. At the same impedance MJX agrees to 1e-9.
    The yardstick's own adjoint amplifies rounding by the growth of the states that precede it; 1e-6 leaves room.
    """
    controls = INPUTS[name]
    _, gradient = cost_and_gradient(simulator, penalty(1e4), controls)
    exact, limit = gradient_of(ImpedancePusher(1e4), controls), gradient_of(Pusher(1e4), controls)
    assert np.linalg.norm(exact) > 1e8
    assert relative(gradient, exact) < 1e-6
    assert np.any(contact_events(Pusher(1e4), controls) != contact_events(ImpedancePusher(1e4), controls))
    assert relative(exact, limit) > 0.1
    # Over the first ten steps the events agree, and so do the gradients.
    early = controls[:10]
    assert np.array_equal(contact_events(Pusher(1e4), early), contact_events(ImpedancePusher(1e4), early))
    assert relative(gradient_of(ImpedancePusher(1e4), early), gradient_of(Pusher(1e4), early)) < 1e-3


# Samples and the paper's variances


def test_same_keys_same_noise_in_mjx_and_reference(simulator):
    theta = pusher_task().theta
    mjx = simulator.objective(penalty(10.0))
    limit = ReferenceObjective(Pusher(10.0), tuple(START), HORIZON, SIGMA)
    exact = ReferenceObjective(ImpedancePusher(10.0), tuple(START), HORIZON, SIGMA)
    evaluated, differentiated = mjx.evaluate(theta, sample_keys(64)), mjx.differentiate(theta, sample_keys(64))
    np.testing.assert_array_equal(evaluated.value, differentiated.value)
    for reference, tolerance_value, tolerance_gradient in ((limit, 2e-6, 1e-5), (exact, 1e-13, 1e-12)):
        evaluation = reference.evaluate(theta, sample_keys(64))
        differentiation = reference.differentiate(theta, sample_keys(64))
        np.testing.assert_allclose(evaluated.score, evaluation.score, rtol=1e-14)
        np.testing.assert_allclose(evaluated.value, evaluation.value, rtol=tolerance_value)
        np.testing.assert_allclose(evaluated.baseline, evaluation.baseline, rtol=tolerance_value)
        for one, other in zip(differentiated.gradient, differentiation.gradient, strict=True):
            assert relative(one, other) < tolerance_gradient


@pytest.mark.parametrize(("stiffness", "calmer"), [(10.0, "first"), (1000.0, "zeroth")])
def test_stiffness_turns_the_order_of_variances(simulator, stiffness, calmer):
    """The paper's figure in MJX, as disjoint 99 % intervals of the variance of one sample."""
    objective, theta = simulator.objective(penalty(stiffness)), pusher_task().theta
    intervals = {
        "zeroth": variance_interval(zeroth_order(objective.evaluate(theta, sample_keys(300, 1)), "zero_noise"), 0.99),
        "first": variance_interval(first_order(objective.differentiate(theta, sample_keys(300, 2))), 0.99),
    }
    other = "zeroth" if calmer == "first" else "first"
    assert intervals[calmer][1] < intervals[other][0]
