"""Run all measurements of a diagnosis, in order; its errors as text."""

import dataclasses
import math
from collections.abc import Callable
from typing import Final

from mjx_study.choices import is_file
from mjx_study.diagnose.measurement import SAMPLES, Measured, Measurement, chunk_of, estimators_of, measure
from mjx_study.diagnose.setting import ContactSummary, RolloutSetting, events_of, lead_of, setting_of, touches_of
from mjx_study.experiment.memory import check_memory
from mjx_study.gradcheck import GradcheckPlan, GradcheckReport, gradcheck
from mjx_study.objective import Simulator
from mjx_study.progress import Progress, silent
from mjx_study.simulation.contact import has_mujoco_law
from mjx_study.table import with_error
from mjx_study.tasks.contact_grid import single_contact
from mjx_study.tasks.soundness import check_soundness
from mjx_study.tasks.task import Task

STATES: Final = 2  # number of states in the gradient check
PARTS: Final = ("rollout without noise", "derivatives of steps", "estimators")  # names of the parts in progress
ONE_DIGIT_UNCERTAINTY: Final = 0.5  # relative standard error beyond which an error is shown with one digit


@dataclasses.dataclass(frozen=True)
class Diagnosis(Measurement):
    """Everything measured; `page` formats it.

    Attributes:
        subject, theta: the model, and parameters other than the task's, as named by the user.
        contact, warnings: label of the contact model, and warnings about it.
        law, lead: name of its law, None if MuJoCo's, and the time before touch from which it acts [s].
        touches: contacts that begin in the zero-noise rollout.
        options: contact options as command-line flags.
    """

    subject: str
    theta: str
    task: Task
    setting: RolloutSetting
    contact: str
    law: str | None
    lead: float
    touches: tuple[ContactSummary, ...]
    derivatives: GradcheckReport
    warnings: tuple[str, ...]
    options: str

    @property
    def scale_error(self) -> float:
        return self.norm_error / self.norm if self.resolved else 0.0

    @property
    def unit(self) -> str:
        """What follows errors: they are shares of the gradient if it is distinguishable from 0."""
        return " %" if self.resolved else " in the gradient's unit"

    def shown(self, error: float) -> float:
        """An error [gradient] in `unit`."""
        return error / self.norm * 100 if self.resolved else error

    def error_text(self, error: float, uncertainty: float) -> str:
        """Format an error to two significant digits, or to one if its relative standard error is large."""
        digits = 1 if uncertainty > ONE_DIGIT_UNCERTAINTY else 2
        size = float(f"{self.shown(error):.{digits}g}")
        decimals = digits - 1 - math.floor(math.log10(size)) if 0 < size < math.inf else 0
        text = f"{size:.{max(decimals, 0)}f}" if -6 < decimals < 6 else f"{size:g}"
        return f"{text}{' %' if self.resolved else ''}"

    def off_text(self, estimator: Measured) -> str:
        """Format how far a mean is off, with its standard error, which includes that of the gradient's norm."""
        error = math.hypot(estimator.off_error, estimator.off * self.scale_error)
        return f"{with_error(self.shown(estimator.off), self.shown(error))}{self.unit}"


def round_up(number: float) -> str:
    """Round up to two significant digits, with thousands separators."""
    digits = max(0, math.floor(math.log10(max(number, 1.0))) - 1)
    return f"{math.ceil(number / 10**digits) * 10**digits:,}"


def one_digit(number: float, rounded: Callable[[float], int] = math.floor) -> str:
    """Round to one significant digit, by default down."""
    unit = 10.0 ** math.floor(math.log10(number))
    return f"{rounded(round(number / unit, 9)) * unit:.1g}"


def enough(found: Measurement, factor: float) -> str:
    """So many times the samples drawn, as an option, and how long they take here."""
    samples = round_up(factor * found.samples)
    seconds = factor * found.seconds
    time = f"{seconds / 60:,.0f} minutes" if seconds > 120 else f"{max(seconds, 1):.0f} s"
    return f"--samples {samples.replace(',', '')} ({time} here)"


def plan_diagnosis(
    subject: str,
    task: Task,
    family: str | None = None,
    stiffness: float | None = None,
    *,
    damping: float | None = None,
    smoothing: float | None = None,
    samples: int | None = None,
    seed: int = 0,
) -> GradcheckPlan:
    """Plan the check of derivatives in one contact model, under which `diagnose_task` measures everything else, too.

    Args:
        subject: the model as named by the user; for a file, the gradient check covers single steps only.
        family, stiffness, damping, smoothing: of the contact [N/m, N s/m, J]; None for those of a single run.
        samples: as for `diagnose_task`.

    Raises:
        ValueError: the task cannot be simulated, there is no such contact model, or the batches do not fit in memory.
    """
    check_soundness(task)
    cell, warnings = single_contact(task, family, stiffness, damping, smoothing)
    check_memory(task, estimators_of(task, cell.contact), samples or SAMPLES)
    # no gradient over theta depends on contact parameters
    return GradcheckPlan(task, not is_file(subject), (cell,), warnings, STATES, seed, stock=False, parameters=False)


def diagnose_task(
    subject: str,
    plan: GradcheckPlan,
    *,
    samples: int | None = None,
    theta: str = "",
    options: str = "",
    progress: Progress = silent,
) -> Diagnosis:
    """Measure everything under one contact model.

    Args:
        subject: the model as named by the user.
        plan: what `plan_diagnosis` returns.
        samples: samples per batch, and per node of the paths along which means are checked, at least 2; None for
            `SAMPLES`, or fewer or more as in `measure`.
        theta: name of the task's theta if it is not its own.
        options: contact options as command-line flags.
    """
    task, (cell,), seed = plan.subject, plan.cells, plan.seed
    progress(0, 4, PARTS[0])
    touches = tuple(touches_of(task, cell))

    def part(at: int) -> Progress:
        return lambda done, total, what: progress(at, 4, f"{PARTS[at]}: {what}") if what != "done" else None

    derivatives = gradcheck(plan, part(1))
    simulator = Simulator(task, chunk_size=chunk_of(task, samples or SAMPLES))
    found = measure(simulator, cell.contact, samples, seed, part(2))
    if not has_mujoco_law(cell.contact):
        found = dataclasses.replace(found, onsets=events_of(task, cell, found.samples, seed))
    progress(4, 4, "done")
    return Diagnosis(
        **vars(found),
        subject=subject,
        theta=theta,
        task=task,
        setting=setting_of(subject, task),
        contact=cell.label,
        law=None if has_mujoco_law(cell.contact) else cell.family,
        lead=lead_of(task, cell),
        touches=touches,
        derivatives=derivatives,
        warnings=plan.warnings,
        options=options,
    )
