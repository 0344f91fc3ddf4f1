"""From a task and a contact model to an objective: batching, devices, scores, baselines, failures, memory.

What does not depend on contact runs on a cart.
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from estimators import Evaluation, first_order, zeroth_order
from mjx_study.objective import MAX_CHUNK, MjxObjective, Simulator, chunk_for
from mjx_study.runtime import local_devices
from mjx_study.simulation import dynamics
from mjx_study.simulation.contact import ContactModel, family_model
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.tasks import make_task
from mjx_study.tasks.policy import LinearFeedback
from tests.carts import cart
from tests.processes import run_script
from tests.pusher_fixtures import HORIZON, NO_NOISE, SIGMA, cost, penalty, pusher_simulator, pusher_task, sample_keys

ANY_CONTACT = ContactModel(jnp.array([-1.0, -1.0]), jnp.array([0.9, 0.9, 0.001, 0.5, 2.0]))
LIMIT = 0.25  # [N]; controls beyond it have no cost in the task that breaks


@pytest.fixture
def simulator() -> Simulator:
    return pusher_simulator()


# Compilation, chunks, devices


def test_a_sweep_compiles_each_program_once(simulator, compilations):
    """13 stiffnesses, 2 families, and other theta and sigma."""
    task = pusher_task()
    for family in ("penalty", "impedance"):
        for stiffness in np.geomspace(1.0, 4000.0, 13):
            contact = family_model(family, task.scene, stiffness=float(stiffness), effective_mass=task.effective_mass)
            objective = simulator.objective(contact, sigma=float(0.01 * stiffness))
            values = objective.evaluate(task.theta * stiffness, sample_keys(2)).value
            gradients = objective.differentiate(task.theta * stiffness, sample_keys(2)).gradient
            assert np.all(np.isfinite(values)) and np.all(np.isfinite(gradients))
    assert all(compilations.count(name) <= 1 for name in ("jit(value)", "jit(gradient)"))  # 0 if other tests had it


@pytest.fixture(scope="module")
def cart_evaluations() -> dict[tuple[int, int], Evaluation]:
    """The same 7 samples by (chunk size, devices); 7 fits none of the chunks."""
    task, results = cart(), {}
    for chunk, devices in ((2, 2), (3, 2), (100, 2), (3, 1)):
        simulator = Simulator(task, chunk, tuple(local_devices()[:devices]))
        results[chunk, devices] = simulator.objective(ANY_CONTACT).evaluate(task.theta, sample_keys(7))
    return results


def test_neither_chunks_nor_devices_matter(cart_evaluations):
    """Of devices not a bit depends; chunks of another size are another program, which may round differently."""
    assert len(local_devices()) == 2
    for one, other in zip(*(jax.tree.leaves(cart_evaluations[3, devices]) for devices in (1, 2)), strict=True):
        np.testing.assert_array_equal(one, other)
    first, *others = cart_evaluations.values()
    assert first.value.shape == (7,) and len(np.unique(first.value)) == 7
    for other in others:
        for field in ("value", "score", "baseline"):
            np.testing.assert_allclose(getattr(other, field), getattr(first, field), rtol=1e-12)


def test_cart_in_closed_form(cart_evaluations):
    """Semi-implicit Euler by hand, with the noise that the scores hold."""
    evaluation = cart_evaluations[3, 2]
    for value, score in zip(evaluation.value, evaluation.score, strict=True):
        position, velocity, total = 1.0, 0.0, 0.0
        for control in np.linspace(0.0, 0.2, 5) + 0.1**2 * np.asarray(score):
            total += position**2 + control**2
            velocity += 0.01 * (control - 0.1 * velocity)
            position += 0.01 * velocity
        assert value == pytest.approx(total + velocity**2, rel=1e-13)


def test_a_sample_depends_on_its_own_key_alone(simulator):
    objective, theta = simulator.objective(penalty(10.0)), pusher_task().theta
    order = np.random.default_rng(0).permutation(70)
    straight = objective.evaluate(theta, sample_keys(70)), objective.differentiate(theta, sample_keys(70))
    mixed = (objective.evaluate(theta, sample_keys(70)[order]), objective.differentiate(theta, sample_keys(70)[order]))
    for one, other in zip(straight, mixed, strict=True):
        np.testing.assert_allclose(other.value, one.value[order], rtol=1e-12)
    np.testing.assert_array_equal(mixed[0].score, straight[0].score[order])
    scale = np.abs(straight[1].gradient).max()
    np.testing.assert_allclose(mixed[1].gradient, straight[1].gradient[order], rtol=1e-12, atol=1e-12 * scale)
    alone = objective.evaluate(theta, sample_keys(70)[4:5])
    np.testing.assert_allclose(alone.value[0], straight[0].value[4], rtol=1e-12)


def test_a_chunk_of_gradients_fits_into_an_accelerators_memory(simulator):
    def chunk(gib):
        device = SimpleNamespace(platform="gpu", memory_stats=lambda: {"bytes_limit": gib * 2**30})
        return chunk_for(100_000, [device], [simulator.task])

    planned = simulator.memory("gradient", ANY_CONTACT, 1000) / 1000
    assert chunk(2000) == 100_001
    assert 0.2 * 2**28 < chunk(1) * planned < 2 * 2**28


@pytest.mark.usefixtures("natively")
@pytest.mark.parametrize(
    ("samples", "chunk"), [(1, 11), (10, 11), (11, 101), (100, 101), (400, 101), (1999, 101), (10**6, 201)]
)
def test_cpu_chunks_have_few_sizes_for_any_number_of_devices(samples, chunk):
    device = SimpleNamespace(platform="cpu", memory_stats=lambda: None)
    assert chunk_for(samples, [device]) == chunk_for(samples, [device] * 3) == chunk


@pytest.mark.parametrize(("samples", "devices"), [(1, 2), (7, 2), (1000, 2), (1023, 1), (200_000, 3)])
def test_chunks_on_an_accelerator_waste_less_than_a_call_per_device(samples, devices):
    device = SimpleNamespace(platform="gpu", memory_stats=lambda: None)
    chunk, most = chunk_for(samples, [device] * devices), MAX_CHUNK["gpu"]
    calls = -(-(samples + 1) // (chunk * devices))
    assert 1 <= chunk <= most
    assert calls == -(-(samples + 1) // (most * devices))  # no more calls than the largest chunk would take
    assert (chunk - calls) * calls * devices < samples + 1  # smaller chunks of that number would not hold them


# Orders of the oracle


def test_evaluating_never_differentiates_the_dynamics(monkeypatch):
    def forbidden(*arguments):
        raise RuntimeError("differentiated")

    task = make_task("pusher", horizon=2)
    monkeypatch.setattr(dynamics, "step_change", forbidden)
    objective, theta = Simulator(task, chunk_size=3).objective(penalty(10.0)), task.theta
    objective.evaluate(theta, sample_keys(7))
    with pytest.raises(RuntimeError, match="differentiated"):
        objective.differentiate(theta, sample_keys(7))


# Scores and baselines


def test_score_is_the_noise_over_its_variance(simulator):
    """The cost of theta + sigma^2 score without noise is the sample's; scores scale as 1 / sigma."""
    objective, theta = simulator.objective(penalty(10.0)), pusher_task().theta
    evaluation = objective.evaluate(theta, sample_keys(3))
    for value, score in zip(evaluation.value, evaluation.score, strict=True):
        explicit = cost(simulator, penalty(10.0), np.asarray(theta + SIGMA**2 * score))
        assert value == pytest.approx(explicit, rel=1e-12)
    wider = simulator.objective(penalty(10.0), 3 * SIGMA).evaluate(theta, sample_keys(3))
    np.testing.assert_allclose(wider.score, evaluation.score / 3, rtol=1e-13)
    assert np.all(wider.value != evaluation.value)


def test_baseline_is_the_cost_without_noise(simulator):
    objective, theta = simulator.objective(penalty(100.0)), pusher_task().theta
    evaluation = objective.evaluate(theta, sample_keys(3))
    silent = simulator.objective(penalty(100.0), NO_NOISE).differentiate(theta, sample_keys(3))
    np.testing.assert_array_equal(evaluation.baseline, np.broadcast_to(evaluation.baseline[0], 3))
    np.testing.assert_allclose(evaluation.baseline, silent.value, rtol=1e-14)
    assert np.all(np.abs(evaluation.value / evaluation.baseline - 1) > 1e-6)


def test_odd_part_is_half_the_difference_of_mirrored_noise(simulator):
    objective, theta = simulator.objective(penalty(100.0)), pusher_task().theta
    odd = objective.evaluate_odd(theta, sample_keys(5))
    plain = objective.evaluate(theta, sample_keys(5))
    np.testing.assert_array_equal(odd.score, plain.score)
    np.testing.assert_array_equal(odd.baseline, np.zeros(5))
    assert odd.residual is not None and odd.residual.shape == (5,)
    for value, ahead, score in zip(odd.value, plain.value, odd.score, strict=True):
        behind = cost(simulator, penalty(100.0), np.asarray(theta - SIGMA**2 * score))
        # Rounding of two costs of 1.8e3, in a difference of about 10.
        assert value == pytest.approx((float(ahead) - behind) / 2, abs=1e-12 * behind)


# Feedback and random starts: one variant of the pusher


def features(state: State):
    """One, and both positions and velocities: theta is a constant push and 4 gains."""
    return jnp.concatenate([jnp.ones(1), state.qpos, state.qvel])


STEPS = 20
GAINS = jnp.array([0.3, -0.1, 0.05, -0.2, 0.1])


@pytest.fixture(scope="module")
def closed_loop() -> Simulator:
    task = make_task("pusher", horizon=STEPS)

    def start(key):
        """Apart by up to 1 mm and moving together: all samples touch soon."""
        gap = 1e-3 * jax.random.uniform(key)
        return initial_state(task.scene, qpos=jnp.stack([0.0 * gap, 1.0 + gap]), qvel=jnp.array([0.1, 0.0]))

    policy = LinearFeedback(STEPS, 1, 5, features)
    return Simulator(task.replace(policy=policy, theta=GAINS, start=start), chunk_size=16)


def test_each_sample_has_the_baseline_of_its_random_start(closed_loop):
    assert closed_loop.task.random_start and not pusher_task().random_start
    noisy = closed_loop.objective(penalty(100.0)).evaluate(GAINS, sample_keys(5))
    silent = closed_loop.objective(penalty(100.0), NO_NOISE).differentiate(GAINS, sample_keys(5))
    np.testing.assert_allclose(noisy.baseline, silent.value, rtol=1e-14)
    assert len(np.unique(noisy.baseline)) == 5


def test_gradient_through_feedback_against_differences(closed_loop):
    """Common random numbers; the cost is a polynomial of the gains between events: truncation is step^2."""
    objective = closed_loop.objective(penalty(100.0))
    gradient = np.asarray(objective.differentiate(GAINS, sample_keys(16)).gradient)
    for index in range(5):
        shift = 1e-4 * jnp.eye(5)[index]
        ahead, behind = (objective.evaluate(GAINS + sign * shift, sample_keys(16)).value for sign in (1, -1))
        # 3 of 16 samples may straddle an onset, where the force jumps by 1e-4 of the approach's acceleration.
        errors = np.abs((ahead - behind) / 2e-4 - gradient[:, index]) / np.linalg.norm(gradient, axis=1)
        assert np.sum(errors < 1e-6) >= 13, errors


def test_odd_part_refuses_feedback(closed_loop):
    with pytest.raises(ValueError, match="needs a policy whose noise is added to theta"):
        closed_loop.objective(penalty(10.0)).evaluate_odd(GAINS, sample_keys(2))


# What can fail


def test_nonfinite_samples_are_counted_and_left_out():
    def breaks(state, control):
        return jnp.where(control[0] > LIMIT, jnp.nan, jnp.sum(state.qpos**2) + jnp.sum(control**2))

    task = cart(breaks)
    objective = Simulator(task, chunk_size=20).objective(ANY_CONTACT)
    evaluation, differentiation = (
        objective.evaluate(task.theta, sample_keys(40)),
        objective.differentiate(task.theta, sample_keys(40)),
    )
    over = np.any(np.asarray(task.theta + 0.1**2 * evaluation.score) > LIMIT, axis=1)
    assert 5 < over.sum() < 35
    for value in (evaluation.value, differentiation.value):
        np.testing.assert_array_equal(np.isnan(value), over)
    zeroth, first = zeroth_order(evaluation, "zero_noise"), first_order(differentiation)
    rows = np.asarray((evaluation.value - evaluation.baseline)[:, None] * evaluation.score)
    assert zeroth.num_nonfinite == first.num_nonfinite == over.sum()
    np.testing.assert_allclose(zeroth.mean, rows[~over].mean(0), rtol=1e-12)
    np.testing.assert_allclose(first.mean, np.asarray(differentiation.gradient)[~over].mean(0), rtol=1e-12)


def test_nan_parameters_end_and_are_counted(simulator):
    """The solver's loop meets NaN in every sample and must leave."""
    theta = pusher_task().theta.at[100].set(jnp.nan)
    objective = simulator.objective(penalty(10.0))
    assert zeroth_order(objective.evaluate(theta, sample_keys(3)), "zero_noise").num_finite == 0
    assert first_order(objective.differentiate(theta, sample_keys(3))).num_finite == 0


def test_residual_of_the_shipped_budget_is_rounding(simulator):
    for stiffness in np.geomspace(1.0, 3e4, 13):
        objective = simulator.objective(penalty(float(stiffness)))
        for batch in (
            objective.evaluate(pusher_task().theta, sample_keys(16)),
            objective.differentiate(pusher_task().theta, sample_keys(16)),
        ):
            assert batch.residual is not None and float(batch.residual.max()) < 1e-8


# Refusals


BATCHES = ("evaluate", "differentiate", "evaluate_odd")
SIGMA_RANGE, THETA_SHAPE = "sigma must be positive and finite", r"theta has shape \(199,\), the policy needs \(200,\)"


@pytest.mark.parametrize("name", BATCHES)
@pytest.mark.parametrize(
    ("sigma", "params", "samples", "message"),
    [
        *[(sigma, HORIZON, 2, SIGMA_RANGE) for sigma in (0.0, -1.0, float("nan"), float("inf"))],
        (None, HORIZON - 1, 2, THETA_SHAPE),
        (None, HORIZON, 0, "at least one key"),
    ],
)
def test_batches_refuse(simulator, name: str, sigma: float | None, params: int, samples: int, message: str):
    objective = simulator.objective(penalty(10.0), sigma)
    with pytest.raises(ValueError, match=message):
        getattr(objective, name)(jnp.zeros(params), sample_keys(2)[:samples])


def longer() -> MjxObjective:
    """Of a task with more steps than its policy has."""
    return Simulator(pusher_task().replace(horizon=HORIZON + 1), chunk_size=1).objective(None)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Simulator(pusher_task(), chunk_size=0), "chunk_size must be at least 1 sample, got 0"),
        (lambda: make_task("pusher", horizon=0), "horizon must be at least 1 step, got 0"),
        (
            lambda: longer().evaluate(pusher_task().theta, sample_keys(1)),
            f"the policy's feedforward has shape .{HORIZON}, 1.; {HORIZON + 1} steps and 1 controls need",
        ),
        (lambda: initial_state(pusher_task().scene, jnp.zeros(3)), "qpos has shape .3,.; the scene needs .2,."),
        (lambda: pusher_task().replace(sigma=0.0), SIGMA_RANGE),
        (lambda: pusher_task().replace(theta=jnp.zeros(HORIZON - 1)), THETA_SHAPE),
    ],
)
def test_tasks_and_simulators_refuse(make, message: str):
    with pytest.raises(ValueError, match=message):
        make()


IN_32_BITS = """
import jax, jax.numpy as jnp
from mjx_study import configure
configure(precision="float32")
from tests.test_objective import without_noise
print(*without_noise())
"""


def without_noise() -> np.ndarray:
    """The pusher's gradient over four forces through a spring."""
    task = make_task("pusher", horizon=4)
    objective = Simulator(task.replace(sigma=1e-30), chunk_size=1).objective(penalty(100.0))
    found = objective.differentiate(task.theta, jax.random.split(jax.random.key(0), 1)).gradient
    assert found.dtype == task.theta.dtype
    return np.asarray(found[0])


def test_gradients_in_32_bits() -> None:
    single = np.array(run_script(IN_32_BITS).stdout.split(), float)
    double = without_noise()
    assert 0 < np.max(np.abs(single / double - 1)) < 1e-4  # it is not the same to the last bit
