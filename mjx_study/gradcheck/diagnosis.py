"""Verdict on each entry of a Jacobian: right, its fault, or why there is no derivative."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from mjx_study.gradcheck.coordinates import Coordinates
from mjx_study.gradcheck.differences import Differences

TOLERANCE: Final = 1e-6
"""Tolerance of an entry relative to the largest in its row and block, plus three difference uncertainties."""
MODES_TOLERANCE: Final = 1e-6
"""Allowed relative difference of forward and reverse mode; rounding alone reaches 1e-7 in ill-conditioned solves."""
RESIDUAL_TOLERANCE: Final = 1e-6
MIN_SCALE: Final = 1e-3  # smallest scale of a row's entries, relative to the largest row of its kind
MIN_STEEPNESS: Final = 0.1
"""Difference of one-sided slopes, relative to a row's largest entry, that rounding cannot explain."""
MAX_UNCERTAINTY: Final = 1e-5
"""Relative uncertainty above which a difference is imprecise; such entries are left out of the worst error."""

VERDICTS: Final = ("right", "unresolved", "kink", "jump", "unconverged", "zero", "nan", "engine", "wrong", "value")
"""From right to worst; `engine` and `value` concern steps, not entries."""
RIGHT, UNRESOLVED, KINK, JUMP, UNCONVERGED, ZERO, NAN, ENGINE, WRONG, VALUE = range(10)
FAILURES: Final = ("unconverged", "zero", "nan", "engine", "wrong", "value")
MEANING: Final = {
    "kink": "the step's one-sided slopes disagree, however short: there is no derivative to compare with",
    "jump": "the step itself jumps here, which no derivative sees",
    "unconverged": "the derivative is taken at another point, because the solver stopped early",
    "zero": "the derivative is exactly zero, silently, where the step does change",
    "nan": "the derivative is not a number",
    "wrong": "the derivative is not that of the step",
    "engine": "MJX's step is not the C engine's, and nothing documented explains it",
    "value": "the step itself is not that of mjx.step",
    "engine_mismatch": "the step of MJX differs from that of the C engine as documented (docs/gradient-faults.md)",
    "apart": "the analytic counterpart is another model of the same system, approached as contact stiffens",
}
OF_WHOLE: Final = {
    "nan": "not a number: cost or policy has a function of infinite derivative, such as a square root at 0, perhaps in "
    "the branch of a jnp.where that is not taken",
    "unconverged": "of another point, because the solver stopped early",
}
"""What may be wrong with the gradient of a whole cost whose steps are right."""
Codes = Int[np.ndarray, "outputs inputs"]


def judge(
    layout: Coordinates,
    jacobian: Float[np.ndarray, "outputs inputs"],
    truth: Differences,
    converged: Float[np.ndarray, "outputs inputs"] | None = None,
    *,
    starved: bool = False,
    degenerate: Bool[np.ndarray, "outputs inputs"] | None = None,
) -> Codes:
    """Compare a derivative with differences, and return the index into VERDICTS for each entry.

    Args:
        converged: derivative after a converged solve, to distinguish an unconverged solve from a wrong derivative; None
            if the solver had converged.
        starved: whether the solve is so far from convergence that no entry can be called wrong.
        degenerate: entries that depend on a contact with a vanishing direction; where differences are not smooth
            either, they reach across a jump.
    """
    scale = row_scales(layout, jacobian, truth)
    allowed = TOLERANCE * scale + 3 * truth.uncertainty
    error = np.abs(jacobian - truth.value)
    right = error <= allowed  # False where one is NaN
    codes = np.full(jacobian.shape, WRONG)
    # A derivative between or near the two slopes is as good as any; zero outside of them is not.
    within = error <= np.maximum(truth.gap, allowed)
    outside = (jacobian == 0) & (np.abs(truth.value) > 0.51 * truth.gap + allowed)
    codes[(jacobian == 0) & ~right] = ZERO
    if converged is not None:
        codes[~right & (np.abs(converged - truth.value) <= allowed)] = UNCONVERGED
    codes[np.isnan(truth.value)] = UNRESOLVED
    if starved:
        codes[:] = UNCONVERGED
    codes[right] = RIGHT
    size = np.maximum(np.abs(jacobian), np.abs(truth.value))
    vague = 3 * truth.uncertainty >= np.maximum(size, TOLERANCE * scale)
    codes[right & vague & (size > 0)] = UNRESOLVED  # two zeros agree, whatever their uncertainty
    # The mean of two slopes agrees with central differences, and anything agrees with differences over a jump.
    codes[truth.kink & within & ~outside & (~right | (truth.gap > MIN_SCALE * scale))] = KINK
    codes[truth.jump & (~right | (truth.gap > MIN_STEEPNESS * scale))] = JUMP
    if degenerate is not None:
        codes[degenerate & truth.rough & ~right] = JUMP
    codes[~np.isfinite(jacobian)] = NAN
    return codes


def row_scales(
    layout: Coordinates, jacobian: Float[np.ndarray, "outputs inputs"], truth: Differences | None = None
) -> Float[np.ndarray, "outputs inputs"]:
    """Error scale of an entry: the largest derivative or difference in its row over the same block.

    Rows that hardly depend on a block, and so hold only rounding, get `MIN_SCALE` of the largest row of their kind.
    """
    scale = np.empty(jacobian.shape)
    size = np.where(np.isfinite(jacobian), np.abs(jacobian), 0.0)
    if truth is not None:
        size = np.fmax(size, np.abs(truth.value))  # without those that are NaN
    kinds = np.array([output.block for output in layout.outputs])
    for block in layout.blocks():
        columns = layout.columns(block)
        largest = size[:, columns].max(axis=1)
        for kind in dict.fromkeys(kinds):
            rows = kinds == kind
            floor = max(MIN_SCALE * float(largest[rows].max()), 1e-10)
            scale[np.ix_(rows, columns)] = np.maximum(largest[rows], floor)[:, None]
    return scale


def modes_apart(
    layout: Coordinates,
    first: Float[np.ndarray, "outputs inputs"],
    second: Float[np.ndarray, "outputs inputs"],
    excused: Bool[np.ndarray, "outputs inputs"] | None = None,
) -> float:
    """Largest relative difference of two derivatives where neither is NaN and no jump excuses it.

    Entries far below the largest may differ by its rounding.
    """
    largest = np.nan_to_num(np.abs(first), nan=0.0, posinf=0.0).max(initial=0.0)
    error = np.abs(first - second) / np.maximum(row_scales(layout, first), 1e-6 * largest)
    error = error if excused is None else np.where(excused, 0.0, error)
    return float(np.nan_to_num(error, nan=0.0).max(initial=0.0))


def disagreements(ours: Codes, truth: Differences, engine: Codes, engine_truth: Differences) -> np.ndarray:
    """Mask of smooth entries that are right by this project's differences but wrong by the C engine's."""
    rough = truth.rough | engine_truth.rough
    return np.isin(ours, (RIGHT, UNRESOLVED)) & np.isin(engine, (ZERO, WRONG)) & ~rough


def resolved_by(ours: Codes, engine: Codes) -> Codes:
    """Verdicts in which unresolved entries count as right if the C engine's differences confirm them."""
    return np.where((ours == UNRESOLVED) & (engine == RIGHT), RIGHT, ours)


def worst_error(
    layout: Coordinates,
    jacobian: Float[np.ndarray, "outputs inputs"],
    truth: Differences,
    codes: Codes,
    columns: Sequence[int],
) -> float:
    """Worst relative error of all entries, right or wrong, that have a derivative that differences resolve."""
    scale = row_scales(layout, jacobian, truth)
    counted = ~np.isin(codes, (KINK, JUMP)) & (truth.uncertainty <= MAX_UNCERTAINTY * scale)
    figures = np.where(counted, np.abs(jacobian - truth.value) / scale, 0.0)[:, list(columns)]
    return float("inf") if np.isnan(figures).any() else float(figures.max(initial=0.0))


def worst_verdict(verdicts: Sequence[str]) -> str:
    """Return the worst verdict, by default right."""
    return max(verdicts, key=VERDICTS.index, default="right")
