"""The built-in estimators, each a formula with its options."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import jax.numpy as jnp

from estimators.batches import AlphaChoice, Differentiation, Evaluation, GradientEstimate, StepEvaluation
from estimators.choices import CATALOGUE, MAX_DEVIATION, PLUG_IN, PUBLISHED_TOLERANCE
from estimators.confidence import bernstein_epsilon, check_confidence_arguments
from estimators.interpolation import apply_choice, check_weights, choose_alpha, inverse_variance_alpha, weigh_batches
from estimators.registry import Estimator, register
from estimators.stepwise import (
    antithetic_cost_to_go,
    check_tolerance,
    check_window,
    cost_to_go,
    discontinuity_gated,
    stepwise_inverse_variance,
    total_propagation,
    truncated_first_order,
)
from estimators.zeroth_first import (
    antithetic,
    clipped_first_order,
    delta_control_variate,
    find_baseline,
    first_order,
    zeroth_order,
)


def _check_positive(name: str, value: float) -> None:
    if not 0.0 < value < float("inf"):
        raise ValueError(f"{name} must be positive and finite; got {value}")


@dataclass(frozen=True, kw_only=True)
class _Formula(Estimator):
    """Base of estimators that apply `formula` to their batches, with their options as keywords."""

    formula: ClassVar[Callable[..., GradientEstimate]]

    def combine(self, *args: Any, **kwargs: Any) -> GradientEstimate:
        options = {field.name: getattr(self, field.name) for field in fields(self)}
        return type(self).formula(*args, **kwargs, **options)


@dataclass(frozen=True, kw_only=True)
class _Baselined(_Formula):
    """Base of estimators with a zeroth-order batch; `baseline` is a name in `BASELINES`."""

    baseline: str = "zero_noise"

    def __post_init__(self) -> None:
        find_baseline(self.baseline)


@dataclass(frozen=True, kw_only=True)
class _Interpolation(_Baselined):
    """Base of estimators that weight two batches; `weights` is a name in `WEIGHTS`."""

    weights: str = PLUG_IN

    def __post_init__(self) -> None:
        super().__post_init__()
        check_weights(self.weights)


@register
class ZerothOrder(_Baselined, entry=CATALOGUE["zobg"]):
    """See `estimators.zeroth_order`."""

    separable = True
    formula = staticmethod(zeroth_order)


@register
class Antithetic(_Baselined, entry=CATALOGUE["zobg_antithetic"]):
    """See `estimators.antithetic`."""

    separable = True

    @staticmethod
    def formula(pair: tuple[Evaluation, Evaluation], baseline: str) -> GradientEstimate:
        return antithetic(*pair, baseline)


@register
class CostToGo(_Baselined, entry=CATALOGUE["zobg_to_go"]):
    """See `estimators.cost_to_go`."""

    separable = True
    formula = staticmethod(cost_to_go)


@register
class AntitheticCostToGo(_Baselined, entry=CATALOGUE["zobg_to_go_antithetic"]):
    """See `estimators.antithetic_cost_to_go`."""

    separable = True

    @staticmethod
    def formula(pair: tuple[StepEvaluation, StepEvaluation], baseline: str) -> GradientEstimate:
        return antithetic_cost_to_go(*pair, baseline)


@register
class FirstOrder(_Formula, entry=CATALOGUE["fobg"]):
    """See `estimators.first_order`."""

    separable = True
    formula = staticmethod(first_order)


@register
class OnsetFirstOrder(FirstOrder, entry=CATALOGUE["fobg_onset"]):
    """See `estimators.first_order`; the batch is corrected where contact begins and ends."""


@register
@dataclass(frozen=True, kw_only=True)
class ClippedFirstOrder(_Formula, entry=CATALOGUE["fobg_clipped"]):
    """See `estimators.clipped_first_order`.

    `max_norm` is the largest norm of a sample, > 0, [cost/param].
    """

    separable = True
    formula = staticmethod(clipped_first_order)

    max_norm: float

    def __post_init__(self) -> None:
        _check_positive("max_norm", self.max_norm)


@register
@dataclass(frozen=True, kw_only=True)
class TruncatedFirstOrder(_Formula, entry=CATALOGUE["fobg_truncated"]):
    """See `estimators.truncated_first_order`.

    `window` is the number of steps between cuts of the adjoint, >= 1.
    """

    separable = True
    formula = staticmethod(truncated_first_order)

    window: int

    def __post_init__(self) -> None:
        check_window(self.window)


class _OneWeight(_Interpolation):
    """Base of estimators with a single weight for two batches."""

    separable = True

    @abstractmethod
    def choose(self, zeroth: GradientEstimate, first: GradientEstimate) -> AlphaChoice:
        """Choose the weight."""

    def combine(self, evaluation: Evaluation, differentiation: Differentiation) -> GradientEstimate:
        def choose(*batches: Any) -> AlphaChoice:
            return self.choose(*self.parts(*batches))

        def mix(choice: AlphaChoice, *batches: Any) -> GradientEstimate:
            return apply_choice(choice, *self.parts(*batches))

        return weigh_batches(choose, mix, (evaluation, differentiation), self.weights)

    def parts(
        self, evaluation: Evaluation, differentiation: Differentiation
    ) -> tuple[GradientEstimate, GradientEstimate]:
        return zeroth_order(evaluation, self.baseline), first_order(differentiation)

    def join(self, zeroth: GradientEstimate, first: GradientEstimate) -> GradientEstimate:
        return apply_choice(self.choose(zeroth, first), zeroth, first)


@register
@dataclass(frozen=True, kw_only=True)
class AlphaOrder(_OneWeight, entry=CATALOGUE["aobg"]):
    """See `estimators.constrained_alpha`.

    Attributes:
        baseline: A name in `BASELINES`, for the zeroth-order batch.
        weights: A name in `WEIGHTS`, the source of alpha.
        gamma: Largest acceptable error, > 0 or infinity, [cost/param].
        failure_probability: Failure probability of the confidence radius, in (0, 1); see `bernstein_epsilon`.
        variance_proxy: "variance", "second_moment" or "upper_bound".
        radius: "max_deviation" or a bound >= 0 on ||g_i - E g||, [cost/param].
    """

    gamma: float = float("inf")
    failure_probability: float = 0.05
    variance_proxy: str = "variance"
    radius: str | float = MAX_DEVIATION

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.gamma > 0.0:
            raise ValueError(f"gamma must be positive; got {self.gamma}; float('inf') sets no limit")
        check_confidence_arguments(self.failure_probability, self.variance_proxy, self.radius)

    def choose(self, zeroth: GradientEstimate, first: GradientEstimate) -> AlphaChoice:
        epsilon = bernstein_epsilon(
            zeroth, failure_probability=self.failure_probability, variance_proxy=self.variance_proxy, radius=self.radius
        )
        return choose_alpha(zeroth, first, gamma=self.gamma, epsilon=epsilon)


@register
class OnsetAlphaOrder(AlphaOrder, entry=CATALOGUE["aobg_onset"]):
    """See `estimators.alpha_order`; the first-order batch is corrected where contact begins and ends."""


@register
class InverseVariance(_OneWeight, entry=CATALOGUE["ivw"]):
    """See `estimators.inverse_variance_alpha`."""

    def choose(self, zeroth: GradientEstimate, first: GradientEstimate) -> AlphaChoice:
        alpha = inverse_variance_alpha(zeroth.variance, first.variance)
        discrepancy = jnp.linalg.norm(first.mean - zeroth.mean)
        return AlphaChoice(alpha, None, discrepancy, zeroth.variance, first.variance)


@register
class StepwiseInverseVariance(_Interpolation, entry=CATALOGUE["ivw_h"]):
    """See `estimators.stepwise_inverse_variance`."""

    formula = staticmethod(stepwise_inverse_variance)


@register
class TotalPropagation(_Interpolation, entry=CATALOGUE["total_propagation"]):
    """See `estimators.total_propagation`."""

    formula = staticmethod(total_propagation)


@register
@dataclass(frozen=True, kw_only=True)
class DiscontinuityGated(_Interpolation, entry=CATALOGUE["ddcg"]):
    """See `estimators.discontinuity_gated`.

    `sigma` is the noise's standard deviation, > 0, [control]; `tolerance` is c of the test, in [0, 1).
    """

    gaussian = True
    formula = staticmethod(discontinuity_gated)

    sigma: float
    tolerance: float = PUBLISHED_TOLERANCE

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_positive("sigma", self.sigma)
        check_tolerance(self.tolerance)


@register
@dataclass(frozen=True, kw_only=True)
class DeltaMethod(_Formula, entry=CATALOGUE["delta"]):
    """See `estimators.delta_control_variate`.

    `sigma` is the noise's standard deviation, > 0, [param].
    """

    gaussian = additive = True

    sigma: float

    def __post_init__(self) -> None:
        _check_positive("sigma", self.sigma)

    @staticmethod
    def formula(evaluation: Evaluation, differentiation: Differentiation, sigma: float) -> GradientEstimate:
        return delta_control_variate(evaluation, first_order(differentiation).mean, sigma)
