"""Format tables, and numbers with their intervals."""

import itertools
import math
import shutil
from collections.abc import Callable, Sequence
from typing import Any

import xarray as xr

from estimators import ENOUGH_EFFECTIVE
from mjx_study.choices import FAMILIES
from mjx_study.plots.style import style_of
from mjx_study.study.findings import Row, findings, rows_of
from mjx_study.table import format_table

Column = tuple[str, Callable[[Row], str]]


def number(value: float | None, digits: int = 3) -> str:
    """Format a number in few characters; `-` for None, `nan` and `inf` unchanged."""
    if value is None:
        return "-"
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if 1e-3 <= abs(value) < 1e4:
        rounded = float(f"{value:.{digits}g}")
        return f"{rounded:.0f}" if abs(rounded) >= 10 ** (digits - 1) else f"{rounded:.{digits}g}"
    mantissa, exponent = f"{value:.1e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def _interval(row: Row) -> str:
    return f"{number(row.variance)} ({number(row.variance_lower, 2)} to {number(row.variance_upper, 2)}){_doubt(row)}"


def _doubt(row: Row) -> str:
    """Mark for a number that rests on too few effective samples."""
    return "" if row.believable else "?"


def _effective(row: Row) -> str:
    return number(row.effective_samples, 2) + (f" ({row.top_share:.0%})" if row.effective_samples else "")


def _with_error(value: float, error: float) -> str:
    """Format value and error to the error's second digit, or separately where that takes many characters."""
    if not (math.isfinite(value) and 0 < error < math.inf):
        return number(value)
    if not 1e-4 <= error < 1000:
        return f"{number(value, 2)} ± {number(error, 2)}"
    decimals = max(0, 1 - math.floor(math.log10(error)))
    return f"{value:.{decimals}f} ± {error:.{decimals}f}"


def _debiased(row: Row, value: float, debiased: float, error: float, best: float) -> str:
    """Format a value and what remains of it without noise: a bound if no error is detected, "-" if noise explains all
    of it."""
    plain = f"{value:.3f}" if 0.01 <= abs(value) < 1000 else number(value, 2)
    if math.isnan(debiased):
        left = "-"
    elif debiased == best and 0 < error < math.inf:
        says_nothing = abs(debiased - value) <= 2 * error
        decimals = 2 if error >= 0.005 else 4
        above = best - math.ceil(10**decimals * 2 * error) / 10**decimals
        bound = f"< {number(2 * error, 2)}" if best == 0 else f"> {above:.{decimals}f}"
        left = "-" if says_nothing else bound
    else:
        left = _with_error(debiased, error)
    return f"{plain} -> {left}{_doubt(row)}"


def columns(confidence: float, details: bool = False, *, scalar: bool = False) -> list[list[Column]]:
    """Columns of the comparison: those that identify a row, then groups that a table keeps together.

    Args:
        confidence: confidence level of the intervals.
        details: include all columns, not only those that help to choose an estimator.
        scalar: for a scalar parameter, where a cosine is meaningless.
    """
    variance = f"variance ({confidence:.0%} interval)", _interval
    error = (
        "relative error -> debiased",
        lambda row: _debiased(row, row.relative_error, row.debiased_error, row.debiased_error_se, 0.0),
    )
    cosine = (
        "cosine -> debiased",
        lambda row: _debiased(row, row.cosine, row.debiased_cosine, row.debiased_cosine_se, 1.0),
    )
    alpha = "alpha", lambda row: "-" if row.alpha is None else f"{row.alpha:.3f}"
    times: list[Column] = [
        ("ms", lambda row: number(1e3 * row.seconds_per_sample, 2)),
        ("variance x s", lambda row: number(row.variance_seconds, 2)),
    ]
    identity: list[Column] = [
        ("K [N/m]", lambda row: number(row.stiffness or None)),
        ("estimator", lambda row: style_of(row.estimator)[0]),
    ]
    if not details:
        return [identity, [variance, error], [alpha, *times]]
    return [
        identity,
        [("|gradient|", lambda row: number(row.gradient_norm)), variance, ("effective (top)", _effective)],
        [error] if scalar else [error, cosine],
        [alpha, ("epsilon", lambda row: number(row.epsilon)), ("B", lambda row: number(row.discrepancy))],
        [*times, ("residual", lambda row: number(row.residual, 2)), ("nan", lambda row: str(row.nonfinite))],
    ]


def _blocks(rows: Sequence[Row], shown: list[list[Column]], width: int) -> list[list[str]]:
    """Split the columns into as few tables as the width allows, each with the identifying columns."""
    identity, *parts = shown
    blocks: list[list[Column]] = []
    for part in parts:
        if blocks and len(_table(rows, identity + blocks[-1] + part)[0]) <= width:
            blocks[-1] += part
        else:
            blocks.append(list(part))
    return [_table(rows, identity + block) for block in blocks]


def gradient_lines(dataset: xr.Dataset, document: dict[str, Any], details: bool = False) -> list[str]:
    """Format a study of gradients as text: configuration, a table per contact family, findings.

    Args:
        document: see `as_document`.
        details: include all columns.
    """
    config, rows, lines = document["config"], rows_of(dataset), []
    shown = columns(config["confidence"], details, scalar=dataset.sizes.get("param") == 1)
    for resolved, task in zip(document["resolved"], dataset["task"].values.tolist(), strict=True):
        lines.append(
            f"{task}: {', '.join(map(str, config['samples']))} samples in each batch, "
            f"sigma {', '.join(f'{sigma:g}' for sigma in dataset['sigma'].values)}, "
            f"{', '.join(map(str, resolved['horizon']))} steps, {', '.join(dataset['cone'].values)} cone, "
            f"seed {config['seed']}, {document['environment']['precision']}"
        )
    width = shutil.get_terminal_size((140, 24)).columns
    for family in dict.fromkeys(row.contact for row in rows):
        lines += ["", f"{family}: {FAMILIES[family].description}" if family in FAMILIES else family]
        lines += itertools.chain(*_blocks([row for row in rows if row.contact == family], shown, width))
    lines.append("")
    uncertainty = [row.reference_uncertainty for row in rows if math.isfinite(row.reference_uncertainty)]
    if uncertainty:
        low, high = number(min(uncertainty), 2), number(max(uncertainty), 2)
        lines += [
            f"Errors are against an unbiased zeroth-order reference gradient, {config['reference_samples']} pairs "
            "of rollouts with a control variate;",
            f"its own relative uncertainty is {low if low == high else f'{low} to {high}'}, and smaller errors cannot "
            "be told from zero.",
            "After the arrows: the same without the sampling noise of batch and reference, ± one standard error;",
            "< and >: no error is detected, these are bounds of two standard errors; -: noise explains all of it.",
        ]
    if not all(row.believable for row in rows):
        lines.append(
            f"?: fewer than {ENOUGH_EFFECTIVE:g} effective samples carry the batch's variance; trust neither the "
            "number nor its error."
        )
    return lines + [f"{sentence}." for sentence in document["findings"]]


def rows_as_json(dataset: xr.Dataset) -> dict[str, Any]:
    """Findings, and a row per estimate."""
    return {"findings": findings(dataset), "rows": [row.as_dict() for row in rows_of(dataset)]}


def _table(rows: Sequence[Row], table: Sequence[Column]) -> list[str]:
    cells = [[show(row) for _, show in table] for row in rows]
    for previous, current in reversed(list(zip(range(len(rows)), range(1, len(rows)), strict=False))):
        if rows[previous].stiffness == rows[current].stiffness:
            cells[current][0] = ""
    return format_table(cells, [heading for heading, _ in table])
