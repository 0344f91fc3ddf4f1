"""The estimators by name, and one way to run any of them."""

from dataclasses import dataclass
from typing import cast

import jax
from jaxtyping import Array, Float, Key

from estimators.alpha_order import alpha_order
from estimators.baselines import BASELINES
from estimators.confidence import bernstein_epsilon, check_confidence_arguments
from estimators.first_order import first_order
from estimators.types import Differentiation, Evaluation, GradientEstimate, Objective
from estimators.zeroth_order import zeroth_order


@dataclass(frozen=True)
class Estimator:
    """An estimator's name and needs.

    Attributes:
        name: Key in `ESTIMATORS`.
        description: One line for a legend or a help text.
        order_of_oracle: Which batches it needs: 0 for evaluations, 1 for differentiations.
    """

    name: str
    description: str
    order_of_oracle: tuple[int, ...]


ESTIMATORS: dict[str, Estimator] = {
    estimator.name: estimator
    for estimator in (
        Estimator("zobg", "zeroth order: values times scores", (0,)),
        Estimator("fobg", "first order: gradients of the samples", (1,)),
        Estimator("aobg", "alpha order: the two interpolated within an error of gamma", (0, 1)),
        Estimator("ivw", "inverse-variance weighting: alpha order with gamma infinite", (0, 1)),
    )
}


@dataclass(frozen=True, kw_only=True)
class EstimatorOptions:
    """What an estimate depends on beside its samples; hashable, so that it can be static under `jit`.

    Attributes:
        baseline: Name in `BASELINES`, for the zeroth-order batch.
        gamma: Largest error to accept, > 0 or infinity, [cost/param]; "aobg" only.
        failure_probability: Of the confidence radius, in (0, 1).
        variance_proxy: "variance" or "second_moment"; see `bernstein_epsilon`.
        radius: "max_deviation" or a bound >= 0 on ||g_i - E g||, [cost/param].

    Raises:
        ValueError: A field is outside its range.
    """

    baseline: str = "zero_noise"
    gamma: float
    failure_probability: float
    variance_proxy: str
    radius: str | float

    def __post_init__(self):
        if self.baseline not in BASELINES:
            raise ValueError(f"baseline must be one of {', '.join(BASELINES)}; got {self.baseline!r}")
        if not self.gamma > 0.0:
            raise ValueError(f"gamma must be positive; got {self.gamma}; float('inf') sets no limit")
        check_confidence_arguments(self.failure_probability, self.variance_proxy, self.radius)


def combine(
    name: str,
    zeroth: Evaluation | None,
    first: Differentiation | None,
    options: EstimatorOptions,
) -> GradientEstimate:
    """Make an estimate of batches already drawn, so that several estimators can share them.

    Args:
        name: Key in `ESTIMATORS`.
        zeroth: Batch of evaluations; not looked at by "fobg".
        first: Batch of differentiations, independent of `zeroth` and of the same size; not looked at by
            "zobg".
        options: See `EstimatorOptions`.

    Returns:
        The estimate.

    Raises:
        ValueError: The name is unknown, a batch that it needs is missing, or the batches differ in shape.
    """
    needed = _find(name).order_of_oracle
    from_values = from_gradients = None
    if 0 in needed:
        if zeroth is None:
            raise ValueError(f"{name!r} needs a zeroth-order batch; got None; pass what objective.evaluate returns")
        from_values = zeroth_order(zeroth, options.baseline)
    if 1 in needed:
        if first is None:
            raise ValueError(f"{name!r} needs a first-order batch; got None; pass what objective.differentiate returns")
        from_gradients = first_order(first)
    if from_values is None or from_gradients is None:
        return cast(GradientEstimate, from_values or from_gradients)
    epsilon = bernstein_epsilon(
        from_values,
        failure_probability=options.failure_probability,
        variance_proxy=options.variance_proxy,
        radius=options.radius,
    )
    gamma = float("inf") if name == "ivw" else options.gamma
    return alpha_order(from_values, from_gradients, gamma=gamma, epsilon=epsilon)


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

    The two batches come from independent keys, and each is the same for every estimator given the same key.

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
        ValueError: The name is unknown, there is no sample to draw, or theta has the wrong length.
    """
    needed = _find(name).order_of_oracle
    if num_samples < 1:
        raise ValueError(f"num_samples must be at least 1, and at least 2 for a variance; got {num_samples}")
    if theta.shape != (objective.num_params,):
        raise ValueError(f"theta must have shape ({objective.num_params},), the objective's; got {theta.shape}")
    keys = [jax.random.split(batch_key, num_samples) for batch_key in jax.random.split(key)]
    zeroth = objective.evaluate(theta, keys[0]) if 0 in needed else None
    first = objective.differentiate(theta, keys[1]) if 1 in needed else None
    return combine(name, zeroth, first, options)


def _find(name: str) -> Estimator:
    if name not in ESTIMATORS:
        raise ValueError(f"estimator must be one of {', '.join(ESTIMATORS)}; got {name!r}")
    return ESTIMATORS[name]
