"""Analytic systems in NumPy and float64 with hand-written Jacobians, the ground truth for MJX's gradients."""

from mjx_study.reference.double_pendulum import DoublePendulum
from mjx_study.reference.function import (
    ClosedForm,
    Function,
    Heaviside,
    Jump,
    RelaxedHeaviside,
    ScalarFunction,
    Smoothed,
    smoothed,
)
from mjx_study.reference.objective import PARAMETRISATIONS, FinalCost, ReferenceObjective, function_objective
from mjx_study.reference.projectiles import BallWall, MomentumTransfer
from mjx_study.reference.system import Gradients, QuadraticCost, Rollout, System, roll_out, value_and_gradients
from mjx_study.reference.tennis import Tennis, draw_start, tennis_metrics
from mjx_study.reference.two_bodies import Pusher, SlidingBox

__all__ = [
    "PARAMETRISATIONS", "BallWall", "ClosedForm", "DoublePendulum", "FinalCost", "Function", "Gradients", "Heaviside",
    "Jump", "MomentumTransfer", "Pusher", "QuadraticCost", "ReferenceObjective", "RelaxedHeaviside", "Rollout",
    "ScalarFunction", "SlidingBox", "Smoothed", "System", "Tennis", "draw_start", "function_objective", "roll_out",
    "smoothed", "tennis_metrics", "value_and_gradients",
]  # fmt: skip
