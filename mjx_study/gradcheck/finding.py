"""Findings of a check: entries that are not right, grouped by cause."""

import dataclasses
from typing import Final

from mjx_study.gradcheck.diagnosis import FAILURES, VERDICTS

OTHERS: Final = {"value": "mjx.step", "engine": "the C engine", "engine_mismatch": "the C engine"}
"""Source of the compared number, if not finite differences."""


@dataclasses.dataclass(frozen=True)
class Entry:
    """An entry of a step's Jacobian that is not right.

    Attributes:
        index: steps since the start of the rollout.
        time: time since the start of the rollout [s].
        name: name of the entry, such as d qvel[hinge] / d ctrl[motor].
        derivative: derivative by automatic differentiation; for a differing step, this project's change.
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
        who: owner of the derivative: `project`, or `mjx.step` for MJX's own.
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
        """Whether it fails the check, because the project's own derivative is not as it should be."""
        return self.who == "project" and self.verdict in FAILURES

    def line(self) -> str:
        """Describe the finding in a sentence, with one entry as example."""
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
        """Format an entry's numbers, with those they are compared with."""
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
