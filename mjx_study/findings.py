"""What a comparison says, in sentences, each backed by intervals."""

from collections.abc import Sequence
from typing import Final

from mjx_study.comparison import CompareResult

SURE: Final = 0.001
"""p-value at which a bias is reported: the least that the test's 999 draws can give."""


def findings(result: CompareResult) -> list[str]:
    """What the intervals say, in sentences: where FoBG's variance is above ZoBG's, and where its mean is biased."""
    return [
        sentence
        for family in result.families
        for sentence in (*_variance_finding(result, family), *_bias_finding(result, family))
    ]


def _variance_finding(result: CompareResult, family: str) -> list[str]:
    table = {(row.stiffness, row.estimator): row for row in result.rows if row.contact == family}
    groups: dict[str, list[float]] = {
        "below ZoBG's": [],
        "above ZoBG's": [],
        "not told apart from ZoBG's": [],
    }
    for stiffness in sorted({stiffness for stiffness, _ in table}):
        if (stiffness, "zobg") not in table or (stiffness, "fobg") not in table:
            return []
        zeroth, first = table[stiffness, "zobg"], table[stiffness, "fobg"]
        below, above = first.variance_upper < zeroth.variance_lower, first.variance_lower > zeroth.variance_upper
        verdict = "below ZoBG's" if below else "above ZoBG's" if above else "not told apart from ZoBG's"
        groups[verdict].append(stiffness)
    parts = [f"{verdict}{_at(group)}" for verdict, group in groups.items() if group]
    return [f"{family}: FoBG's variance is {'; '.join(parts)} ({result.config.confidence:.0%} intervals)"]


def _bias_finding(result: CompareResult, family: str) -> list[str]:
    """Where FoBG's mean is farther from the reference than any draw of the test for bias."""
    biased = []
    for row in result.rows:
        if row.contact == family and row.estimator == "fobg":
            if row.bias_p_value <= SURE:
                biased.append(row)
    return [
        f"{family}: FoBG's mean is biased by {row.relative_error:.1%}{_at([row.stiffness])} "
        f"(p <= {row.bias_p_value:.3f})"
        for row in biased
    ]


def _at(stiffnesses: Sequence[float]) -> str:
    """Where, unless there is no contact."""
    return f" at K = {', '.join(f'{value:g}' for value in stiffnesses)} N/m" if any(stiffnesses) else ""
