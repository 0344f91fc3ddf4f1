"""Public names of `estimators`, imported when one of them is first accessed."""

from estimators.batches import (
    AlphaChoice,
    Differentiation,
    Evaluation,
    GradientEstimate,
    Linearisation,
    Objective,
    StepDifferentiation,
    StepEvaluation,
    pull_back,
)
from estimators.builtin import (
    AlphaOrder,
    Antithetic,
    AntitheticCostToGo,
    ClippedFirstOrder,
    CostToGo,
    DeltaMethod,
    DiscontinuityGated,
    FirstOrder,
    InverseVariance,
    StepwiseInverseVariance,
    TotalPropagation,
    TruncatedFirstOrder,
    ZerothOrder,
)
from estimators.choices import ORACLES, VARIANCE_PROXIES, WEIGHTS, Oracle
from estimators.comparison import (
    BiasTest,
    Comparison,
    EmpiricalBias,
    bias_test,
    compare,
    empirical_bias,
    squared_bias_of_means,
)
from estimators.confidence import (
    ENOUGH_EFFECTIVE,
    EffectiveSamples,
    bernstein_epsilon,
    coverage_interval,
    effective_samples,
    variance_interval,
    variance_upper_bound,
)
from estimators.estimator import ESTIMATORS, Batches, Estimator, option, register
from estimators.interpolation import alpha_order, constrained_alpha, interpolate, inverse_variance_alpha, weigh_batches
from estimators.mean_check import Circulation, circulations
from estimators.noise import NOISES, NoiseDensity
from estimators.recursion import total_propagation, truncated_first_order
from estimators.registry import find_estimator, make_estimator, oracles_of
from estimators.samples import Rows
from estimators.sampling import draw, estimate
from estimators.statistics import norm_quantiles, summarise
from estimators.stepwise import cost_to_go, discontinuity_gated, stepwise_inverse_variance
from estimators.zeroth_first import (
    BASELINES,
    clipped_first_order,
    delta_control_variate,
    first_order,
    leave_one_out,
    none,
    zero_noise,
    zeroth_order,
)

__all__ = [
    "BASELINES", "ENOUGH_EFFECTIVE", "ESTIMATORS", "NOISES", "ORACLES", "VARIANCE_PROXIES", "WEIGHTS", "AlphaChoice",
    "AlphaOrder", "Antithetic", "AntitheticCostToGo", "Batches", "BiasTest", "Circulation", "ClippedFirstOrder",
    "Comparison", "CostToGo", "DeltaMethod", "Differentiation", "DiscontinuityGated", "EffectiveSamples",
    "EmpiricalBias", "Estimator", "Evaluation", "FirstOrder", "GradientEstimate", "InverseVariance", "Linearisation",
    "NoiseDensity", "Objective", "Oracle", "Rows", "StepDifferentiation", "StepEvaluation", "StepwiseInverseVariance",
    "TotalPropagation", "TruncatedFirstOrder", "ZerothOrder", "alpha_order", "bernstein_epsilon",
    "bias_test", "circulations", "clipped_first_order", "compare", "constrained_alpha", "cost_to_go",
    "coverage_interval", "delta_control_variate", "discontinuity_gated", "draw", "effective_samples", "empirical_bias",
    "estimate", "find_estimator", "first_order", "interpolate", "inverse_variance_alpha", "leave_one_out",
    "make_estimator", "none", "norm_quantiles", "option", "oracles_of", "pull_back", "register",
    "squared_bias_of_means", "stepwise_inverse_variance", "summarise", "total_propagation", "truncated_first_order",
    "variance_interval", "variance_upper_bound", "weigh_batches", "zero_noise", "zeroth_order",
]  # fmt: skip
