"""The page of a diagnosis, with advice."""

import dataclasses
import math
import re
import shlex
import textwrap
from collections.abc import Iterator
from typing import Any, Final

from mjx_study.diagnose.means import ALONG_MEANS
from mjx_study.diagnose.measurement import RESOLVED_SE, SAMPLES, TARGET_ERROR, Measured, Measurement
from mjx_study.diagnose.setting import ContactSummary, RolloutSetting
from mjx_study.gradcheck import GradcheckReport
from mjx_study.gradcheck.diagnosis import MEANING
from mjx_study.results.findings import ERROR_PER_STRENGTH, LEAST_SPREAD, MOST_STRENGTH, NOTABLE_SHARE, linear_error
from mjx_study.results.variables import DIAGNOSIS
from mjx_study.runtime import environment
from mjx_study.table import as_plain, format_table, percent, with_error
from mjx_study.tasks.task import Task

OF_CONTACT: Final = ("time", "speed", "damping", "stiffness", "travel", "impedance", "stable")
OF_ESTIMATOR: Final = ("error", "interval", "mean", "seconds")
"""Columns of the two tables, in `DIAGNOSIS`."""
MIN_SAMPLES: Final = 100
"""Number of samples below which the page warns."""
SMOOTH_SHARE: Final = 0.01
"""Share of the approach speed lost in the first step below which force counts as setting in without a jump."""
WIDTH_RATIO: Final = 3.0
"""Recommended width of the impedance's rise, as a multiple of a step's travel."""
LEGEND: Final = (
    "  zobg: zeroth order; fobg: first order; aobg: both, weighted; _onset: with a term for contact that begins or ends"
)
ONE_DIGIT_UNCERTAINTY: Final = 0.5
"""Relative standard error beyond which an error is shown with one digit."""
MAX_ERROR: Final = 100.0
"""Upper end beyond which the interval of a relative error is uninformative."""
MAX_SHOWN: Final = 6
"""Number of contacts listed in the text, least resolved first."""


@dataclasses.dataclass(frozen=True)
class Diagnosis(Measurement):
    """Everything measured; `lines` formats the page.

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

    def as_json(self) -> dict[str, Any]:
        norm = self.norm if self.resolved else math.nan
        document = {
            "subject": self.subject,
            "cost": self.task.description,
            "contact": self.contact,
            "samples": self.samples,
            **dataclasses.asdict(self.setting),
            "touches": [dataclasses.asdict(each) for each in self.touches],
            **self.onsets,
            "nonfinite": self.lost,
            "unconverged": self.unconverged,
            "derivatives": "right" if self.derivatives.passed else self._failure,
            "unexercised": self.derivatives.unexercised,
            "estimators": [
                {
                    "estimator": each.estimator,
                    "variance": each.variance,
                    "seconds_per_sample": each.seconds,
                    "mean": each.verdict,
                    "bias": each.bias / norm,
                    "error_after_a_second": each.error(1.0) / norm,
                }
                for each in self.estimators
            ],
            "best": self.best.estimator if self.resolved else None,
            "gradient_norm": self.norm,
            "gradient_norm_error": self.norm_error,
            "resolved": self.resolved,
            "samples_needed": self.samples_needed if self.resolved else None,
            "warnings": [*self.warnings, *self._cautions()],
            "advice": [text for text, _ in self._advice()],
            "environment": environment(),
        }
        return as_plain(document)

    def lines(self) -> list[str]:
        task, command = self.task, f"mjx-study {{}} {shlex.quote(self.subject)}{self.options}"
        lines = [f"{self.subject}: {task.description or task.name}", f"contact {self.contact}, {self.samples} samples"]
        lines += [self.setting.line(), *([] if self.resolved else [self._unresolved()])]
        lines += [f"warning: {text}" for text in (*self.warnings, *self._cautions())]
        lines += ["", "contact", *self._contact_lines()]
        if self.onsets.get("onsets"):
            lines += [f"  > {command.format('compare')} --estimators fobg_onset --samples {self.samples} --json"]
        if self.derivatives.passed:
            parts = dict.fromkeys(part for parts in self.derivatives.unexercised.values() for part in parts)
            missing = f"; not exercised: {', '.join(parts)}" if parts else ""
            state = f"every derivative that exists is right{missing}"
        else:
            state = f"NOT RIGHT: {MEANING[self._failure]}"
        steps = re.sub(r" --sigma \S+", "", command.format("gradcheck"))  # steps have no noise
        lines += ["", "derivatives of a step", f"  {state}", f"  > {steps}"]
        batch = f"--estimators {','.join(each.estimator for each in self.estimators)} --samples {self.samples}"
        error = "relative error" if self.resolved else "error, in the gradient's unit,"
        lines += ["", f"estimators, by their {error} after a second of computing", *self._estimator_lines()]
        lines += [f"  > {command.format('gradcheck')} --mean --direction {ALONG_MEANS} {batch}"]
        lines += [f"  > {command.format('compare')} {batch}"]
        lines += ["", "advice"]
        for text, flags in self._advice():
            lines += textwrap.wrap(text, 100, initial_indent="  ", subsequent_indent="    ")
            lines += [f"  > {command.format('compare')} {flags}"] if flags else []
        return lines

    def _contact_lines(self) -> list[str]:
        found = self.onsets.get("onsets", 0)
        lines = [f"  contacts that begin in a rollout with noise: {found / self.samples:.2g}"]
        if found:
            lines += [
                f"  step at which the first begins: standard deviation {self.onsets['onset_spread']:.2g}",
                f"  approach speed that a contact takes in its first step: {percent(self.onsets['onset_strength'])}",
            ]
        if not self.touches:
            return [*lines, "  contacts that begin in the rollout without noise: 0"]
        worst = sorted(self.touches, key=lambda each: (each.stable, -each.jump, -each.travel))
        header = ["  without noise", *(DIAGNOSIS[name].heading for name in OF_CONTACT)]
        rows = [
            [
                f"  {each.pair}",
                f"{each.time:.3g}",
                *(f"{number:.2g}" for number in (each.speed, each.damping, each.stiffness, each.travel)),
                f"{each.impedance:g}",
                "stable" if each.stable else "UNSTABLE",
            ]
            for each in worst[:MAX_SHOWN]
        ]
        more = len(worst) - len(rows)
        return [*lines, *format_table(rows, header), *([f"  and {more} more"] if more else [])]

    def _estimator_lines(self) -> list[str]:
        rows = []
        for each in self.estimators:
            error, low, high = (each.error(self._scale, end) for end in (None, each.lower, each.upper))
            unsure = math.hypot((high - low) / 4 / error, self._unsure) if error else 0.0
            shown, least, most = (self._shown(value, unsure) for value in (error, low, high))
            mean = f"off by {self._bias(each)}" if each.verdict == "biased" else each.verdict
            judged = self.resolved or each.verdict in ("biased", "unbiased")
            rows.append(
                [
                    f"  {each.estimator}",
                    shown,
                    f"{least} to {most}" if high * self._scale <= MAX_ERROR * self.norm else f"at least {least}",
                    mean if judged else "not judged",
                    f"{1e3 * each.seconds:.3g}",
                ]
            )
        return [*format_table(rows, ["  estimator", *(DIAGNOSIS[name].heading for name in OF_ESTIMATOR)]), LEGEND]

    @property
    def _scale(self) -> float:
        """Norm that errors are relative to: the gradient's if it is distinguishable from 0, else 1."""
        return self.norm if self.resolved else 1.0

    @property
    def _unsure(self) -> float:
        """Relative standard error of the scale."""
        return self.norm_error / self.norm if self.resolved else 0.0

    def _shown(self, error: float, unsure: float) -> str:
        """Format an error to two significant digits, or to one if its relative standard error is large."""
        size = float(f"{error * (100 if self.resolved else 1):.{1 if unsure > ONE_DIGIT_UNCERTAINTY else 2}g}")
        decimals = 1 - math.floor(math.log10(size)) - (unsure > ONE_DIGIT_UNCERTAINTY) if size > 0 else 0
        text = f"{size:.{max(decimals, 0)}f}" if -6 < decimals < 6 else f"{size:g}"
        return f"{text}{' %' if self.resolved else ''}"

    def _bias(self, estimator: Measured) -> str:
        return self._shown(estimator.bias / self._scale, math.hypot(estimator.bias_error, self._unsure))

    def _unresolved(self) -> str:
        """Lines that say that the gradient is not distinguishable from 0, and what would resolve it."""
        if not self.norm:
            return "the gradient is 0: nothing that the parameters change reaches the cost"
        needed = _round(self.surest.variance * (RESOLVED_SE / self.norm) ** 2).replace(",", "")
        other = "larger" if self.surest.estimator == "zobg" else "smaller"
        return (
            f"the gradient cannot be told from 0: its norm is {with_error(self.surest.norm, self.norm_error)}; "
            f"--samples {needed} would tell one of {self.norm:.1g}, and a {other} --sigma may need fewer"
        )

    @property
    def _failure(self) -> str:
        """Verdict on the worst of the wrong derivatives."""
        return next((finding.verdict for finding in self.derivatives.findings if finding.fails), "wrong")

    def _cautions(self) -> Iterator[str]:
        """Caveats about the numbers on the page."""
        if self.lost:
            yield f"{self.lost} samples are not finite and were left out: a smaller --timestep or --sigma may help"
        if self.unconverged:
            yield (
                f"in {self.unconverged} rollouts the contact solver did not converge: their derivatives are not those "
                "of what is simulated; raise --solver-iterations and --solver-ls-iterations"
            )
        if unstable := [each for each in self.touches if not each.stable]:
            yield (
                f"the step in contact is unstable: {unstable[0].pair}, h^2 k = {unstable[0].stiffness:.2g}; take a "
                "smaller --timestep or a softer contact"
            )
        if self.samples < MIN_SAMPLES:
            yield f"{self.samples} samples are few: --samples {SAMPLES} takes longer and says more"
        if self.best.verdict == "undecided" and self.resolved:
            yield f"the mean of {self.best.estimator} could not be judged with {self.samples} samples: take more"
        if not self.derivatives.passed:
            yield "derivatives of a step are not right (see below): do not trust a first-order estimate"

    def _advice(self) -> Iterator[tuple[str, str]]:
        """Recommendations, each with options of `compare` that demonstrate it."""
        by_name, timestep = {each.estimator: each for each in self.estimators}, self.task.scene.timestep
        if not self.resolved:
            more = "more --samples may (see above); or take" if self.norm else "take"
            yield (
                f"no estimator can be advised: {self.samples} samples do not tell the gradient from 0; {more} another "
                "start or cost, in a task of your own (docs/extending.md)",
                "",
            )
            return
        if math.isfinite(self.samples_needed):
            many = _round(self.samples_needed)
            samples = "sample" if many == "1" else "samples"
            needed = f"a relative error of {percent(TARGET_ERROR)} needs {many} {samples}"
            needed += f"; its bias of {self._bias(self.best)} stays" if self.best.verdict == "biased" else ""
        else:
            needed = f"its bias of {self._bias(self.best)} stays, however many samples"
        yield f"at {self.setting.level}, take {self.best.estimator}; {needed}", ""
        if not self.onsets.get("onsets"):
            yield (
                "no contact begins, so nothing here is about contact: take a longer --horizon, a larger --sigma or "
                "another start (for a file, its first keyframe)",
                "",
            )
            return
        plain, corrected = by_name["fobg"], by_name["fobg_onset"]
        spread, strength = self.onsets["onset_spread"], self.onsets["onset_strength"]
        if plain.verdict == "biased":
            text = f"plain first order is biased by {self._bias(plain)}, "
            if max([each.jump for each in self.touches] or [strength]) <= SMOOTH_SHARE:
                text += "though force sets in without a jump: something else jumps, as where corners and edges touch, "
                text += "and zobg alone is sure to be unbiased"
            elif corrected.verdict == "right":
                text += "because contact sets in with a jump: the onset term corrects that"
            else:
                text += "and contact sets in with a jump, the usual cause"
            if travel := max((each.speed * timestep for each in self.touches if each.jump > SMOOTH_SHARE), default=0.0):
                rising = f'solimp="0 0.95 {WIDTH_RATIO * travel:.1g}"'
                text += f"; an impedance that rises from 0 has no jump: {rising} in the MJCF"
            yield text, "--onset linear" if corrected.verdict == "right" else ""
        elif not self.best.estimator.endswith("_onset"):
            return  # the onset term is not recommended
        if corrected.verdict == "right":
            if spread < LEAST_SPREAD:
                yield (
                    f"for onset terms the noise is narrow (the first contact varies by {spread:.2g} steps, "
                    f"{LEAST_SPREAD:g} are enough in general): fobg_onset is right here, by the check of the mean",
                    "",
                )
            return
        explained = ERROR_PER_STRENGTH * strength * (plain.bias + corrected.bias)
        if spread < LEAST_SPREAD:
            finer = f"--timestep {timestep * spread / LEAST_SPREAD:.1g}, or " if spread > 0 else ""
            yield f"for fobg_onset and aobg_onset the noise is too narrow: take {finer}a larger --sigma", ""
        elif corrected.verdict == "biased" and corrected.bias > explained and strength <= MOST_STRENGTH:
            yield (
                f"the onset term leaves a bias of {self._bias(corrected)}, which its own error does not "
                "explain; the usual causes are corners, edges, grazing and rolling contact: take zobg there",
                "",
            )
        elif ERROR_PER_STRENGTH * strength > NOTABLE_SHARE:
            step = timestep * NOTABLE_SHARE / (ERROR_PER_STRENGTH * strength)
            yield (
                f"{linear_error(strength)}: --timestep {step:.1g} brings that down to {percent(NOTABLE_SHARE)}; the "
                "error of --onset jump is only of second order in the step",
                "--onset jump",
            )


def _round(number: float) -> str:
    """Round up to two significant digits, with thousands separators."""
    digits = max(0, math.floor(math.log10(max(number, 1.0))) - 1)
    return f"{math.ceil(number / 10**digits) * 10**digits:,}"
