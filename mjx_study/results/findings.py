"""Findings that the intervals of gradient estimates and the weights of descents support, as sentences."""

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any, Final

import numpy as np
import xarray as xr

from estimators import ESTIMATORS, ORACLES
from mjx_study.results.rows import BIASED_P_VALUE, SETTING, Row, label_in, rows_of
from mjx_study.table import digits_to_tell_apart, grouped, percent, with_error

OFF_SE: Final = 4.0  # standard errors beyond which a mean without a verdict is reported as off
NOTABLE_SHARE: Final = 0.05
"""Share of the largest slope beyond which a difference free of sampling error is reported."""
MOST_UNCERTAINTY: Final = 0.2  # relative uncertainty beyond which a reference is too imprecise to judge errors
ERROR_PER_STRENGTH: Final = 0.5
"""Error of the linear onset term's mean, as a share of what the term adds, over the onset strength. Among 11 contact
models on momentum_transfer and ball_wall the largest was 0.26; at random thetas the atlas has larger ones, at grazing
contacts, at corners, or where an onset is stronger than `MOST_STRENGTH`."""
MOST_STRENGTH: Final = 0.9
"""Onset strength up to which `ERROR_PER_STRENGTH` holds; where an onset removes more of the approach speed in one step,
the linear term's error can exceed the term. Fitted to half of the atlas's cells on momentum_transfer; right for 59 of
the other 61."""
LEAST_SPREAD: Final = 0.75
"""Standard deviation of the first onset's step from which an onset term is accurate to 1.5 % of what it adds; at 0.5
it can be off by 60 %."""
BELOW, ABOVE, ALIKE = "below ZoBG's", "above ZoBG's", "not significantly different from ZoBG's"
UNKNOWN: Final = "not comparable with ZoBG's (too few effective samples)"
"""Verdicts on FoBG's variance."""
BOUND: Final = "its bound gamma is below epsilon, the radius of ZoBG's mean; increase --gamma or --samples"
ABOVE_START: Final = "use a lower --learning-rate, or check by diagnose whether the mean is right"
WEIGHTLESS: Final = (
    "alpha is 0 in every iteration, usually because its bound gamma is below epsilon, the radius of ZoBG's mean (then "
    "increase --gamma or --samples), else since no first-order variance is finite"
)
"""Why AoBG equals ZoBG: known of a batch, whose epsilon is kept, and supposed of a descent."""


def gradient_findings(dataset: xr.Dataset) -> list[str]:
    """Report where FoBG's variance exceeds ZoBG's and which means are biased."""
    gammas, confidence = gammas_of(dataset), json.loads(dataset.attrs["config"])["confidence"]
    label = partial(label_in, dataset)

    def of(rows: Sequence[Row]) -> list[str]:
        found = [*_variance_finding(rows, confidence, label), *_bias_findings(rows, gammas, label)]
        return [*found, *_onset_findings(rows), *_meaningless(rows, gammas, label)]

    return _by_family(dataset, rows_of(dataset), of)


def descent_findings(dataset: xr.Dataset) -> list[str]:
    """Report descents that end above their start, and where the first-order batch of an AoBG with a bound has no weight
    in any iteration of any seed."""

    def places(where: xr.DataArray) -> list[Row]:
        names = (*SETTING, "contact", "stiffness", "estimator")
        stacked = where.stack(place=(*SETTING, "model", "estimator"))
        return [Row(**{name: one[name].item() for name in names}) for one in stacked[stacked.values]]

    def ended_above(rows: Sequence[Row]) -> list[str]:
        labels = dict.fromkeys(label_in(dataset, row.estimator) for row in rows)
        verb = "ends" if len(labels) == 1 else "end"
        return [f"{', '.join(labels)} {verb} above the start{_at(rows)}: {ABOVE_START}"]

    def weightless(rows: Sequence[Row]) -> list[str]:
        groups = [(label_in(dataset, name), same) for (name,), same in _by(rows, "estimator").items()]
        return [f"{label} equals ZoBG throughout{_at(same)}: {WEIGHTLESS}" for label, same in groups]

    gammas, found = gammas_of(dataset), []
    error = np.hypot(dataset["final_cost_se"].max("seed"), dataset["start_cost_se"])
    above = dataset["final_cost"].mean("seed") - dataset["start_cost"] > OFF_SE * error
    found += _by_family(dataset, places(above), ended_above)
    if "alpha" in dataset:
        stuck = places(dataset["alpha"].max(("iteration", "seed")) == 0)
        bound = [row for row in stuck if gammas.get((row.task, row.estimator), math.inf) < math.inf]
        found += _by_family(dataset, bound, weightless)
    return found


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
    return grouped(rows, lambda row: tuple(getattr(row, name) for name in names))


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


def differentiates(estimator: str) -> bool:
    """Whether an estimator uses first-order samples, which may be biased; user-defined ones may."""
    return estimator not in ESTIMATORS or any(ORACLES[oracle].order for oracle in ESTIMATORS[estimator].needs)


def _meaningless(rows: Sequence[Row], gammas: Bounds, label: Callable[[str], str]) -> list[str]:
    """Report why results mean nothing: contact never active, reference too uncertain, AoBG's bound below epsilon."""
    found = []
    several = [group for group in _by(rows, "estimator", "seed").values() if len(group) > 1]
    numbers = [[(row.gradient_norm, row.variance) for row in group] for group in several]
    if numbers and all(np.allclose(each, each[0], rtol=1e-12, atol=0, equal_nan=True) for each in numbers):
        found.append("nothing depends on K: the swept contact never acts, or not on what the cost reads")
    if unsure := [row for row in rows if row.reference_uncertainty > MOST_UNCERTAINTY]:
        found.append(
            f"the reference's own uncertainty exceeds {percent(MOST_UNCERTAINTY)}{_at(unsure)}: errors and shares "
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
    """Report means that are biased, or off but undecided; with several seeds, counts and median debiased error."""
    sentences = []
    for (estimator,), mine in _by((row for row in rows if differentiates(row.estimator)), "estimator").items():
        seeds = len(_by(mine, "seed"))
        biased = [row for row in mine if row.bias_verdict == "biased"]
        off = [row for row in mine if row.bias_verdict == "too few effective samples" and _off(row)]
        mean = f"{label(estimator)}'s mean is"
        if biased:
            alike = grouped(_by(biased, "stiffness").values(), lambda rows, of=seeds: (_share(rows), _often(rows, of)))
            shares = ", ".join(f"{share}{_at(chain(*same))}{often}" for (share, often), same in alike.items())
            least = max(row.bias_p_value for row in biased)
            free = math.isinf(gammas.get((biased[0].task, estimator), 0.0))
            advice = ": it has no accuracy bound; set one with --gamma" if free else ""
            sentences.append(f"{mean} biased by {shares} (p <= {least:.3f}){advice}")
        for same in _by(off, "stiffness").values():
            fewest = [min(row.effective_samples, row.reference_effective_samples) for row in same]
            held = f"{min(fewest):.1f}" if all(row.effective_samples for row in same) else "all equal"
            sentences.append(
                f"{mean} off by {_share(same)}{_at(same)}{_often(same, seeds)}, from bias or lack of rare samples: "
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
    found, corrected = [], [row for row in rows if row.onsets and row.onset_spread is not None]
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
            "of the approach speed in one step; --onset shift or a smaller timestep is better"
        )
    return found


def _off(row: Row) -> bool:
    return row.bias_p_value <= BIASED_P_VALUE or row.debiased_error > OFF_SE * row.debiased_error_se


def _often(rows: Sequence[Row], seeds: int) -> str:
    """How many of the seeds rows are."""
    return f" in {len(rows)} of {seeds} seeds" if seeds > 1 else ""


def _share(rows: Sequence[Row]) -> str:
    """Median debiased error as a share of the reference gradient with one standard error, if that is known."""
    if any(row.reference_uncertainty > MOST_UNCERTAINTY for row in rows):
        return "an unknown share"
    share = float(np.median([row.debiased_error for row in rows]))
    error = max(row.debiased_error_se for row in rows)
    if not math.isfinite(share):
        return "more than can be computed"
    return f"{with_error(100 * share, 100 * error)} %"


def _at(rows: Iterable[Row]) -> str:
    """Format the stiffnesses of rows for a sentence; empty without contact."""
    stiffnesses = list(dict.fromkeys(row.stiffness for row in rows))
    digits = digits_to_tell_apart(stiffnesses, least=4)
    rounded = (float(f"{value:.{digits}g}") for value in stiffnesses)
    return f" at K = {', '.join(f'{value:.{digits + 2}g}' for value in rounded)} N/m" if any(stiffnesses) else ""
