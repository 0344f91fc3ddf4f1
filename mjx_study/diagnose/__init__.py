"""One-page diagnosis of a model: where contact begins, whether derivatives and means are right, which estimator to use.

Every statement is measured and comes with the command that reproduces it.
"""

from mjx_study.diagnose.measurement import ESTIMATORS, Measured, Measurement, measure
from mjx_study.diagnose.page import SMOOTH_SHARE, WIDTH_RATIO, Diagnosis
from mjx_study.diagnose.run import diagnose_task
from mjx_study.diagnose.setting import ContactSummary, touch_of

__all__ = [
    "ESTIMATORS",
    "SMOOTH_SHARE",
    "WIDTH_RATIO",
    "Diagnosis",
    "Measured",
    "Measurement",
    "ContactSummary",
    "diagnose_task",
    "measure",
    "touch_of",
]
