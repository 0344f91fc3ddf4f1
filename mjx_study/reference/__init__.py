"""The analytic systems: NumPy, float64, hand-derived Jacobians; the yardstick for MJX's gradients."""

from mjx_study.reference.adjoint import Rollout, roll_out, value_and_gradient
from mjx_study.reference.objective import ReferenceObjective
from mjx_study.reference.pusher import Pusher
from mjx_study.reference.system import System

__all__ = ["Pusher", "ReferenceObjective", "Rollout", "System", "roll_out", "value_and_gradient"]
