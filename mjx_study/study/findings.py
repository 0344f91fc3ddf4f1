"""What a comparison says, in sentences, each backed by intervals."""

import math
from collections.abc import Sequence
from typing import Final

from mjx_study.study.comparison import SURE, CompareResult, Row

BIASED: Final = {"fobg": "FoBG", "aobg": "AoBG", "ivw": "IVW"}
"""Whose bias is told: first order, and the interpolations that follow it."""
APART: Final = 4.0
"""Standard errors beyond which a mean that gets no verdict is said to be off."""


def findings(result: CompareResult) -> list[str]:
    """What the intervals say, in sentences: where FoBG's variance is above ZoBG's, and whose mean is biased."""
    return [
        sentence
        for family in result.families
        for sentence in (*_variance_finding(result, family), *_bias_finding(result, family))
    ]


def _variance_finding(result: CompareResult, family: str) -> list[str]:
    table = {(row.stiffness, row.estimator): row for row in result.rows if row.contact == family}
    below, above, alike = "below ZoBG's", "above ZoBG's", "not told apart from ZoBG's"
    unknown = "not to be told from so few effective samples"
    groups: dict[str, list[float]] = {verdict: [] for verdict in (below, above, alike, unknown)}
    for stiffness in sorted({stiffness for stiffness, _ in table}):
        if (stiffness, "zobg") not in table or (stiffness, "fobg") not in table:
            return []
        zeroth, first = table[stiffness, "zobg"], table[stiffness, "fobg"]
        if not (zeroth.believable and first.believable):
            verdict = unknown
        elif first.variance_upper < zeroth.variance_lower:
            verdict = below
        else:
            verdict = above if first.variance_lower > zeroth.variance_upper else alike
        groups[verdict].append(stiffness)
    parts = [f"{verdict}{_at(group)}" for verdict, group in groups.items() if group]
    return [f"{family}: FoBG's variance is {'; '.join(parts)} ({result.config.confidence:.0%} intervals)"]


def _bias_finding(result: CompareResult, family: str) -> list[str]:
    """Where a mean is farther from the reference than any draw of the test; what relies on FoBG follows it."""
    rows = [row for row in result.rows if row.contact == family and row.estimator in BIASED]
    return [sentence for row in rows if (sentence := _verdict(row, result))]


def _verdict(row: Row, result: CompareResult) -> str:
    """A sentence where a mean is biased, or is off and cannot be judged; empty otherwise."""
    mean, where = f"{row.contact}: {BIASED[row.estimator]}'s mean is", _at([row.stiffness])
    if row.bias_verdict == "biased":
        return f"{mean} biased by {_share(row)}{where} (p <= {row.bias_p_value:.3f}){_advice(row, result)}"
    off = row.bias_p_value <= SURE or row.debiased_error > APART * row.debiased_error_se
    if row.bias_verdict == "none seen" or not off:
        return ""
    held = (
        f"{min(row.effective_samples, row.reference_effective_samples):.1f}" if row.effective_samples else "all equal"
    )
    return f"{mean} off by {_share(row)}{where}, biased or for want of rare samples: too few effective samples ({held})"


def _share(row: Row) -> str:
    """Of the reference gradient, without what noise adds to it, to the digits that its error leaves."""
    error = max(row.debiased_error_se, row.reference_uncertainty)
    return f"{row.debiased_error:.1%}" if error < 0.005 else f"{float(f'{100 * row.debiased_error:.2g}'):g}%"


def _advice(row: Row, result: CompareResult) -> str:
    """What keeps an interpolation from following a biased batch."""
    unbounded = row.estimator == "aobg" and math.isinf(result.config.gamma or math.inf)
    return ": it has no accuracy bound; --gamma sets one" if unbounded else ""


def _at(stiffnesses: Sequence[float]) -> str:
    """Where, unless there is no contact."""
    return f" at K = {', '.join(f'{value:g}' for value in stiffnesses)} N/m" if any(stiffnesses) else ""
