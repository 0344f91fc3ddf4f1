"""Estimates from single steps and from the backward recursion: identities, means, variances, and where they fail."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

import estimators
from estimators import (
    ESTIMATORS,
    NOISES,
    Differentiation,
    Estimator,
    Evaluation,
    GradientEstimate,
    Linearisation,
    StepDifferentiation,
    StepEvaluation,
    discontinuity_gated,
    first_order,
    pull_back,
    stepwise_inverse_variance,
    total_propagation,
    truncated_first_order,
)
from estimators.noise import split_sample_key
from estimators.stepwise import control_scores
from tests.estimators import objectives
from tests.estimators.statistics_helpers import assert_mean_is

SAMPLES = 100_000
FEEDBACK, SYSTEM = objectives.FEEDBACK, objectives.SYSTEM
THETA = np.array([0.4, 0.1, 0.2, 0.5])
NEUTRAL = ("fobg_clipped", "fobg_truncated")
"""Biased in general, but not with a clip beyond every sample and a window beyond the horizon."""
UNBIASED = [name for name, estimator in ESTIMATORS.items() if estimator.unbiased != "no"]
BLIND = ("fobg", "fobg_onset", "ivw", "aobg", "aobg_onset", "ivw_h", "total_propagation")
"""Estimators that trust a derivative without variance."""
SIGHTED = ("zobg", "zobg_antithetic", "zobg_to_go", "zobg_to_go_antithetic", "ddcg", "delta")


def make(name: str, objective, **changes) -> Estimator:
    options = {"failure_probability": 0.1, "sigma": objective.sigma, "max_norm": 1e9, "window": 99} | changes
    return estimators.make_estimator(name, **options)


def run_all(chosen: dict[str, Estimator], objective, theta, samples: int = SAMPLES) -> dict[str, GradientEstimate]:
    """What each gives of the same batches."""
    needed = estimators.oracles_of(chosen.values())
    drawn = estimators.draw(needed, objective, jnp.asarray(theta), jax.random.key(3), samples)
    return {name: jax.jit(each)({oracle: drawn[oracle] for oracle in each.needs}) for name, each in chosen.items()}


def run(name: str, objective, theta, *, samples: int = SAMPLES, **changes) -> GradientEstimate:
    return run_all({name: make(name, objective, **changes)}, objective, theta, samples)[name]


@pytest.fixture(scope="module")
def lots() -> dict[str, dict[str, GradientEstimate]]:
    """Every estimator on a feedback policy and on an open loop, both smooth."""
    smooth = objectives.quadratic(objectives.HESSIAN, 0.7)
    every = {name: make(name, FEEDBACK) for name in ESTIMATORS if name != "delta"}
    return {
        "feedback": run_all(every, FEEDBACK, THETA),
        "open loop": run_all({name: make(name, smooth) for name in ESTIMATORS}, smooth, [1.5, -2.0, 1.0]),
    }


@pytest.mark.parametrize("name", [*UNBIASED, *NEUTRAL])
@pytest.mark.parametrize("case", ["feedback", "open loop"])
def test_every_estimator_is_unbiased_where_the_objective_is_smooth(case: str, name: str, lots) -> None:
    if (case, name) == ("feedback", "delta"):
        pytest.skip("its mean is known for noise on theta itself only")
    exact = objectives.of_feedback(THETA)[1] if case == "feedback" else objectives.HESSIAN @ np.array([1.5, -2.0, 1.0])
    estimate = lots[case][name]
    z = (np.asarray(estimate.mean) - np.asarray(exact)) / np.asarray(estimate.standard_error)
    assert np.all(np.abs(z) < 4.0), z
    assert np.linalg.norm(estimate.standard_error) * 4 < 0.1 * np.linalg.norm(exact), "no power"


def test_less_variance_where_theory_says_so(lots) -> None:
    """Costs to go and antithetic pairs below their parents; a weight for every step below one for all."""
    variance = {name: float(estimate.variance) for name, estimate in lots["feedback"].items()}
    assert variance["zobg_to_go"] < 0.95 * variance["zobg"]
    assert variance["zobg_to_go_antithetic"] < 0.95 * variance["zobg_to_go"]
    assert variance["zobg_antithetic"] < 0.95 * variance["zobg"]
    assert variance["ivw_h"] < variance["ivw"] < 0.95 * variance["fobg"]


@pytest.mark.parametrize("name", [*BLIND, *SIGHTED])
def test_estimators_at_a_jump(name: str) -> None:
    """Zeroth order finds the jump's slope, inverse variances trust the flat derivative, DDCG's test sees the jump."""
    objective, theta = objectives.heaviside(0.6), [0.3]
    exact = objectives.heaviside_gradient(jnp.asarray(theta), 0.6)
    estimate = run(name, objective, theta)
    if name in BLIND:
        assert estimate.mean[0] == 0.0 and exact[0] > 0.5
    else:
        assert_mean_is(estimate.per_sample, exact)
    if name == "ddcg":
        assert estimate.alpha is not None and estimate.alpha.alpha == 0.0


@pytest.mark.parametrize("baseline", ["none", "zero_noise", "leave_one_out"])
def test_costs_to_go_are_unbiased_with_every_baseline(baseline: str) -> None:
    estimate = run("zobg_to_go", FEEDBACK, THETA, samples=400_000, baseline=baseline)
    assert_mean_is(estimate.per_sample, objectives.of_feedback(THETA)[1], resolution=0.1)


@pytest.fixture(scope="module")
def few() -> tuple[Differentiation, StepDifferentiation, Linearisation, StepEvaluation, Evaluation]:
    """The same 40 rollouts in every form."""
    theta, keys = jnp.asarray(THETA), jax.random.split(jax.random.key(5), 40)

    methods = ("differentiate", "differentiate_steps", "linearise", "evaluate_steps", "evaluate")
    return tuple(getattr(FEEDBACK, name)(theta, jax.random.clone(keys)) for name in methods)


@pytest.mark.parametrize("window", [1, 2])
def test_a_truncated_adjoint_is_a_sum_over_windows(few, window: int) -> None:
    """Against forward differentiation of each window's costs alone, from the states where it begins."""
    linearisation = few[2]
    keys = jax.random.split(jax.random.key(5), 40)
    starts = jax.vmap(lambda key: objectives.draw_start(split_sample_key(key)[0]))(keys)
    noise = FEEDBACK.sigma**2 * linearisation.steps.noise_score
    cuts = [*range(0, FEEDBACK.horizon, window), FEEDBACK.horizon]

    def cost(theta: Array, start: Array, noise: Array) -> Array:
        total, state = jnp.zeros(()), start
        for low, high in zip(cuts[:-1], cuts[1:], strict=True):
            state = jax.lax.stop_gradient(state)
            for step in range(low, high):
                control = theta.reshape(2, 2) @ state + noise[step]
                total += state @ SYSTEM.state_weight @ state + control @ SYSTEM.control_weight @ control
                state = jnp.asarray(SYSTEM.transition) @ state + jnp.asarray(SYSTEM.control) @ control
            if high == FEEDBACK.horizon:
                total += state @ SYSTEM.final_weight @ state
        return total

    expected = jax.jit(jax.vmap(jax.grad(cost), in_axes=(None, 0, 0)))(jnp.asarray(THETA), starts, noise)
    np.testing.assert_allclose(truncated_first_order(linearisation, window).per_sample, expected, rtol=1e-11)


def test_stepwise_weights_are_those_of_each_step(few) -> None:
    """By NumPy; and a step without first-order variance takes the derivative alone."""
    *_, steps, _ = few
    first = few[1]
    estimate = stepwise_inverse_variance(steps, first, "zero_noise")
    scores = np.asarray(control_scores(steps, "zero_noise"))
    gradients = np.asarray(first.noise_gradient)
    alpha = scores.var(0, ddof=1) / (scores.var(0, ddof=1) + gradients.var(0, ddof=1))
    expected = pull_back(jnp.asarray((1 - alpha) * scores), steps.policy_jacobian) + pull_back(
        jnp.asarray(alpha * gradients), first.policy_jacobian
    )
    np.testing.assert_allclose(estimate.mean, np.mean(expected, 0), rtol=1e-10)
    assert estimate.alpha is not None
    np.testing.assert_allclose(estimate.alpha.alpha, alpha.mean(), rtol=1e-12)
    certain = replace(first, noise_gradient=jnp.broadcast_to(first.noise_gradient[:1], gradients.shape))
    assert stepwise_inverse_variance(steps, certain, "zero_noise").alpha.alpha == 1.0  # type: ignore[union-attr]


def test_propagation_is_the_recursion_written_out(few) -> None:
    """By NumPy, sample by sample, with the weights of each step's shares of the gradient."""
    linearisation = few[2]
    steps, scores = linearisation.steps, np.asarray(control_scores(linearisation.steps, "none"))
    adjoint, gradient = np.asarray(linearisation.final_state), 0.0
    jacobian = np.asarray(steps.policy_jacobian)
    for step in reversed(range(FEEDBACK.horizon)):
        over_control = np.asarray(linearisation.over_control[:, step])
        derivative = np.asarray(linearisation.cost_control[:, step]) + np.einsum("isc,is->ic", over_control, adjoint)
        shares = [np.einsum("icp,ic->ip", jacobian[:, step], part) for part in (scores[:, step], derivative)]
        low, high = (np.trace(np.cov(share.T)) for share in shares)
        alpha = low / (low + high)
        mixed = alpha * derivative + (1 - alpha) * scores[:, step]
        gradient = gradient + np.einsum("icp,ic->ip", jacobian[:, step], mixed)
        assert linearisation.policy_state is not None
        adjoint = (
            np.asarray(linearisation.cost_state[:, step])
            + np.einsum("ist,is->it", linearisation.over_state[:, step], adjoint)
            + np.einsum("ics,ic->is", linearisation.policy_state[:, step], mixed)
        )
    np.testing.assert_allclose(total_propagation(linearisation, "none").per_sample, gradient, rtol=1e-10)


def test_lost_samples_do_not_spoil_the_rest(few) -> None:
    """A value, or a derivative, that is not finite takes its own row with it and no other."""
    *_, linearisation, steps, _ = few
    broken = replace(steps, value_to_go=steps.value_to_go.at[3].set(jnp.nan))
    estimate = stepwise_inverse_variance(broken, few[1], "leave_one_out")
    assert estimate.num_nonfinite == 1 and np.all(np.isfinite(estimate.mean))
    wild = replace(few[1], noise_gradient=few[1].noise_gradient.at[7, 1].set(jnp.inf))
    assert stepwise_inverse_variance(broken, wild, "none").num_nonfinite == 2
    lost = replace(linearisation, steps=broken, over_state=linearisation.over_state.at[9].set(jnp.nan))
    for result in (total_propagation(lost, "zero_noise"), truncated_first_order(lost, 3)):
        assert result.num_nonfinite == 2 and np.all(np.isfinite(result.mean))


def test_ddcg_is_exact_on_quadratics_and_sees_a_jump() -> None:
    """Without tolerance, a quadratic is just at the boundary: both sides agree within sampling, 0.3 %."""
    objective, theta = objectives.quadratic(objectives.HESSIAN, 0.7), jnp.array([0.15, -0.2, 0.1])
    keys = jax.random.split(jax.random.key(6), 400_000)
    batch, evaluation = objective.differentiate_steps(theta, keys), objective.evaluate(theta, jax.random.clone(keys))
    gradients = np.asarray(batch.noise_gradient[:, 0])
    left = np.trace(np.cov(gradients.T))
    right = 2 * np.var(np.asarray(evaluation.value)) / 0.49 - 2 * np.sum(gradients.mean(0) ** 2)
    assert left == pytest.approx(right, rel=0.02)
    assert discontinuity_gated(evaluation, batch, "zero_noise", 0.7).alpha.alpha > 0  # type: ignore[union-attr]
    with pytest.raises(ValueError, match=r"must lie in \[0, 1\); got 1.5"):
        discontinuity_gated(evaluation, batch, "zero_noise", 0.7, tolerance=1.5)


def test_clipping_bounds_every_sample_and_its_bias() -> None:
    objective, theta = objectives.quadratic(objectives.HESSIAN, 0.7), [1.5, -2.0, 1.0]
    free, clipped = run("fobg", objective, theta), run("fobg_clipped", objective, theta, max_norm=2.0)
    norms = np.linalg.norm(free.per_sample, axis=1)
    np.testing.assert_allclose(np.linalg.norm(clipped.per_sample, axis=1), np.minimum(norms, 2.0), rtol=1e-12)
    inside = norms <= 2.0
    np.testing.assert_array_equal(np.asarray(clipped.per_sample)[inside], np.asarray(free.per_sample)[inside])
    assert np.linalg.norm(clipped.mean - free.mean) <= np.mean(np.maximum(norms - 2.0, 0.0)) + 1e-12
    huge = Differentiation(jnp.zeros(2), jnp.array([[3e200, 4e200], [0.0, 0.0]]))
    np.testing.assert_allclose(
        estimators.clipped_first_order(huge, 5.0).per_sample, [[3.0, 4.0], [0.0, 0.0]], rtol=1e-14
    )
    assert first_order(huge).num_finite == 2


def test_windows_and_shapes_out_of_range_are_refused(few) -> None:
    with pytest.raises(ValueError, match="at least 1 step; got 0"):
        truncated_first_order(few[2], 0)
    half = jax.tree.map(lambda leaf: leaf[:20], few[3])
    with pytest.raises(ValueError, match=r"same shape .* got \(20, 3, 2\) zeroth-order and \(40, 3, 2\) first-order"):
        stepwise_inverse_variance(half, few[1], "none")
    for act in (lambda: estimators.cost_to_go(few[3], "mean"), lambda: total_propagation(few[2], "mean")):
        with pytest.raises(ValueError, match="unknown baseline 'mean'; choose from none, zero_noise, leave_one_out"):
            act()


@pytest.mark.parametrize("name", NOISES)
def test_a_noise_density_and_its_score(name: str) -> None:
    """Mean 0, variance 1; E[psi'] = 0, E[z psi'] = 1, E[psi'^2] as stated: Stein's identities."""
    noise = NOISES[name]
    z = noise.draw(jax.random.key(7), (400_000, 1), jnp.float64)
    score = noise.score(z)
    moments = jnp.concatenate([z**2, z * score, score**2], axis=1)
    assert_mean_is(moments, [1.0, 1.0, noise.information], resolution=0.06)
    spread = np.asarray([z.std(), score.std()])[:, None] / np.sqrt(len(z))
    assert np.all(np.abs([z.mean(), score.mean()])[:, None] < 4 * spread)
    assert noise.name == name and noise.information >= 1.0
