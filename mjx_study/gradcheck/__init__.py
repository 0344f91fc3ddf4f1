"""Are the derivatives right? Automatic differentiation against differences, the C engine and a closed form.

A mismatch is not yet a wrong derivative: where a step has a kink or a jump there is none, where the solver has not
converged the derivative is that of another point, and where MJX places a contact elsewhere the C engine has another.
The check tells these apart, entry by entry of a step's Jacobian.
"""

from mjx_study.gradcheck.check import gradcheck
from mjx_study.gradcheck.finding import Finding
from mjx_study.gradcheck.plan import CONTACT, STIFFNESS, GradcheckPlan, plan_gradcheck, plan_scene_gradcheck
from mjx_study.gradcheck.report import GradcheckReport, StepCheck

__all__ = [
    "CONTACT",
    "STIFFNESS",
    "Finding",
    "GradcheckPlan",
    "GradcheckReport",
    "StepCheck",
    "gradcheck",
    "plan_gradcheck",
    "plan_scene_gradcheck",
]
