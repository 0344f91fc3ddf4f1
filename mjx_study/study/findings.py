"""Results of a study: a row for each gradient estimate, and findings that the intervals back."""

import itertools
import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import xarray as xr

from estimators import ENOUGH_EFFECTIVE
from mjx_study.study.variables import GRADIENTS

SURE: Final = 0.001
"""p-value at which a mean is called biased: the smallest that the test's 999 draws can give."""
BIASED: Final = {"fobg": "FoBG", "aobg": "AoBG", "ivw": "IVW"}
"""Estimators whose bias is reported: first order, and the interpolations that follow it."""
APART: Final = 4.0
"""Standard errors beyond which a mean without a verdict is reported as off."""
DETECTED: Final = 4.0
"""Standard errors beyond which two means are called different."""
NOTABLE: Final = 0.05
"""Share of the largest slope beyond which a difference without sampling error is reported."""
UNSURE: Final = 0.2
"""Relative uncertainty beyond which a reference is too poor to judge errors by."""
PLACE: Final = ("task", "timestep", "cone", "sigma", "samples", "model", "seed", "estimator", "contact", "stiffness")
"""Coordinates of a row."""
VECTORS: Final = ("gradient", "reference")
COUNTS: Final = ("unconverged", "nonfinite", "onsets", "onsets_bounded", "onsets_missed")


class Row(SimpleNamespace):
    """One gradient estimate: its coordinates and every scalar variable of `GRADIENTS`; None where not applicable."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(f"a row has no {name}")

    @property
    def believable(self) -> bool:
        """Whether the batch has enough effective samples for its errors to be meaningful."""
        return self.effective_samples >= ENOUGH_EFFECTIVE

    @property
    def bias_verdict(self) -> str:
        """Result of the test for bias: "biased", "none seen", or "too few effective samples"."""
        if not min(self.effective_samples, self.reference_effective_samples) >= ENOUGH_EFFECTIVE:
            return "too few effective samples"
        return "biased" if self.bias_p_value <= SURE else "none seen"

    def as_dict(self) -> dict[str, Any]:
        """All variables by name, derived ones included."""
        return vars(self) | {"variance_seconds": self.variance_seconds, "bias_verdict": self.bias_verdict}

    @property
    def variance_seconds(self) -> float:
        """Variance times seconds per sample: the variance left after one second of computing."""
        return self.variance * self.seconds_per_sample


def rows_of(dataset: xr.Dataset) -> list[Row]:
    """A row for each computed estimate, ordered by contact model, seed and estimator last."""
    outer = ("task", "timestep", "cone", "sigma", "samples", "model", "seed", "estimator")
    rows, grid = [], dataset["gradient_norm"].transpose(*outer)
    names = [name for name in GRADIENTS if name in dataset and name not in VECTORS]

    def along(name: str, *last: str) -> np.ndarray:
        return dataset[name].broadcast_like(grid).transpose(*outer, *last).values

    scalars, coordinates = ({name: along(name) for name in each} for each in (names, PLACE))
    vectors = {name: along(name, f"{name}_entry") for name in ("solref", "solimp") if name in dataset}
    for place in np.ndindex(grid.shape):
        if np.isnan(scalars["residual"][place]):
            continue  # not computed
        numbers: dict[str, Any] = {name: values[place].item() for name, values in scalars.items()}
        for name in ("alpha", "epsilon", "discrepancy", "onsets", "onsets_bounded", "onsets_missed"):
            if name not in numbers or math.isnan(numbers[name]):
                numbers[name] = None
        numbers |= {name: int(numbers[name]) for name in COUNTS if numbers[name] is not None}
        at = {name: values[place] for name, values in coordinates.items()}
        at = {name: value.item() if isinstance(value, np.generic) else value for name, value in at.items()}
        solver = {name: tuple(values[place].tolist()) for name, values in vectors.items()}
        rows.append(Row(**at, **solver, **numbers))
    return rows


def findings(dataset: xr.Dataset) -> list[str]:
    """Findings that the intervals of a study back, as sentences."""
    kind = json.loads(dataset.attrs["config"])["kind"]
    return {"gradients": _of_gradients, "descents": lambda _: [], "landscapes": _of_landscapes}[kind](dataset)


def _of_gradients(dataset: xr.Dataset) -> list[str]:
    """Where FoBG's variance exceeds ZoBG's, and which means are biased."""
    rows, gammas, sentences = rows_of(dataset), gammas_of(dataset), []
    confidence = json.loads(dataset.attrs["config"])["confidence"]
    for family in dict.fromkeys(row.contact for row in rows):
        part = [row for row in rows if row.contact == family]
        sentences += _variance_finding(family, part, confidence)
        sentences += _bias_finding(part, gammas) + _meaningless(family, part, gammas)
    return sentences


def gammas_of(dataset: xr.Dataset) -> dict[str, float]:
    """AoBG's accuracy bound by task; infinite for none."""
    options = [entry["estimators"].get("aobg", {}) for entry in json.loads(dataset.attrs["resolved"])]
    names = dataset["task"].values.tolist()
    return {name: float(given.get("gamma", math.inf)) for name, given in zip(names, options, strict=True)}


def _meaningless(family: str, rows: Sequence[Row], gammas: Mapping[str, float]) -> list[str]:
    """Why a result is meaningless: contact never active, reference too uncertain, AoBG's bound below epsilon."""
    found = []
    numbers = defaultdict(list)
    for row in rows:
        key = (row.estimator, row.task, row.timestep, row.cone, row.sigma, row.samples, row.seed)
        numbers[key].append((row.gradient_norm, row.variance))
    several = [each for each in numbers.values() if len(each) > 1]
    if several and all(np.allclose(each, each[0], rtol=1e-12, atol=0, equal_nan=True) for each in several):
        found.append(f"{family}: nothing depends on K: the contact whose stiffness is swept was never active")
    unsure = list(dict.fromkeys(row.stiffness for row in rows if row.reference_uncertainty > UNSURE))
    if unsure:
        found.append(
            f"{family}: the reference's own uncertainty is above {UNSURE:.0%}{_at(unsure)}: errors and verdicts say "
            "little there; --reference-samples makes it better"
        )
    bound = [row for row in rows if row.estimator == "aobg" and (row.epsilon or 0.0) > gammas[row.task]]
    if bound:
        stiffnesses = list(dict.fromkeys(row.stiffness for row in bound))
        found.append(
            f"{family}: AoBG is ZoBG{_at(stiffnesses)}: its bound gamma is below epsilon, the radius of ZoBG's mean; "
            "a larger --gamma or more --samples changes that"
        )
    return found


def _variance_finding(family: str, rows: Sequence[Row], confidence: float) -> list[str]:
    table = {(row.stiffness, row.estimator): row for row in rows}
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
    return [f"{family}: FoBG's variance is {'; '.join(parts)} ({confidence:.0%} intervals)"]


def _bias_finding(rows: Sequence[Row], gammas: Mapping[str, float]) -> list[str]:
    """Means farther from the reference than any draw of the test."""
    return [sentence for row in rows if row.estimator in BIASED and (sentence := _verdict(row, gammas))]


def _verdict(row: Row, gammas: Mapping[str, float]) -> str:
    """A sentence about a mean that is biased, or off but undecided; empty otherwise."""
    mean, where = f"{row.contact}: {BIASED[row.estimator]}'s mean is", _at([row.stiffness])
    if row.bias_verdict == "biased":
        free = row.estimator == "aobg" and math.isinf(gammas[row.task])
        advice = ": it has no accuracy bound; --gamma sets one" if free else ""
        return f"{mean} biased by {_share(row)}{where} (p <= {row.bias_p_value:.3f}){advice}"
    off = row.bias_p_value <= SURE or row.debiased_error > APART * row.debiased_error_se
    if row.bias_verdict == "none seen" or not off:
        return ""
    held = (
        f"{min(row.effective_samples, row.reference_effective_samples):.1f}" if row.effective_samples else "all equal"
    )
    return f"{mean} off by {_share(row)}{where}, from bias or lack of rare samples: too few effective samples ({held})"


def _share(row: Row) -> str:
    """The debiased error as a share of the reference gradient, in significant digits only."""
    error = max(row.debiased_error_se, row.reference_uncertainty)
    return f"{row.debiased_error:.1%}" if error < 0.005 else f"{float(f'{100 * row.debiased_error:.2g}'):g}%"


def _at(stiffnesses: Sequence[float]) -> str:
    """The stiffnesses, for a sentence; empty without contact."""
    return f" at K = {', '.join(f'{value:g}' for value in stiffnesses)} N/m" if any(stiffnesses) else ""


def _of_landscapes(dataset: xr.Dataset) -> list[str]:
    """Where the mean of FoBG differs from the slope of the mean cost."""
    return [
        f"{label}: {_gap(one)}" for label, one in curves_of(dataset) if {"zobg", "fobg"} <= set(one["estimator"].values)
    ]


def curves_of(dataset: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """The computed cells of a study of landscapes: contact model, and its numbers along the line."""
    outer = ("task", "timestep", "cone", "sigma", "samples", "model")
    cells = (
        dataset.isel(dict(zip(outer, place, strict=True)))
        for place in itertools.product(*(range(dataset.sizes[name]) for name in outer))
    )
    return [(one["model"].item(), one) for one in cells if bool(one["position"].notnull().any())]


def _gap(one: xr.Dataset) -> str:
    """Where E[FoBG] differs from the slope of the mean cost; by quadrature if there is one."""
    if "exact_slope" in one and bool(one["exact_slope"].notnull().all()):
        first, slope = one["exact_first"].values, one["exact_slope"].values
        largest = float(np.max(np.abs(slope)))
        error = 3 * (one["exact_slope_error"].values + one["exact_first_error"].values) + NOTABLE * largest
        source, uncertainty = "the mean cost's slope", f"more than {NOTABLE:.0%} of its largest value"
    else:
        first, slope = (one["slope"].sel(estimator=name).values for name in ("fobg", "zobg"))
        error = DETECTED * np.hypot(*(one["slope_se"].sel(estimator=name).values for name in ("fobg", "zobg")))
        source, uncertainty = "E[ZoBG]", f"more than {DETECTED:g} standard errors"
    seen = np.abs(first - slope) > error
    if not np.any(seen):
        return f"E[FoBG] nowhere differs from {source} by {uncertainty}"
    worst = int(np.argmax(np.where(seen, np.abs(first - slope), -np.inf)))
    return (
        f"E[FoBG] differs from {source} by {uncertainty} at {np.mean(seen):.0%} of the points, most at "
        f"{one['position'].values[worst]:.3g}, where it is {first[worst]:.3g} in place of {slope[worst]:.3g}"
    )
