"""Monte-Carlo gradients of F(theta) = E f(theta, w): zeroth order, first order, and in between.

Pure mathematics on JAX arrays; anything that implements `Objective` can be estimated.

Reference: Suh, Simchowitz, Zhang, Tedrake, "Do Differentiable Simulators Give Better Policy Gradients?", ICML
2022.
"""

from estimators.alpha_order import alpha_order, constrained_alpha, interpolate, inverse_variance_alpha
from estimators.baselines import BASELINES, leave_one_out, none, zero_noise
from estimators.confidence import bernstein_epsilon
from estimators.first_order import first_order
from estimators.registry import ESTIMATORS, Estimator, EstimatorOptions, combine, estimate
from estimators.statistics import Comparison, compare, norm_quantiles, summarise, variance_interval
from estimators.types import AlphaChoice, Differentiation, Evaluation, GradientEstimate, Objective
from estimators.zeroth_order import delta_control_variate, zeroth_order

__all__ = [
    "BASELINES",
    "ESTIMATORS",
    "AlphaChoice",
    "Comparison",
    "Differentiation",
    "Estimator",
    "EstimatorOptions",
    "Evaluation",
    "GradientEstimate",
    "Objective",
    "alpha_order",
    "bernstein_epsilon",
    "combine",
    "compare",
    "constrained_alpha",
    "delta_control_variate",
    "estimate",
    "first_order",
    "interpolate",
    "inverse_variance_alpha",
    "leave_one_out",
    "none",
    "norm_quantiles",
    "summarise",
    "variance_interval",
    "zero_noise",
    "zeroth_order",
]
