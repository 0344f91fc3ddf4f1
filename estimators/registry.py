"""The estimators by name, and one way to run any of them.

To add one: a function from batches to a `GradientEstimate`, and an entry in `ESTIMATORS` that says which batches it
needs.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import jax
from jaxtyping import Array, Float, Key

from estimators.alpha_order import choose_alpha, interpolate
from estimators.baselines import find_baseline
from estimators.confidence import bernstein_epsilon, check_confidence_arguments
from estimators.cross_fitting import PLUG_IN, check_weights, weigh_batches
from estimators.ddcg import PUBLISHED_TOLERANCE, discontinuity_gated
from estimators.first_order import clipped_first_order, first_order
from estimators.propagation import total_propagation, truncated_first_order
from estimators.stepwise import antithetic_cost_to_go, cost_to_go, stepwise_inverse_variance
from estimators.types import GradientEstimate, Objective
from estimators.zeroth_order import antithetic, delta_control_variate, zeroth_order


@dataclass(frozen=True, kw_only=True)
class EstimatorOptions:
    """What an estimate depends on beside its samples; hashable, so that it can be static under `jit`.

    Attributes:
        baseline: Name in `BASELINES`, for the zeroth-order batch.
        gamma: Largest error to accept, > 0 or infinity, [cost/param]; "aobg" only.
        failure_probability: Of the confidence radius, in (0, 1).
        variance_proxy: "variance", "second_moment" or "upper_bound"; see `bernstein_epsilon`.
        radius: "max_deviation" or a bound >= 0 on ||g_i - E g||, [cost/param].
        sigma: Standard deviation of the noise, > 0, [control]; "ddcg" and "delta" only.
        max_norm: Of a sample, > 0, [cost/param]; "fobg_clipped" only.
        window: Steps between cuts of the adjoint, >= 1; "fobg_truncated" only.
        tolerance: c of the discontinuity test, in [0, 1); "ddcg" only.
        weights: Name in `WEIGHTS`, of the estimators that interpolate.

    Raises:
        ValueError: A field is outside its range.
    """

    baseline: str = "zero_noise"
    gamma: float
    failure_probability: float
    variance_proxy: str
    radius: str | float
    sigma: float | None = None
    max_norm: float | None = None
    window: int | None = None
    tolerance: float = PUBLISHED_TOLERANCE
    weights: str = PLUG_IN

    def __post_init__(self):
        find_baseline(self.baseline)
        if not self.gamma > 0.0:
            raise ValueError(f"gamma must be positive; got {self.gamma}; float('inf') sets no limit")
        for name in ("sigma", "max_norm"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < float("inf"):
                raise ValueError(f"{name} must be positive and finite; got {value}")
        if self.window is not None and self.window < 1:
            raise ValueError(f"window must be at least 1 step; got {self.window}")
        if not 0.0 <= self.tolerance < 1.0:
            raise ValueError(f"tolerance must lie in [0, 1); got {self.tolerance}")
        check_weights(self.weights)
        check_confidence_arguments(self.failure_probability, self.variance_proxy, self.radius)


@dataclass(frozen=True)
class Oracle:
    """A kind of batch.

    Attributes:
        name: As estimators ask for it.
        order: 0 if only values are needed, 1 if derivatives; batches of one order share their samples.
        method: Of the objective, called with theta and keys.
        phrase: For a message.
    """

    name: str
    order: int
    method: str
    phrase: str


ORACLES: Final[dict[str, Oracle]] = {
    oracle.name: oracle
    for oracle in (
        Oracle("evaluation", 0, "evaluate", "a zeroth-order batch"),
        Oracle("pair", 0, "evaluate_pair", "a zeroth-order batch of pairs"),
        Oracle("steps", 0, "evaluate_steps", "a zeroth-order batch step by step"),
        Oracle("step_pair", 0, "evaluate_step_pair", "a zeroth-order batch of pairs step by step"),
        Oracle("differentiation", 1, "differentiate", "a first-order batch"),
        Oracle("step_differentiation", 1, "differentiate_steps", "a first-order batch step by step"),
        Oracle("linearisation", 1, "linearise", "a first-order batch with the derivatives of its steps"),
    )
}

Batches = Mapping[str, Any]
"""Batches by the name of their oracle."""


@dataclass(frozen=True)
class Estimator:
    """An estimator's name, needs and formula.

    Attributes:
        name: Key in `ESTIMATORS`.
        description: One line for a legend or a help text.
        needs: Oracles in `ORACLES`, in the order in which `combine` takes their batches.
        combine: From those batches and the options to the estimate.
        requires: Options that must be set.
    """

    name: str
    description: str
    needs: tuple[str, ...]
    combine: Callable[..., GradientEstimate]
    requires: tuple[str, ...] = ()

    def check(self, options: EstimatorOptions) -> None:
        """Raises ValueError if an option that it requires is not set."""
        for name in self.requires:
            if getattr(options, name) is None:
                raise ValueError(f"{self.name!r} needs the option {name}; set it")


def _alpha_order(evaluation, differentiation, options: EstimatorOptions, *, unlimited: bool = False):
    def choose(evaluation, differentiation):
        zeroth = zeroth_order(evaluation, options.baseline)
        epsilon = bernstein_epsilon(
            zeroth,
            failure_probability=options.failure_probability,
            variance_proxy=options.variance_proxy,
            radius=options.radius,
        )
        gamma = float("inf") if unlimited else options.gamma
        return choose_alpha(zeroth, first_order(differentiation), gamma=gamma, epsilon=epsilon)

    def mix(choice, evaluation, differentiation):
        mixed = interpolate(zeroth_order(evaluation, options.baseline), first_order(differentiation), choice.alpha)
        return replace(mixed, alpha=choice)

    return weigh_batches(choose, mix, (evaluation, differentiation), options.weights)


def _delta(evaluation, differentiation, options: EstimatorOptions):
    assert options.sigma is not None
    return delta_control_variate(evaluation, first_order(differentiation).mean, options.sigma)


ESTIMATORS: dict[str, Estimator] = {
    estimator.name: estimator
    for estimator in (
        Estimator(
            "zobg",
            "zeroth order: values times scores",
            ("evaluation",),
            lambda batch, options: zeroth_order(batch, options.baseline),
        ),
        Estimator(
            "zobg_antithetic",
            "zeroth order over pairs of opposite noise",
            ("pair",),
            lambda pair, options: antithetic(pair[0], pair[1], options.baseline),
        ),
        Estimator(
            "zobg_to_go",
            "zeroth order: costs to go times the scores of single steps",
            ("steps",),
            lambda batch, options: cost_to_go(batch, options.baseline),
        ),
        Estimator(
            "zobg_to_go_antithetic",
            "costs to go over pairs of opposite noise",
            ("step_pair",),
            lambda pair, options: antithetic_cost_to_go(pair[0], pair[1], options.baseline),
        ),
        Estimator(
            "fobg",
            "first order: gradients of the samples",
            ("differentiation",),
            lambda batch, options: first_order(batch),
        ),
        Estimator(
            "fobg_clipped",
            "first order, the norm of every sample bounded",
            ("differentiation",),
            lambda batch, options: clipped_first_order(batch, options.max_norm),
            ("max_norm",),
        ),
        Estimator(
            "fobg_truncated",
            "first order, the adjoint cut every few steps",
            ("linearisation",),
            lambda batch, options: truncated_first_order(batch, options.window),
            ("window",),
        ),
        Estimator(
            "aobg",
            "alpha order: the two interpolated within an error of gamma",
            ("evaluation", "differentiation"),
            _alpha_order,
        ),
        Estimator(
            "ivw",
            "inverse-variance weighting: alpha order with gamma infinite",
            ("evaluation", "differentiation"),
            lambda zeroth, first, options: _alpha_order(zeroth, first, options, unlimited=True),
        ),
        Estimator(
            "ivw_h",
            "inverse-variance weights for every step and control",
            ("steps", "step_differentiation"),
            lambda zeroth, first, options: stepwise_inverse_variance(zeroth, first, options.baseline, options.weights),
        ),
        Estimator(
            "total_propagation",
            "inverse-variance weights inside the backward recursion",
            ("linearisation",),
            lambda batch, options: total_propagation(batch, options.baseline, options.weights),
        ),
        Estimator(
            "ddcg",
            "inverse-variance weighting where a test finds no discontinuity, else zeroth order",
            ("evaluation", "step_differentiation"),
            lambda zeroth, first, options: discontinuity_gated(
                zeroth, first, options.baseline, options.sigma, options.tolerance, options.weights
            ),
            ("sigma",),
        ),
        Estimator(
            "delta",
            "first-order mean and a zeroth-order estimate of what it leaves over; noise on theta itself",
            ("evaluation", "differentiation"),
            _delta,
            ("sigma",),
        ),
    )
}


def combine(name: str, batches: Batches, options: EstimatorOptions) -> GradientEstimate:
    """Make an estimate of batches already drawn, so that several estimators can share them.

    Args:
        name: Key in `ESTIMATORS`.
        batches: By the names in `ORACLES`; those of order 0 independent of those of order 1 and of the same size. What
            the estimator does not need is not looked at.
        options: See `EstimatorOptions`.

    Returns:
        The estimate.

    Raises:
        ValueError: The name is unknown, a batch or an option that it needs is missing, or batches differ in shape.
    """
    estimator = _find(name)
    estimator.check(options)
    for oracle in estimator.needs:
        if batches.get(oracle) is None:
            method, phrase = ORACLES[oracle].method, ORACLES[oracle].phrase
            raise ValueError(f"{name!r} needs {phrase}; got none; pass what objective.{method} returns as {oracle!r}")
    return estimator.combine(*(batches[oracle] for oracle in estimator.needs), options)


def draw(
    oracles: tuple[str, ...],
    objective: Objective,
    theta: Float[Array, " params"],
    key: Key[Array, ""],
    num_samples: int,
) -> dict[str, Any]:
    """Draw batches, those of order 0 from one set of keys and those of order 1 from another.

    Args:
        oracles: Names in `ORACLES`; all of one order share their samples.
        objective: What to draw from.
        theta: Where, [param].
        key: Source of all randomness; used up.
        num_samples: Samples in each batch, >= 1.

    Returns:
        The batches by name.

    Raises:
        ValueError: The objective lacks what an oracle calls.
    """
    keys = [jax.random.split(order_key, num_samples) for order_key in jax.random.split(key)]
    batches = {}
    for name in oracles:
        oracle = ORACLES[name]
        method = getattr(objective, oracle.method, None)
        if method is None:
            raise ValueError(f"{type(objective).__name__} has no {oracle.method}, which {oracle.phrase} comes from")
        batches[name] = method(theta, jax.random.clone(keys[oracle.order]))  # shared on purpose
    return batches


def estimate(
    name: str,
    objective: Objective,
    theta: Float[Array, " params"],
    key: Key[Array, ""],
    num_samples: int,
    *,
    options: EstimatorOptions,
) -> GradientEstimate:
    """Draw the batches that an estimator needs, and no others, and estimate grad F(theta).

    The two orders come from independent keys, and each is the same for every estimator given the same key.

    Args:
        name: Key in `ESTIMATORS`.
        objective: What to differentiate.
        theta: Where, [param].
        key: Source of all randomness; used up.
        num_samples: Samples in each batch, >= 1.
        options: See `EstimatorOptions`.

    Returns:
        The estimate.

    Raises:
        ValueError: The name is unknown, an option or a method of the objective is missing, there is no sample to draw,
            or theta has the wrong length.
    """
    estimator = _find(name)
    estimator.check(options)
    if num_samples < 1:
        raise ValueError(f"num_samples must be at least 1, and at least 2 for a variance; got {num_samples}")
    if theta.shape != (objective.num_params,):
        raise ValueError(f"theta must have shape ({objective.num_params},), the objective's; got {theta.shape}")
    return combine(name, draw(estimator.needs, objective, theta, key, num_samples), options)


def _find(name: str) -> Estimator:
    if name not in ESTIMATORS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}; got {name!r}")
    return ESTIMATORS[name]
