"""Results of a study: a row for each gradient estimate, and findings supported by the intervals."""

import json
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
import xarray as xr

from estimators import ENOUGH_EFFECTIVE, ESTIMATORS, ORACLES
from estimators.registry import label_of
from mjx_study.results.variables import GRADIENTS, ONSETS, THETA
from mjx_study.table import digits_to_tell_apart, number, percent, with_error

BIASED_P_VALUE: Final = 0.001
"""p-value at which a mean is called biased: the smallest that the test's 999 draws can yield."""
OFF_SE: Final = 4.0
"""Standard errors beyond which a mean without a verdict is reported as off."""
DETECTED_SE: Final = 4.0
"""Standard errors beyond which two means are considered different."""
NOTABLE_SHARE: Final = 0.05
"""Share of the largest slope beyond which a difference free of sampling error is reported."""
MOST_UNCERTAINTY: Final = 0.2
"""Relative uncertainty beyond which a reference is too imprecise to judge errors."""
ERROR_PER_STRENGTH: Final = 0.5
"""Error of the linear onset term's mean, as a share of what the term adds, over the onset strength. Among 11 contact
models on momentum_transfer and ball_wall the largest was 0.44; at random thetas the atlas has larger ones, at grazing
contacts, at corners, or where an onset is stronger than `MOST_STRENGTH`."""
MOST_STRENGTH: Final = 0.9
"""Onset strength up to which `ERROR_PER_STRENGTH` holds; where an onset removes more of the approach speed in one step,
the linear term's error can exceed the term. Fitted to half of the atlas's cells on momentum_transfer; right for 59 of
the other 61."""
LEAST_SPREAD: Final = 0.75
"""Standard deviation of the first onset's step from which an onset term is accurate to 1.5 % of what it adds; at 0.5
it can be off by 60 %."""
SETTING: Final = ("task", "timestep", "cone", "sigma", "samples")
"""Coordinates shared by all rows of a finding."""
AXES: Final = (*SETTING, "model", "seed", "estimator")
"""Dimensions along which there is a row for each place."""
PLACE: Final = (*AXES, "contact", "stiffness")
"""Coordinates of a row."""
BELOW, ABOVE, ALIKE = "below ZoBG's", "above ZoBG's", "not told apart from ZoBG's"
UNKNOWN: Final = "undecided (too few effective samples)"
"""Verdicts on FoBG's variance."""
BOUND: Final = "its bound gamma is below epsilon, the radius of ZoBG's mean; increase --gamma or --samples"
WEIGHTLESS: Final = (
    "alpha is 0 in every iteration, generally since its bound gamma is below epsilon, the radius of ZoBG's mean (then "
    "increase --gamma or --samples), else since no first-order variance is finite"
)
"""Why AoBG equals ZoBG: known of a batch, whose epsilon is kept, and supposed of a descent."""


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
        return "biased" if self.bias_p_value <= BIASED_P_VALUE else "none seen"

    def as_dict(self) -> dict[str, Any]:
        """All variables by name, derived ones included."""
        return vars(self) | {"variance_seconds": self.variance_seconds, "bias_verdict": self.bias_verdict}

    @property
    def variance_seconds(self) -> float:
        """Variance times seconds per sample: the variance remaining after one second of computing."""
        return self.variance * self.seconds_per_sample


def rows_of(dataset: xr.Dataset) -> list[Row]:
    """Return a row for each computed estimate; contact model, seed and estimator vary fastest."""
    rows, grid = [], dataset["gradient_norm"].transpose(*AXES)
    names = [name for name, variable in GRADIENTS.items() if name in dataset and "param" not in variable.dims]

    def along(name: str, *last: str) -> np.ndarray:
        variable = dataset[name].variable
        return variable.set_dims({**grid.sizes, **variable.sizes}).transpose(*AXES, *last).values

    scalars, coordinates = ({name: along(name) for name in each} for each in (names, PLACE))
    vectors = {name: along(name, f"{name}_entry") for name in ("solref", "solimp") if name in dataset}
    for place in np.ndindex(grid.shape):
        if np.isnan(scalars["residual"][place]):
            continue  # not computed
        numbers: dict[str, Any] = {name: values[place].item() for name, values in scalars.items()}
        for name in ("alpha", "epsilon", "discrepancy", *ONSETS):
            if name not in numbers or math.isnan(numbers[name]):
                numbers[name] = None
        counts = [name for name in numbers if GRADIENTS[name].digits == 0 and numbers[name] is not None]
        numbers |= {name: int(numbers[name]) for name in counts}
        at = {name: values[place] for name, values in coordinates.items()}
        at = {name: value.item() if isinstance(value, np.generic) else value for name, value in at.items()}
        solver = {name: tuple(values[place].tolist()) for name, values in vectors.items()}
        rows.append(Row(**at, **solver, **numbers))
    return rows


def remains(name: str, value: float, debiased: float, error: float) -> str:
    """Format what remains of one of `DEBIASED` without noise: a bound if no error is detected, "-" if noise explains
    all of it, or if nothing is left and the standard error is unknown."""
    best = 1.0 if name == "cosine" else 0.0
    if math.isnan(debiased) or (debiased == best and math.isnan(error)):
        return "-"
    if not (debiased == best and 0 < error < math.inf):
        return with_error(debiased, error)
    if abs(debiased - value) <= 2 * error:
        return "-"
    decimals = 2 if error >= 0.005 else 4
    above = best - math.ceil(10**decimals * 2 * error) / 10**decimals
    return f"< {number(2 * error, 2)}" if best == 0 else f"> {above:.{decimals}f}"


@np.errstate(over="ignore", invalid="ignore")  # numbers of a motion that explodes
def findings_of(dataset: xr.Dataset) -> list[str]:
    """Return the findings supported by a study's intervals, as sentences; none if no cell is computed."""
    if not dataset.data_vars:
        return []
    kind = json.loads(dataset.attrs["config"])["kind"]
    return {"gradients": _of_gradients, "descents": _of_descents, "landscapes": _of_landscapes}[kind](dataset)


def _of_gradients(dataset: xr.Dataset) -> list[str]:
    """Report where FoBG's variance exceeds ZoBG's and which means are biased."""
    gammas, confidence = gammas_of(dataset), json.loads(dataset.attrs["config"])["confidence"]
    label = partial(label_in, dataset)

    def of(rows: Sequence[Row]) -> list[str]:
        found = [*_variance_finding(rows, confidence, label), *_bias_findings(rows, gammas, label)]
        return [*found, *_onset_findings(rows), *_meaningless(rows, gammas, label)]

    return _by_family(dataset, rows_of(dataset), of)


def _of_descents(dataset: xr.Dataset) -> list[str]:
    """Report where the first-order batch of an AoBG with a bound has no weight in any iteration of any seed."""
    if "alpha" not in dataset:
        return []
    gammas, along = gammas_of(dataset), ("iteration", "seed")
    stuck = (dataset["alpha"].max(along) == 0).stack(place=(*SETTING, "model", "estimator"))
    names = (*SETTING, "contact", "stiffness", "estimator")
    rows = [Row(**{name: one[name].item() for name in names}) for one in stuck[stuck.values]]
    bound = [row for row in rows if gammas.get((row.task, row.estimator), math.inf) < math.inf]

    def of(rows: Sequence[Row]) -> list[str]:
        groups = [(label_in(dataset, name), same) for (name,), same in _by(rows, "estimator").items()]
        return [f"{label} equals ZoBG throughout{_at(same)}: {WEIGHTLESS}" for label, same in groups]

    return _by_family(dataset, bound, of)


def _by_family(dataset: xr.Dataset, rows: Iterable[Row], of: Callable[[list[Row]], list[str]]) -> list[str]:
    """Sentences about the rows of each contact family, led by the coordinates in `SETTING` that vary."""
    sentences, varied = [], [name for name in SETTING if dataset.sizes[name] > 1]
    for setting, alike in _by(rows, *SETTING).items():
        told = [_setting(name, value) for name, value in zip(SETTING, setting, strict=True) if name in varied]
        for (family,), part in _by(alike, "contact").items():
            sentences += [f"{', '.join([*told, family])}: {sentence}" for sentence in of(part)]
    return sentences


def _by(rows: Iterable[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by some of their variables, in the order of the first ones."""
    groups: dict[tuple[Any, ...], list[Row]] = defaultdict(list)
    for row in rows:
        groups[tuple(getattr(row, name) for name in names)].append(row)
    return groups


def _setting(name: str, value: Any) -> str:
    text = f"{value:.3g}" if isinstance(value, float) else str(value)
    return text if name in ("task", "cone") else f"{name} {text}"


Bounds = Mapping[tuple[str, str], float]
"""Accuracy bound gamma by task and estimator, of the estimators that have one; may be infinite."""


def gammas_of(dataset: xr.Dataset) -> Bounds:
    resolved = zip(dataset["task"].values.tolist(), json.loads(dataset.attrs["resolved"]), strict=True)
    return {
        (task, estimator): float(options["gamma"])
        for task, entry in resolved
        for estimator, options in entry["estimators"].items()
        if "gamma" in options
    }


def onset_of(dataset: xr.Dataset) -> str:
    """Onset term of a study's first-order batches."""
    return json.loads(dataset.attrs["config"]).get("onset", "none")


def estimators_of(dataset: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Label and needs of each estimator of a study, by name, as its plan recorded them."""
    return json.loads(dataset.attrs.get("described", "{}"))


def label_in(dataset: xr.Dataset, name: str) -> str:
    """Label of an estimator in texts and figures of a study; a user-defined one has that which its plan recorded."""
    known = {} if name in ESTIMATORS else estimators_of(dataset).get(name, {})
    return known.get("label") or label_of(name, onset_of(dataset))


def differentiates(estimator: str) -> bool:
    """Whether an estimator uses first-order samples, which may be biased; user-defined ones may."""
    return estimator not in ESTIMATORS or any(ORACLES[oracle].order for oracle in ESTIMATORS[estimator].needs)


def _meaningless(rows: Sequence[Row], gammas: Bounds, label: Callable[[str], str]) -> list[str]:
    """Report why results mean nothing: contact never active, reference too uncertain, AoBG's bound below epsilon."""
    found = []
    several = [group for group in _by(rows, "estimator", "seed").values() if len(group) > 1]
    numbers = [[(row.gradient_norm, row.variance) for row in group] for group in several]
    if numbers and all(np.allclose(each, each[0], rtol=1e-12, atol=0, equal_nan=True) for each in numbers):
        found.append("nothing depends on K: the contact whose stiffness is swept was never active")
    if unsure := [row for row in rows if row.reference_uncertainty > MOST_UNCERTAINTY]:
        found.append(
            f"the reference's own uncertainty exceeds {percent(MOST_UNCERTAINTY)}{_at(unsure)}: errors and verdicts "
            "mean little there; increase --reference-samples"
        )
    limited = [row for row in rows if row.epsilon is not None]
    if bound := [row for row in limited if row.epsilon > gammas.get((row.task, row.estimator), math.inf)]:
        found += [f"{label(name)} equals ZoBG{_at(same)}: {BOUND}" for (name,), same in _by(bound, "estimator").items()]
    return found


def _variance_finding(rows: Sequence[Row], confidence: float, label: Callable[[str], str]) -> list[str]:
    """Compare FoBG's variance with ZoBG's at each stiffness: the verdict shared by all seeds, if most have one."""
    groups: dict[str, list[Row]] = {verdict: [] for verdict in (BELOW, ABOVE, ALIKE, UNKNOWN)}
    for _, same in sorted(_by(rows, "stiffness").items()):
        zeroth, first = ([row for row in same if row.estimator == name] for name in ("zobg", "fobg"))
        if not zeroth or not first:
            return []
        verdicts = [_order(*pair) for pair in zip(zeroth, first, strict=True)]
        known = [verdict for verdict in verdicts if verdict != UNKNOWN]
        shared = known[0] if len(set(known)) == 1 else ALIKE
        groups[shared if 2 * len(known) > len(verdicts) else UNKNOWN] += first
    parts = [f"{verdict}{_at(group)}" for verdict, group in groups.items() if group]
    return [f"{label('fobg')}'s variance is {'; '.join(parts)} ({percent(confidence)} intervals)"]


def _order(zeroth: Row, first: Row) -> str:
    if not (zeroth.believable and first.believable):
        return UNKNOWN
    if first.variance_upper < zeroth.variance_lower:
        return BELOW
    return ABOVE if first.variance_lower > zeroth.variance_upper else ALIKE


def _bias_findings(rows: Sequence[Row], gammas: Bounds, label: Callable[[str], str]) -> list[str]:
    """Report means farther from the reference than any draw of the test, or off but undecided, in a sentence each; with
    several seeds, with counts and the median debiased error."""
    sentences = []
    for (estimator,), mine in _by((row for row in rows if differentiates(row.estimator)), "estimator").items():
        seeds = len(_by(mine, "seed"))
        biased = [row for row in mine if row.bias_verdict == "biased"]
        off = [row for row in mine if row.bias_verdict == "too few effective samples" and _off(row)]
        mean = f"{label(estimator)}'s mean is"
        if biased:
            shares = ", ".join(f"{_share(same)}{_of(same, seeds)}" for same in _by(biased, "stiffness").values())
            least = max(row.bias_p_value for row in biased)
            free = math.isinf(gammas.get((biased[0].task, estimator), 0.0))
            advice = ": it has no accuracy bound; set one with --gamma" if free else ""
            sentences.append(f"{mean} biased by {shares} (p <= {least:.3f}){advice}")
        for same in _by(off, "stiffness").values():
            fewest = [min(row.effective_samples, row.reference_effective_samples) for row in same]
            held = f"{min(fewest):.1f}" if all(row.effective_samples for row in same) else "all equal"
            sentences.append(
                f"{mean} off by {_share(same)}{_of(same, seeds)}, from bias or lack of rare samples: "
                f"too few effective samples ({held})"
            )
    return sentences


def linear_error(strength: float) -> str:
    """Describe how large the linear onset term's error can be."""
    if strength > MOST_STRENGTH:
        return "the linear onset term can leave more than it adds"
    return f"the linear onset term can be off by {percent(ERROR_PER_STRENGTH * strength)} of what it adds"


def _onset_findings(rows: Sequence[Row]) -> list[str]:
    """Report where the onset term may be off: either kind if noise is narrow, else the linear one at long timesteps."""
    found, corrected = [], [row for row in rows if row.onsets]
    if narrow := [row for row in corrected if row.onset_spread < LEAST_SPREAD]:
        least = min(row.onset_spread for row in narrow)
        found.append(
            f"the onset term may be off{_at(narrow)}, since the noise is narrow: the step at which "
            f"contact begins has a standard deviation of {least:.2g}, and {LEAST_SPREAD} generally suffices; use a "
            "smaller timestep or a larger --sigma, or check the mean (gradcheck --mean)"
        )
    wide = [row for row in corrected if not row.onset_spread < LEAST_SPREAD]
    if strong := [row for row in wide if ERROR_PER_STRENGTH * row.onset_strength > NOTABLE_SHARE]:
        most = max(row.onset_strength for row in strong)
        found.append(
            f"{linear_error(most)}{_at(strong)} (more at grazing contacts and corners): an onset takes {percent(most)} "
            "of the approach speed in one step; --onset jump or a smaller timestep is better"
        )
    return found


def _off(row: Row) -> bool:
    return row.bias_p_value <= BIASED_P_VALUE or row.debiased_error > OFF_SE * row.debiased_error_se


def _of(rows: Sequence[Row], seeds: int) -> str:
    """Where rows are, and how many of the seeds they are."""
    return _at(rows) + (f" in {len(rows)} of {seeds} seeds" if seeds > 1 else "")


def _share(rows: Sequence[Row]) -> str:
    """Median debiased error as a share of the reference gradient, to significant digits only."""
    share = float(np.median([row.debiased_error for row in rows]))
    error = max(max(row.debiased_error_se, row.reference_uncertainty) for row in rows)
    if not math.isfinite(share):
        return "more than can be computed"
    return percent(share, 1) if error < 0.005 else f"{float(f'{100 * share:.2g}'):g} %"


def _at(rows: Sequence[Row]) -> str:
    """Format the stiffnesses of rows for a sentence; empty without contact."""
    stiffnesses = list(dict.fromkeys(row.stiffness for row in rows))
    digits = digits_to_tell_apart(stiffnesses, least=4)
    rounded = (float(f"{value:.{digits}g}") for value in stiffnesses)
    return f" at K = {', '.join(f'{value:.{digits + 2}g}' for value in rounded)} N/m" if any(stiffnesses) else ""


def _of_landscapes(dataset: xr.Dataset) -> list[str]:
    """Report where the mean of FoBG differs from the slope of the mean cost."""
    both = {"zobg", "fobg"} <= set(dataset["estimator"].values)
    name = label_of("fobg", onset_of(dataset))
    return [f"{label}: {_gap(one, f'E[{name}]')}" for label, one in curves_of(dataset)] if both else []


def curves_of(dataset: xr.Dataset) -> list[tuple[str, xr.Dataset]]:
    """Computed cells of a study of landscapes: contact model, and its numbers along the line."""
    outer = (*SETTING, "model")
    places = np.ndindex(*(dataset.sizes[name] for name in outer))
    cells = [dataset.isel(dict(zip(outer, place, strict=True))) for place in places]
    return [(model_name(one), one) for one in cells if bool(one["position"].notnull().any())]


def model_name(one: xr.Dataset) -> str:
    """Contact family of a part of a study with one contact model, and its stiffness if it has one."""
    family = one["contact"].item()
    stiffness = one["model"].item().removeprefix(family)
    return f"{family}, K ={stiffness} N/m" if stiffness else family


def line_of(dataset: xr.Dataset) -> tuple[str, str]:
    """Symbol of the position along a landscape's line, and its unit, empty if it is not known."""
    unit = dataset["position"].attrs.get("units", THETA)
    return "t" if dataset.attrs["many_parameters"] else "theta", "" if unit == THETA else unit


def _gap(one: xr.Dataset, mean: str) -> str:
    """Report where the mean of FoBG differs from the slope of the mean cost, by quadrature if available."""
    if "exact_slope" in one and bool(one["exact_slope"].notnull().all()):
        first, slope = one["exact_first"].values, one["exact_slope"].values
        largest = float(np.max(np.abs(slope)))
        error = 3 * (one["exact_slope_error"].values + one["exact_first_error"].values) + NOTABLE_SHARE * largest
        source, uncertainty = "the mean cost's slope", f"more than {percent(NOTABLE_SHARE)} of its largest value"
    else:
        first, slope = (one["slope"].sel(estimator=name).values for name in ("fobg", "zobg"))
        error = DETECTED_SE * np.hypot(*(one["slope_se"].sel(estimator=name).values for name in ("fobg", "zobg")))
        source, uncertainty = "E[ZoBG]", f"more than {DETECTED_SE:g} standard errors"
    seen = np.abs(first - slope) > error
    if not np.any(seen):
        return f"{mean} nowhere differs from {source} by {uncertainty}"
    name, unit = line_of(one)
    unit = f" {unit}" if unit else ""
    worst = int(np.argmax(np.where(seen, np.abs(first - slope), -np.inf)))
    return (
        f"{mean} differs from {source} by {uncertainty} at {percent(float(np.mean(seen)))} of the points, most at "
        f"{name} = {one['position'].values[worst]:.3g}{unit}, where it is {first[worst]:.3g} in place of "
        f"{slope[worst]:.3g}"
    )
