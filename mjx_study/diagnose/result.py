"""Everything that a diagnosis measures, and its errors as text."""

import dataclasses
import math
from typing import Final

from mjx_study.diagnose.measurement import Measured, Measurement
from mjx_study.diagnose.setting import ContactSummary, RolloutSetting
from mjx_study.gradcheck import GradcheckReport
from mjx_study.tasks.task import Task

ONE_DIGIT_UNCERTAINTY: Final = 0.5
"""Relative standard error beyond which an error is shown with one digit."""


@dataclasses.dataclass(frozen=True)
class Diagnosis(Measurement):
    """Everything measured; `page` formats it.

    Attributes:
        subject: the model as named by the user.
        setting: noise and rollout; the page holds only for these.
        contact, warnings: label of the contact model, and warnings about it.
        touches: contacts that begin in the zero-noise rollout.
        options: contact options as command-line flags.
    """

    subject: str
    task: Task
    setting: RolloutSetting
    contact: str
    touches: tuple[ContactSummary, ...]
    derivatives: GradcheckReport
    warnings: tuple[str, ...]
    options: str

    @property
    def failure(self) -> str:
        """Verdict on the worst of the wrong derivatives."""
        return next((finding.verdict for finding in self.derivatives.findings if finding.fails), "wrong")

    @property
    def scale(self) -> float:
        """Norm that errors are relative to: the gradient's if it is distinguishable from 0, else 1."""
        return self.norm if self.resolved else 1.0

    @property
    def scale_error(self) -> float:
        """Relative standard error of the scale."""
        return self.norm_error / self.norm if self.resolved else 0.0

    def error_text(self, error: float, uncertainty: float) -> str:
        """Format an error to two significant digits, or to one if its relative standard error is large."""
        digits = 1 if uncertainty > ONE_DIGIT_UNCERTAINTY else 2
        size = float(f"{error * (100 if self.resolved else 1):.{digits}g}")
        decimals = digits - 1 - math.floor(math.log10(size)) if size > 0 else 0
        text = f"{size:.{max(decimals, 0)}f}" if -6 < decimals < 6 else f"{size:g}"
        return f"{text}{' %' if self.resolved else ''}"

    def bias_text(self, estimator: Measured) -> str:
        return self.error_text(estimator.bias / self.scale, math.hypot(estimator.bias_error, self.scale_error))


def round_up(number: float) -> str:
    """Round up to two significant digits, with thousands separators."""
    digits = max(0, math.floor(math.log10(max(number, 1.0))) - 1)
    return f"{math.ceil(number / 10**digits) * 10**digits:,}"
