"""One page about a model: where contact begins, whether derivatives and means are right, and which estimator to take.

Every statement is measured here and comes with the command that measures it again.
"""

from mjx_study.diagnose.measurement import ESTIMATORS, Measured, Measurement, measure
from mjx_study.diagnose.page import SMOOTH, WIDTHS, Diagnosis
from mjx_study.diagnose.run import diagnose
from mjx_study.diagnose.touch import Touch, touch_of

__all__ = [
    "ESTIMATORS",
    "SMOOTH",
    "WIDTHS",
    "Diagnosis",
    "Measured",
    "Measurement",
    "Touch",
    "diagnose",
    "measure",
    "touch_of",
]
