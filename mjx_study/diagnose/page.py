"""The page of a diagnosis, as text and as data."""

import dataclasses
import math
import re
import shlex
import textwrap
from typing import Any, Final

from mjx_study.choices import is_file
from mjx_study.diagnose.advice import advise, cautions
from mjx_study.diagnose.columns import CONTACTS, DISTANCE, ESTIMATES, TOUCHES
from mjx_study.diagnose.means import ALONG_MEANS
from mjx_study.diagnose.measurement import RESOLVED_SE, Measured
from mjx_study.diagnose.run import Diagnosis, enough
from mjx_study.runtime import environment
from mjx_study.table import Column, as_plain, percent, tabulate, with_error

LEGEND: Final = "  zobg: zeroth order; fobg: first order; aobg: both, weighted"
TERM: Final = "; _onset: with a term for contact that begins or ends"
UNKNOWN: Final = "unknown"
NOT_JUDGED: Final = "not judged"
UNJUDGED: Final = "  not judged: means are judged by shares of the gradient, which is not distinguishable from 0"
MAX_ERROR: Final = 100.0  # upper end beyond which the interval of a relative error is uninformative
MAX_SHOWN: Final = 6  # number of contacts listed in the text, the least resolved ones


def document_of(found: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis as plain data; nonfinite numbers become None."""
    norm = found.norm if found.resolved else math.nan
    document = {
        "subject": found.subject,
        "theta": found.theta or None,
        "cost": found.task.description,
        "contact": found.contact,
        "samples": found.samples,
        **dataclasses.asdict(found.setting),
        "touches": [dataclasses.asdict(each) for each in found.touches],
        **found.onsets,
        "nonfinite": found.lost,
        "unconverged": found.unconverged,
        "derivatives": "right" if found.derivatives.passed else found.derivatives.failure,
        "unexercised": found.derivatives.unexercised,
        "estimators": [
            {
                "estimator": each.estimator,
                "variance": each.variance,
                "seconds_per_sample": each.seconds,
                "mean": each.verdict,
                "bias": each.bias / norm,
                "error_after_a_second": each.error(1.0) / norm,
            }
            for each in found.estimators
        ],
        "best": found.best.estimator if found.resolved else None,
        "gradient_norm": found.norm,
        "gradient_norm_error": found.norm_error,
        "resolved": found.resolved,
        "samples_needed": found.samples_needed if found.resolved else None,
        "warnings": [*found.warnings, *cautions(found)],
        "advice": [text for text, _ in advise(found)],
        "environment": environment(),
    }
    return as_plain(document)


def page_lines(found: Diagnosis) -> list[str]:
    """Return a diagnosis as text: each statement is followed by the command that reproduces it."""
    command = f"mjx-study {{}} {shlex.quote(found.subject)}{found.options}"
    compare, check = f"  > {command.format('compare')}", f"  > {command.format('gradcheck')}"
    lines = [
        f"{found.subject}: {found.task.description or found.task.name}",
        f"contact {found.contact}, {found.samples} samples",
        f"{found.setting.line()}{found.theta and f', at theta {found.theta}'}",
        *([] if found.resolved else [_unresolved(found)]),
        *(f"warning: {text}" for text in (*found.warnings, *cautions(found))),
        "",
        "contact",
        *_contact_lines(found),
    ]
    if found.onsets.get("onsets") and not found.law:
        lines.append(f"{compare} --estimators fobg_onset --samples {found.samples} --json")
    steps = re.sub(r" --sigma \S+", "", check)  # steps have no noise, and those of a file no policy
    steps = re.sub(r" --theta ('[^']*'|\S+)", "", steps) if is_file(found.subject) else steps
    lines += ["", "derivatives of a step", f"  {_derivatives(found)}", steps]
    if found.resolved:
        of = "slope of the mean cost along a path" if found.by_slope else "gradient"
        norm = with_error(found.norm, found.norm_error)
        heading = f"estimators, by their error relative to the {of}, {norm}, after a second of computing"
    else:
        heading = "estimators, by their error, in the gradient's unit, after a second of computing"
    batch = f"--estimators {','.join(each.estimator for each in found.estimators)} --samples {found.samples}"
    lines += ["", heading, *_estimator_lines(found)]
    lines += [f"{check} --mean --direction {ALONG_MEANS} {batch}", f"{compare} {batch}", "", "advice"]
    for text, flags in advise(found):
        lines += textwrap.wrap(text, 100, initial_indent="  ", subsequent_indent="    ")
        shown = f"{compare} {flags}"
        lines += [shown] if flags and shown not in lines else []
    return lines


def _derivatives(found: Diagnosis) -> str:
    if not found.derivatives.passed:
        return f"NOT RIGHT: {found.derivatives.reason}"
    parts = dict.fromkeys(part for parts in found.derivatives.unexercised.values() for part in parts)
    return "; not exercised: ".join(["every derivative that exists is right", *([", ".join(parts)] if parts else [])])


def _contact_lines(found: Diagnosis) -> list[str]:
    onsets = found.onsets.get("onsets", 0)
    start = "; bodies that touch at the start do not count" if found.touches and not onsets else ""
    lines = [f"  contacts and limits that begin in a rollout with noise: {onsets / found.samples:.3g}{start}"]
    if found.law:
        before = f" a contact begins {1e3 * found.lead:.3g} ms before touch, where it acts;" if found.lead else ""
        lines.insert(0, f"  {found.law} is not MuJoCo's law:{before} onset terms and impedance do not apply")
    if onsets:
        begun = math.isfinite(found.onsets["onset_spread"])
        if begun:
            lines.append(f"  step at which the first begins: standard deviation {found.onsets['onset_spread']:.2g}")
        if begun and "onset_strength" in found.onsets:
            share = percent(found.onsets["onset_strength"])
            lines.append(f"  approach speed that a contact takes in its first step: {share}")
        for name, what in (
            ("missed", "they chatter, or are too many"),
            ("replaced", "corners or edges replace others"),
        ):
            if count := found.onsets.get(f"onsets_{name}", 0):
                lines.append(f"  per rollout, without a term ({what}): {count / found.samples:.3g}")
    if not found.touches:
        return [*lines, "  contacts that begin in the rollout without noise: 0"]
    worst = sorted(found.touches, key=lambda each: (each.stable, -each.jump, -(each.travel or each.speed)))
    pair = Column("  without noise", lambda each: f"  {each.pair}")
    more = len(worst) - MAX_SHOWN
    return [
        *lines,
        *tabulate(
            sorted(worst[:MAX_SHOWN], key=lambda each: each.time),
            [pair, *TOUCHES, *([DISTANCE] if found.law else CONTACTS)],
        ),
        *([f"  and {more} more"] if more > 0 else []),
    ]


def _estimator_lines(found: Diagnosis) -> list[str]:
    name = Column("  estimator", lambda row: f"  {row[-1]}")
    rows = [(*_estimate(found, each), each.estimator) for each in found.estimators]
    lines = [*tabulate(rows, [name, *ESTIMATES]), f"{LEGEND}{'' if found.law else TERM}"]
    return [*lines, UNJUDGED] if any(NOT_JUDGED in row for row in rows) else lines


def _estimate(found: Diagnosis, each: Measured) -> tuple[str, str, str, str]:
    """Error, its interval, verdict on the mean, and milliseconds."""
    error, (low, high) = each.error(1.0), each.interval(1.0)
    uncertainty = math.hypot((high - low) / 4 / error, found.scale_error) if error else 0.0
    shown, least, most = (found.error_text(value, uncertainty) for value in (error, low, high))
    mean = f"off by {found.off_text(each)}" if each.verdict == "biased" else each.verdict
    judged = found.resolved or each.verdict in ("biased", "unbiased")
    if high <= MAX_ERROR * found.norm:
        interval = f"{least} to {most}"
    else:
        interval = f"at least {least}" if low > error / 10 else UNKNOWN
    return shown, interval, mean if judged else NOT_JUDGED, f"{1e3 * each.seconds:.3g}"


def _unresolved(found: Diagnosis) -> str:
    """Say that the gradient is not significantly different from 0, and how to resolve it."""
    if not found.norm:
        return "the gradient is 0: no parameter affects the cost"
    if not math.isfinite(found.norm):
        return f"the gradient is unknown: {found.samples - found.lost} of {found.samples} samples are finite"
    needed = enough(found, (RESOLVED_SE * found.norm_error / found.norm) ** 2)
    other = "larger" if found.surest.estimator == "zobg" else "smaller"
    return (
        f"the gradient is not significantly different from 0: its norm is "
        f"{with_error(found.surest.norm, found.norm_error)}; {needed} would resolve one of {found.norm:.1g} by "
        f"{found.surest.estimator}, and a {other} --sigma may need fewer"
    )
