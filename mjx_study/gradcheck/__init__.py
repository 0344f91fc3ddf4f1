"""Check derivatives: automatic differentiation against finite differences, the C engine and a closed form.

A mismatch need not be a wrong derivative: a step has none at a kink or jump, an unconverged solver differentiates at
another point, and where MJX places a contact elsewhere, the C engine has a different derivative. The check
distinguishes these cases for every entry of a step's Jacobian.
"""

from mjx_study.choices import CHECKED_STIFFNESS as STIFFNESS
from mjx_study.gradcheck.check import CONTACT, GradcheckPlan, gradcheck, plan_gradcheck, plan_scene_gradcheck
from mjx_study.gradcheck.report import Finding, GradcheckReport, StepCheck

__all__ = [
    "CONTACT", "STIFFNESS", "Finding", "GradcheckPlan", "GradcheckReport", "StepCheck", "gradcheck",
    "plan_gradcheck", "plan_scene_gradcheck",
]  # fmt: skip
