"""Results of a gradient check, as data and as text."""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from typing import Any, Final

from mjx_study.gradcheck.coverage import Coverage
from mjx_study.gradcheck.diagnosis import FAILURES, MEANING, OF_WHOLE, VERDICTS
from mjx_study.table import Column, as_plain, grouped, tabulate

MAX_SHOWN: Final = 12  # maximum number of findings in the text, unless all are requested
PLACES: Final = {
    "pushed to": "a rollout with random pushes of so many m/s or rad/s, to what the task's own does not reach",
    "from pose": "a fall from a random pose, likewise",
}
"""What the names of states mean that the rollout does not reach."""
WHOLE: Final = "the whole rollout"
"""Place of a finding on the gradient of a whole cost."""
OTHERS: Final = {"value": "mjx.step", "engine": "the C engine", "engine_mismatch": "the C engine"}
"""Source of the compared number, if not finite differences."""
HEADINGS: Final = {
    "stiffness": "K [N/m]",
    "gradient_norm": "|gradient|",
    "difference": "differences",
    "one_sided": "one-sided",
    "closed_form": "closed form",
    "stock_step": "mjx step",
    "engine_step": "C step",
    "engine": "C engine",
    "stock": "mjx.step",
}
"""Headings of columns that are not named after the attribute."""
OF_COST: Final = "contact stiffness gradient_norm modes difference one_sided closed_form residual verdict"
OF_STEP: Final = (
    "contact stiffness states modes differences parameters stock_step engine_step engine stock residual "
    "unresolved verdict"
)
"""Attributes in the columns of the two tables."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """An entry of a step's Jacobian that is not right, such as d qvel[hinge] / d ctrl[motor].

    Attributes:
        index, time: steps and seconds since the start of the rollout.
        derivative: by automatic differentiation; for a differing step, this project's change.
        difference: central difference, or None; for a differing step, the other implementation's change.
    """

    state: str
    index: int
    time: float
    name: str
    derivative: float
    difference: float | None
    gap: float | None = None


@dataclasses.dataclass(frozen=True)
class Finding:
    """Entries that are not right, with a common cause.

    Attributes:
        contact: label of the contact model, such as penalty, K = 100 N/m.
        who: owner of the derivative: `project` or `mjx.step`.
        verdict: kink, jump, unconverged, zero, nan, engine, wrong, value, engine_mismatch or apart.
        modes: differentiation modes that show it: forward, reverse, tape.
        cause: likely cause, in one sentence.
        entries: all affected entries, at any state; the text quotes the first as example.
    """

    contact: str
    who: str
    verdict: str
    modes: tuple[str, ...]
    cause: str
    entries: tuple[Entry, ...]

    @property
    def fails(self) -> bool:
        """Whether it fails the check, because the project's derivative is at fault."""
        return self.who == "project" and self.verdict in FAILURES

    @property
    def of_whole(self) -> bool:
        """Whether it is about the gradient of a whole cost, not about a step."""
        return any(each.state == WHOLE for each in self.entries)

    def line(self) -> str:
        example, states = self.entries[0], len({entry.state for entry in self.entries})
        who = f"{self.who}: " if self.who != "project" else ""
        where = example.state if states == 1 else f"{states} states"
        count = where if len(self.entries) == 1 else f"{len(self.entries)} entries, {where}"
        modes = f", {' and '.join(self.modes)} mode" if self.who == "project" and len(self.modes) in (1, 2) else ""
        if not example.name:
            return f"{who}{self.verdict} ({count}): {self.cause}"
        numbers = self.numbers(example)
        return f"{who}{self.verdict} ({count}{modes}), as {example.name} {numbers}: {self.cause}"

    def numbers(self, entry: Entry) -> str:
        if self.verdict == "jump" and entry.gap:
            return f"= {entry.derivative:.6g}, but differences reach {entry.gap:.2g}"
        other = OTHERS.get(self.verdict, "differences")
        there = "" if entry.difference is None else f", {other} {entry.difference:.6g}"
        gap = f" (one-sided apart by {entry.gap:.2g})" if entry.gap else ""
        return f"= {entry.derivative:.6g}{there}{gap}"


def gravity(finding: Finding) -> tuple[bool, bool, int]:
    """Sort key that puts the worst findings first."""
    order = {name: rank for rank, name in enumerate((*reversed(VERDICTS), "engine_mismatch", "apart"))}
    return not finding.fails, finding.who != "project", order[finding.verdict]


@dataclasses.dataclass(frozen=True)
class CostCheck:
    """Checks of one contact model's whole-horizon gradient; errors are relative to its norm.

    Attributes:
        stiffness: K [N/m].
        gradient_norm: in cost per unit of theta.
        modes: difference between reverse and forward mode along some directions.
        difference: difference from central differences along the same directions.
        one_sided: disagreement of the two one-sided differences at the smallest step.
        closed_form: distance from the hand-written gradient of the reference system, which measures the distance
            between the two models of the system. None without a reference.
        residual: largest relative solver residual of the rollout.
        verdict: right, unresolved, kink, jump, unconverged, nan or wrong.
    """

    contact: str
    stiffness: float
    gradient_norm: float
    modes: float
    difference: float
    one_sided: float
    closed_form: float | None
    residual: float
    verdict: str


@dataclasses.dataclass(frozen=True)
class StepCheck:
    """Checks of single steps for one contact model; errors are relative, the worst over the states.

    Attributes:
        contact: name of the contact family.
        stiffness: K [N/m]; 0 if the contact model is not defined by one.
        states: number of states checked.
        entries: total number of Jacobian entries.
        unresolved: number of entries whose differences are too uncertain to judge.
        modes: difference between reverse and forward mode.
        differences: error of derivatives with respect to state and control, by central differences.
        parameters: error of derivatives with respect to contact parameters; None without contacts.
        stock_step: difference of the next state from that of `mjx.step`, relative to what its forces cause; None if its
            law is not MuJoCo's.
        engine_step: difference of the next state from the C engine's, likewise.
        engine: difference of the Jacobian from the C engine's where the steps agree; None if they never do.
        stock: error of the derivative of `mjx.step`; None if not requested, infinite if NaN.
        residual: largest relative solver residual.
        coverage: parts of the model that the states exercise.
        verdict: worst of the findings on the project's derivative.
    """

    contact: str
    stiffness: float
    states: int
    entries: int
    unresolved: int
    modes: float
    differences: float
    parameters: float | None
    stock_step: float | None
    engine_step: float | None
    engine: float | None
    stock: float | None
    residual: float
    coverage: Coverage
    verdict: str

    @property
    def label(self) -> str:
        return f"{self.contact}, K = {self.stiffness:g} N/m" if self.stiffness else self.contact


@dataclasses.dataclass(frozen=True)
class GradcheckReport:
    """All checks and findings, with the environment.

    Attributes:
        subject: name of the task or file.
        summary: size of the model, and what was checked, in one line.
        costs: checks of whole-horizon gradients, one per contact model; empty for a file.
        steps: checks of single steps, one per contact model.
        findings: findings, worst first.
        warnings: warnings about contact models and about features without a derivative.
        environment: versions, machine, devices and precision.
    """

    subject: str
    summary: str
    costs: tuple[CostCheck, ...]
    steps: tuple[StepCheck, ...]
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]
    environment: dict[str, Any]

    @property
    def passed(self) -> bool:
        """Whether no derivative of the project is wrong, NaN, silently zero or unconverged."""
        return not self.failure

    @property
    def failure(self) -> str:
        """The first verdict that fails; empty if none does."""
        verdicts = [each.verdict for each in self.findings if each.fails]
        verdicts += [check.verdict for check in (*self.steps, *self.costs) if check.verdict in FAILURES]
        return next(iter(verdicts), "")

    @property
    def reason(self) -> str:
        """What is wrong; empty if nothing is."""
        failing = [each for each in self.findings if each.fails]
        if failing and all(each.of_whole for each in failing):
            return failing[0].cause
        if failing or any(check.verdict in FAILURES for check in self.steps):
            return MEANING[self.failure]
        what = OF_WHOLE.get(self.failure, "not its slope: look at the derivatives of cost and policy")
        return (
            f"the derivatives of steps are right, but the gradient of the whole cost is {what}" if self.failure else ""
        )

    @property
    def unexercised(self) -> dict[str, tuple[str, ...]]:
        """Parts of the model that no state exercised, by contact model."""
        return {check.label: check.coverage.missing for check in self.steps if check.coverage.missing}

    def as_json(self) -> dict[str, Any]:
        """Return the report as plain data; nonfinite numbers become None."""
        return as_plain(dataclasses.asdict(self) | {"passed": self.passed, "unexercised": self.unexercised})

    def lines(self, *, verbose: bool = False) -> list[str]:
        """Return the report as text; `verbose` lists every entry of every finding."""
        lines = [f"{self.subject}: {self.summary}", ""]
        if self.costs:
            lines += ["gradient of the whole cost", *_table(self.costs, OF_COST)]
            if any(check.gradient_norm == 0 for check in self.costs):
                lines.append(
                    "|gradient| 0: the cost has no slope here, so that nothing is checked; try another --theta"
                )
            lines.append("")
        lines += ["one step", *_table(self.steps, OF_STEP)]
        if any(check.unresolved for check in self.steps):
            most = max(self.steps, key=lambda check: check.unresolved / check.entries)
            lines.append(
                f"unresolved: entries of the Jacobian, of {most.entries}, whose differences are too uncertain to judge"
            )
        lines += [""]
        lines += self._coverage_lines()
        lines += self._finding_lines(verbose)
        lines += [f"warning: {text}" for text in (*self.warnings, *self._gaps())]
        verdict = "every derivative that exists is right" if self.passed else f"NOT RIGHT: {self.reason}"
        return [*lines, f"{verdict}, where it was checked" if self.passed and self.unexercised else verdict]

    def _coverage_lines(self) -> list[str]:
        alike = grouped(self.steps, lambda check: check.coverage.line())
        labels = {line: ", ".join(check.label for check in checks) for line, checks in alike.items() if line}
        lines = [f"{label}: {line}" if len(alike) > 1 else line for line, label in labels.items()]
        return ["exercised", *lines, ""] if lines else []

    def _gaps(self) -> list[str]:
        unexercised = self.unexercised
        return [
            f"{', '.join(labels)}: no state exercises {' and '.join(missing)}, whose derivatives are unchecked; try "
            "more --states, a longer --horizon, another --seed or an MJCF whose first keyframe does"
            for missing, labels in grouped(unexercised, unexercised.__getitem__).items()
        ]

    def _finding_lines(self, verbose: bool) -> list[str]:
        """Findings, one line per kind and cause, whatever the number of contact models that show it."""
        alike = grouped(self.findings, lambda finding: (finding.who, finding.verdict, finding.cause))
        shown = list(alike.values()) if verbose else list(alike.values())[:MAX_SHOWN]
        lines: list[str] = []
        for group in shown:
            contacts = list(dict.fromkeys(finding.contact for finding in group))
            others = f" (and {len(contacts) - 1} more)" if len(contacts) > 1 else ""
            lines.append(f"{contacts[0]}{others}: {group[0].line()}" if len(self.steps) > 1 else group[0].line())
            for finding in group if verbose else ():
                label = f"{finding.contact}, " if len(self.steps) > 1 else ""
                lines += [
                    f"    {label}{entry.state} ({entry.time:.4g} s)  {entry.name} {finding.numbers(entry)}"
                    for entry in finding.entries
                ]
        if len(shown) < len(alike):
            lines.append(f"and {len(alike) - len(shown)} more (--details lists all)")
        verdicts = dict.fromkeys(each.verdict for each in self.findings if not (each.of_whole and each.fails))
        lines += [f"{verdict}: {MEANING[verdict]}" for verdict in verdicts if verdict in MEANING]
        text = "\n".join(lines)
        lines += [f"{name}: {meaning}" for name, meaning in PLACES.items() if name in text]
        return [*lines, ""] if lines else []


def _table(checks: Sequence[CostCheck | StepCheck], names: str) -> list[str]:
    """A table of attributes, without empty columns."""
    columns = [Column(HEADINGS.get(name, name), partial(_cell, name=name)) for name in names.split()]
    return tabulate(checks, columns, omit="-")


def _cell(check: CostCheck | StepCheck, name: str) -> str:
    value = getattr(check, name)
    if name == "verdict":
        return f"right, but {value}s" if value in ("kink", "jump") else value
    if name == "stiffness":
        return f"{value:g}" if value else "-"
    if name == "gradient_norm":
        return f"{value:.4g}"
    if isinstance(value, float):
        return f"{value:.1e}" if math.isfinite(value) else "NaN"
    return "-" if value is None else str(value)
