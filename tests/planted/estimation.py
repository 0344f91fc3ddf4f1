"""Defects of objectives, estimators and references."""

from typing import Final

from tests.planted.defect import Defect

UNBIASED, VARIANCES = "tests/estimators/test_unbiasedness.py", "tests/estimators/test_variances.py"
STEPWISE, CHOICE = "tests/estimators/test_stepwise.py", "tests/estimators/test_interpolation.py"

OBJECTIVE: Final = (
    Defect(
        "trace-of-another-model",
        "mjx_study/digest.py",
        "(scene.adjoint, saved, scene.model, scene.template)",
        "(scene.adjoint, scene.template)",
        "a trace that an earlier run kept for one mass serves another",
        ("tests/test_compiled.py::test_what_differs_in_a_bit_has_a_trace_of_its_own",),
    ),
    Defect(
        "cost-after-the-step",
        "mjx_study/objective/cost.py",
        "return jax.tree.map(lambda leaf: leaf[:-1], states)",
        "return jax.tree.map(lambda leaf: leaf[1:], states)",
        "running costs of the states after the steps",
        ("tests/test_objective.py::test_cart_in_closed_form",),
    ),
    Defect(
        "baseline-with-noise",
        "mjx_study/objective/batches.py",
        "np.append(np.repeat(signs, samples), np.zeros(len(zero_noise)))",
        "np.append(np.repeat(signs, samples), np.ones(len(zero_noise)))",
        "still unbiased with one sample less, and no error anywhere",
        ("tests/test_objective.py::test_baseline_is_the_cost_without_noise",),
    ),
    Defect(
        "costs-so-far",
        "mjx_study/objective/programs.py",
        "jnp.cumsum(running[::-1])[::-1] + final_cost",
        "jnp.cumsum(running) + final_cost",
        "costs up to a step in place of those from it on",
        ("tests/test_batches.py::test_costs_to_go_are_sums_of_remaining_costs",),
    ),
    Defect(
        "score-without-its-scale",
        "estimators/noise.py",
        "NOISES[density].score(noise / sigma) / sigma",
        "NOISES[density].score(noise / sigma)",
        "the score of standard noise; right at sigma = 1",
        ("tests/reference/test_objective.py",),
    ),
)

ESTIMATORS: Final = (
    Defect(
        "mean-of-all-as-baseline",
        "estimators/zeroth_first.py",
        "(jnp.sum(value) - value) / jnp.maximum(num_others, 1.0)",
        "jnp.sum(value) / (num_others + 1.0)",
        "the batch's mean depends on the sample: biased by 1/N",
        (UNBIASED,),
    ),
    Defect(
        "weights-swapped",
        "estimators/interpolation.py",
        "ratio = variance_first / jnp.where(variance_zeroth == 0, 1.0, variance_zeroth)",
        "ratio = variance_zeroth / jnp.where(variance_first == 0, 1.0, variance_first)",
        "each estimate weighed by its own variance",
        (CHOICE,),
    ),
    Defect(
        "variance-of-a-mixture",
        "estimators/interpolation.py",
        "(1.0 - alpha, alpha), ((1.0 - alpha) ** 2, alpha**2)",
        "(1.0 - alpha, alpha), (1.0 - alpha, alpha)",
        "variances weighed as means are",
        (VARIANCES, CHOICE),
    ),
    Defect(
        "bound-without-dimension",
        "estimators/confidence.py",
        "jnp.asarray((estimate.mean.shape[0] + 1) / failure_probability, dtype)",
        "jnp.asarray(2 / failure_probability, dtype)",
        "the scalar inequality used for a vector",
        ("tests/estimators/test_confidence.py", CHOICE),
    ),
    Defect(
        "laplace-score",
        "estimators/noise.py",
        "score=lambda z: jnp.sign(z) / LAPLACE_SCALE",
        "score=lambda z: jnp.sign(z)",
        "the score at scale 1, where the variance is 2",
        (STEPWISE,),
    ),
    Defect(
        "control-variate-scale",
        "estimators/zeroth_first.py",
        "linear = scale**2 * jnp.sum",
        "linear = scale * jnp.sum",
        "sigma in place of its square: unbiased still, but no longer a control variate",
        (VARIANCES, UNBIASED),
    ),
    Defect(
        "pairs-as-samples",
        "estimators/zeroth_first.py",
        "return summarise((above + below) / 2.0)",
        "return summarise(jnp.concatenate([above, below]))",
        "the halves of a pair are not independent: the same mean, another standard error",
        (VARIANCES, STEPWISE),
    ),
    Defect(
        "cut-one-step-early",
        "estimators/recursion.py",
        "jnp.arange(1, horizon + 1) % window != 0",
        "jnp.arange(horizon) % window != 0",
        "windows counted from the wrong end",
        (STEPWISE,),
    ),
)

REFERENCES: Final = (
    Defect(
        "range-slope",
        "mjx_study/reference/projectiles.py",
        "slope = 2 * self.speed**2 / self.gravity * np.cos(2 * angle)",
        "slope = self.speed**2 / self.gravity * np.cos(2 * angle)",
        "the inner derivative of sin(2 angle) forgotten",
        ("tests/reference/test_functions.py",),
    ),
    Defect(
        "adjoint-not-transposed",
        "mjx_study/reference/system.py",
        'cost_states[..., step, :] + np.einsum("...ij,...i->...j", over_state, adjoint)',
        'cost_states[..., step, :] + np.einsum("...ij,...j->...i", over_state, adjoint)',
        "the Jacobian in place of its transpose",
        ("tests/reference/test_gradients.py",),
    ),
    Defect(
        "coriolis-term",
        "mjx_study/reference/double_pendulum.py",
        "sine * v2 * (2 * v1 + v2) - 2 * pull",
        "sine * v2 * (v1 + v2) - 2 * pull",
        "a factor of two in a velocity product",
        ("tests/reference/test_double_pendulum.py",),
    ),
    Defect(
        "impact-of-a-fixed-paddle",
        "mjx_study/reference/tennis.py",
        "slope[:, :2] - slope[:, 4:6]) - along[:, None] * slope[:, 6]",
        "slope[:, :2] - slope[:, 4:6])",
        "the time of impact without the paddle's turning",
        ("tests/reference/test_gradients.py",),
    ),
    Defect(
        "jump-term-density",
        "mjx_study/reference/function.py",
        "density.density(copies(jump.position)).sum() / sigma",
        "density.density(copies(jump.position)).sum()",
        "the density of standard noise; right at sigma = 1",
        ("tests/reference/test_functions.py",),
    ),
    Defect(
        "first-order-variance",
        "experiments/linear_quadratic.py",
        "4 * sigma**2 * np.sum(square**2)",
        "4 * sigma**2 * np.trace(square) ** 2",
        "the square of a trace in place of the trace of a square",
        ("tests/reference/test_linear_quadratic.py",),
    ),
)

ESTIMATION: Final = (*OBJECTIVE, *ESTIMATORS, *REFERENCES)
