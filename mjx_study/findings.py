"""What a comparison says, in sentences, each backed by intervals."""

import math
from collections.abc import Sequence
from typing import Final

from mjx_study.comparison import CompareResult, Row

BIASED: Final = {"fobg": "FoBG", "aobg": "AoBG", "ivw": "IVW"}
"""Whose bias is told: first order, and the interpolations that follow it."""
SURE: Final = 0.001
"""p-value at which a bias is reported: the least that the test's 999 draws can give."""


def findings(result: CompareResult) -> list[str]:
    """What the intervals say, in sentences: where FoBG's variance is above ZoBG's, and whose mean is biased."""
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
    """Where a mean is farther from the reference than any draw of the test for bias; what relies on FoBG follows it."""
    biased = [
        row for row in result.rows if row.contact == family and row.estimator in BIASED and row.bias_p_value <= SURE
    ]
    return [
        f"{family}: {BIASED[row.estimator]}'s mean is biased by {_share(row)}{_at([row.stiffness])} "
        f"(p <= {row.bias_p_value:.3f}){_advice(row, result)}"
        for row in biased
    ]


def _share(row: Row) -> str:
    """Of the reference gradient, to the digits that its error leaves."""
    error = max(row.relative_error_se, row.reference_uncertainty)
    return f"{row.relative_error:.1%}" if error < 0.005 else f"{float(f'{100 * row.relative_error:.2g}'):g}%"


def _advice(row: Row, result: CompareResult) -> str:
    """What keeps an interpolation from following a biased batch."""
    unbounded = row.estimator == "aobg" and math.isinf(result.config.gamma or math.inf)
    return ": it has no accuracy bound; --gamma sets one" if unbounded else ""


def _at(stiffnesses: Sequence[float]) -> str:
    """Where, unless there is no contact."""
    return f" at K = {', '.join(f'{value:g}' for value in stiffnesses)} N/m" if any(stiffnesses) else ""
