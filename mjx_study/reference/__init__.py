"""Analytic systems in NumPy and float64 with hand-written Jacobians, the ground truth for MJX's gradients."""

from mjx_study.reference.adjoint import Gradients, Rollout, roll_out, value_and_gradient, value_and_gradients
from mjx_study.reference.ball_wall import BallWall
from mjx_study.reference.double_pendulum import DoublePendulum
from mjx_study.reference.function import ClosedForm, Function, Jump, ScalarFunction, Smoothed, smoothed
from mjx_study.reference.heaviside import Heaviside, RelaxedHeaviside
from mjx_study.reference.linear_quadratic import LinearQuadratic
from mjx_study.reference.momentum_transfer import MomentumTransfer
from mjx_study.reference.objective import PARAMETRISATIONS, FunctionObjective, Reference, ReferenceObjective
from mjx_study.reference.pusher import Pusher
from mjx_study.reference.quadratic import Quadratic
from mjx_study.reference.quadratic_cost import QuadraticCost
from mjx_study.reference.sliding_box import SlidingBox
from mjx_study.reference.system import System
from mjx_study.reference.tennis import Tennis, tennis_metrics
from mjx_study.reference.tennis_start import draw_start

__all__ = [
    "PARAMETRISATIONS",
    "BallWall",
    "ClosedForm",
    "DoublePendulum",
    "Function",
    "FunctionObjective",
    "Gradients",
    "Heaviside",
    "Jump",
    "LinearQuadratic",
    "MomentumTransfer",
    "Pusher",
    "Quadratic",
    "QuadraticCost",
    "Reference",
    "ReferenceObjective",
    "RelaxedHeaviside",
    "Rollout",
    "ScalarFunction",
    "SlidingBox",
    "Smoothed",
    "System",
    "Tennis",
    "draw_start",
    "roll_out",
    "smoothed",
    "tennis_metrics",
    "value_and_gradient",
    "value_and_gradients",
]
