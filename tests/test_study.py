"""Comparisons: what is shared, what is compiled, what the findings say, what a plan refuses."""

import json
import math
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import xarray as xr

import mjx_study.report  # noqa: F401  # registers `Dataset.mjx_study`, which no other import here does
from estimators import AlphaOrder, Differentiation, DiscontinuityGated, FirstOrder, GradientEstimate, summarise
from estimators.registry import label_of
from mjx_study.cli import console
from mjx_study.cli.studies import as_document
from mjx_study.execution.run import run_study
from mjx_study.experiment import tally
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import StudyError, estimators_of
from mjx_study.experiment.tally import onset_numbers
from mjx_study.objective import BlankObjective, MjxObjective
from mjx_study.options.configuration import StudyConfig
from mjx_study.plots.panels import limit
from mjx_study.results.kind import findings_of
from mjx_study.results.rows import remains, rows_of
from mjx_study.results.variables import GRADIENTS
from mjx_study.results.warnings import warnings_of
from mjx_study.storage.dataset import dataset_of
from mjx_study.tasks import make_task
from mjx_study.tasks.task import StudyDefaults
from tests.documents import study_document

pytestmark = pytest.mark.usefixtures("shared_programs")

SMALL: dict[str, Any] = {"horizon": 4, "samples": (8,), "reference_samples": 8, "seeds": 1}


def config(**changes: Any) -> StudyConfig:
    chosen: dict[str, Any] = {"tasks": ("pusher",)} | SMALL | changes
    return StudyConfig(**chosen)


def compare(**changes: Any) -> xr.Dataset:
    return run_study(config(**changes))


def row(estimator: str, stiffness: float, variance: float, **changes: Any) -> dict[str, Any]:
    """Numbers of a made-up study, with an interval of a factor of two either way."""
    values: dict[str, Any] = {name: 0.0 for name in GRADIENTS if name not in ("gradient", "reference")}
    values |= {"alpha": math.nan, "epsilon": math.nan, "discrepancy": math.nan, "residual": 1e-15}
    values |= {"variance": variance, "variance_lower": variance / 2, "variance_upper": 2 * variance}
    values |= {"reference_uncertainty": 0.01, "relative_error": 0.01, "cosine": 1.0, "gradient_norm": 10.0}
    values |= {"bias_p_value": 0.5, "effective_samples": 30.0, "top_share": 0.1, "reference_effective_samples": 300.0}
    values |= {"debiased_error": changes.get("relative_error", 0.01), "debiased_cosine": 1.0, "reference_norm": 10.0}
    return {"estimator": estimator, "stiffness": float(stiffness)} | values | changes


def result(*rows: dict[str, Any], gamma: float | str = 1e8) -> xr.Dataset:
    """A study of those rows, under penalty contact."""
    names = list(dict.fromkeys(each["estimator"] for each in rows))
    stiffnesses = list(dict.fromkeys(each["stiffness"] for each in rows))
    document = study_document(len(stiffnesses), estimators=names, tasks=["pusher"], confidence=0.95, samples=[100])
    document["config"] |= {"seed": 0, "reference_samples": 600}
    document["environment"] |= {"precision": "float64"}
    document["axes"] |= {"task": ["pusher"], "timestep": [0.01], "samples": [100]}
    document["axes"] |= {"model": [f"penalty {stiffness:g}" for stiffness in stiffnesses]}
    document["models"] = [{"contact": "penalty", "stiffness": stiffness} for stiffness in stiffnesses]
    document["resolved"][0] |= {"estimators": {"aobg": {"gamma": gamma}}}
    cells = {}
    for index, stiffness in enumerate(stiffnesses):
        here = {each["estimator"]: each for each in rows if each["stiffness"] == stiffness}
        arrays = {"solref": np.array([-stiffness / 0.05, 0.0])}
        for name, variable in GRADIENTS.items():
            values = np.array([here[each][name] if each in here else math.nan for each in names if name in rows[0]])
            if name in rows[0]:
                wanted = {(): values[:1].reshape(()), ("estimator",): values}
                arrays[name] = wanted.get(variable.dims, values[None])
        cells[index] = (arrays, {})
    return dataset_of(document, cells)


@pytest.fixture(scope="module")
def spied() -> tuple[xr.Dataset, dict[str, list[np.ndarray]]]:
    """A sweep over three stiffness values in two families: its result, and the keys of each batch."""
    keys: dict[str, list[np.ndarray]] = {"evaluate": [], "differentiate": []}

    def spy(name: str):
        method = getattr(MjxObjective, name)

        def recorded(self, theta, batch):
            if not isinstance(self, BlankObjective):
                keys[name].append(np.asarray(jax.random.key_data(batch)))
            return method(self, theta, batch)

        return recorded

    with pytest.MonkeyPatch.context() as patch:
        for name in keys:
            patch.setattr(MjxObjective, name, spy(name))
        return compare(stiffness=(10.0, 100.0, 1000.0), contact=("penalty", "mujoco"), chunk_size=4), keys


def test_batches_are_independent_and_the_same_in_every_cell(spied) -> None:
    _, keys = spied
    zeroth, first = keys["evaluate"][1:], keys["differentiate"][1:]  # the first call of each only compiles
    assert len(zeroth) == 6 and len(first) == 13  # FoBG and control variate of each cell, and of the softest contact
    first = [first[0], *first[2:]]
    for batch in zeroth:
        np.testing.assert_array_equal(batch, zeroth[0])
    pools = [{tuple(key) for key in batch} for batch in (zeroth[0], first[0], first[1])]
    assert all(len(pool) == len(batch) for pool, batch in zip(pools, (zeroth[0], first[0], first[1]), strict=True))
    assert not (pools[0] & pools[1] or pools[0] & pools[2] or pools[1] & pools[2])


def test_an_alpha_order_row_follows_from_the_other_two(spied) -> None:
    found, _ = spied
    table = {(row.contact, row.stiffness, row.estimator): row for row in rows_of(found)}
    means = found["gradient"].isel(task=0, timestep=0, cone=0, sigma=0, samples=0, seed=0)
    for index, (family, stiffness) in enumerate(dict.fromkeys(key[:2] for key in table)):
        zeroth, first, both = (table[family, stiffness, which] for which in ("zobg", "fobg", "aobg"))
        assert both.alpha == pytest.approx(zeroth.variance / (zeroth.variance + first.variance), rel=1e-9)
        mixed = both.alpha**2 * first.variance + (1 - both.alpha) ** 2 * zeroth.variance
        assert both.variance == pytest.approx(mixed, rel=1e-9)
        mean = {name: means.isel(model=index).sel(estimator=name).values for name in ("zobg", "fobg", "aobg")}
        expected = both.alpha * mean["fobg"] + (1 - both.alpha) * mean["zobg"]
        np.testing.assert_allclose(mean["aobg"], expected, rtol=1e-9, atol=1e-12)
        assert both.seconds_per_sample == pytest.approx(zeroth.seconds_per_sample + first.seconds_per_sample)


class Half(FirstOrder):
    """Half of the first-order gradient."""

    name = "half"

    def combine(self, *batches: Differentiation) -> GradientEstimate:
        (differentiation,) = batches
        return summarise(differentiation.gradient / 2)


def test_estimators_as_objects_have_their_own_options(tmp_path: Path) -> None:
    """And what a folder holds of them is compared by content."""
    chosen = {"contact": ("reference",), "horizon": 3, "samples": (20,), "seeds": 3}
    named = compare(estimators=("fobg", "aobg"), gamma=3.0, **chosen)
    own = config(estimators=("fobg", AlphaOrder(gamma=3.0), Half()), **chosen)
    given = run_study(own, tmp_path)
    assert given.estimator.values.tolist() == ["fobg", "aobg", f"{__name__}:Half"]
    assert json.loads(given.attrs["resolved"])[0]["estimators"]["aobg"]["gamma"] == 3.0
    for name in ("gradient", "relative_error", "alpha"):
        np.testing.assert_array_equal(given[name].isel(estimator=slice(2)), named[name], name)
    np.testing.assert_allclose(given.gradient.isel(estimator=2), given.gradient.isel(estimator=0) / 2)
    run_study(own, tmp_path)
    with pytest.raises(StudyError, match="estimator aobg differs"):
        run_study(config(estimators=("fobg", AlphaOrder(gamma=4.0), Half()), **chosen), tmp_path)
    with pytest.raises(ValueError, match="'ddcg' holds for another sigma"):
        plan_study(config(estimators=(DiscontinuityGated(sigma=7.0),), **chosen))
    with pytest.raises(ValueError, match="`estimators` has aobg twice"):
        config(estimators=("aobg", AlphaOrder()), **chosen)


LOUD: dict[str, Any] = {"relative_error": 0.44, "debiased_error_se": 0.03, "bias_p_value": 0.001}
EVENTS = {"onsets": 100.0, "onset_spread": 2.0, "onset_strength": 0.1}
VARIANCES = [(10, 1), (100, 150), (1000, 1e6)]
SAME = [row(name, stiffness, variance) for stiffness in (10, 100) for name, variance in (("zobg", 5.0), ("fobg", 1.0))]


def fobg(**changes: Any) -> list[dict[str, Any]]:
    return [row("fobg", 10, 1, **changes)]


def term(**changes: Any) -> list[dict[str, Any]]:
    return [row("fobg_onset", 10, 1, **EVENTS | changes)]


FINDINGS: dict[str, tuple[list[dict[str, Any]], list[str]]] = {
    "intervals": (
        [row(name, k, each) for k, first in VARIANCES for name, each in (("zobg", 100), ("fobg", first))],
        ["below ZoBG's at K = 10 N/m; above ZoBG's at K = 1000 N/m; not .* different from ZoBG's at K = 100 N/m"],
    ),
    "few samples vary little": (
        [row("zobg", 10, 100), *fobg(effective_samples=2.0, debiased_error_se=0.01)],
        ["FoBG's variance is not comparable with ZoBG's .too few effective samples. at K = 10 N/m"],
    ),
    "what noise explains": (fobg(relative_error=0.044, bias_p_value=0.002), []),
    "bias": (fobg(relative_error=0.044, bias_p_value=0.001), ["biased by 4.4 ± 0 % at K = 10"]),
    "large bias": (fobg(relative_error=16.95, bias_p_value=0.001), ["biased by 1700 ± 0 %"]),
    "no bound": ([row("aobg", 10, 1, **LOUD)], ["biased by 44.0 ± 3.0 % .*: it has no accuracy bound; set one with"]),
    "onset term": ([row("fobg_onset", 10, 1, **LOUD)], ["FoBG .onset.'s mean is biased by 44.0 ± 3.0 %"]),
    "beyond computing": (fobg(relative_error=math.nan, bias_p_value=0.001), ["biased by more than can be computed"]),
    "unknown reference": (
        fobg(**LOUD, debiased_error=6.2, reference_uncertainty=0.6),
        ["biased by an unknown share", "the reference's own uncertainty exceeds"],
    ),
    "few samples": (fobg(**LOUD, effective_samples=1.9), ["off by 44.0 ± 3.0 %.*few effective samples .1.9."]),
    "equal samples": (
        fobg(**LOUD | {"bias_p_value": math.nan}, effective_samples=0.0, top_share=math.nan),
        ["too few effective samples .all equal.$"],
    ),
    "few samples that agree": (fobg(debiased_error=0.01, debiased_error_se=0.01, effective_samples=0.0), []),
    "no contact": (SAME, ["FoBG's variance", "nothing depends on K: the swept contact never acts"]),
    "little contact": ([*SAME[:3], row("fobg", 100, 1.001)], ["FoBG's variance"]),
    "unsure reference": (fobg(reference_uncertainty=0.25), ["the reference's own uncertainty exceeds 20 %"]),
    "bound below the radius": (
        [row("aobg", 10, 1.0, alpha=0.0, epsilon=7.0, discrepancy=1.0)], ["AoBG equals ZoBG at K = 10 N/m"],
    ),
    "bound above the radius": ([row("aobg", 10, 1.0, alpha=0.3, epsilon=7.0, discrepancy=1.0)], []),
    "soft onsets": (term(), []),
    "onsets without a term": (term(onset_spread=math.nan, onset_strength=math.nan), []),
    "narrow noise": (term(onset_spread=0.4), ["may be off .*noise is narrow"]),
    "narrow noise, strong onsets": (term(onset_spread=0.4, onset_strength=0.25), ["may be off .*noise is narrow"]),
    "strong onsets": (term(onset_strength=0.25), ["can be off by 12 % of what it adds"]),
    "stronger onsets": (term(onset_strength=1.2), ["can leave more than it adds"]),
}  # fmt: skip
"""Rows, and what each finding says."""
BOUNDS = {"no bound": "inf", "bound below the radius": 5.0, "bound above the radius": 9.0}
"""Bounds of AoBG, if not 1e8."""


@pytest.mark.parametrize("name", FINDINGS)
def test_findings(name: str) -> None:
    rows, says = FINDINGS[name]
    found = findings_of(result(*rows, gamma=BOUNDS.get(name, 1e8)))
    assert all(re.search(f"^penalty: .*{part}", each) for part, each in zip(says, found, strict=True)), found


def test_verdicts_on_a_bias() -> None:
    few = "too few effective samples"
    samples = (FINDINGS[f"{name} samples"][0] for name in ("few", "equal"))
    made_up = [row("fobg", 10, 1)], [row("fobg", 10, 1, **LOUD)], *samples
    assert [rows_of(result(*each))[0].bias_verdict for each in made_up] == ["none seen", "biased", few, few]
    doubtful = result(row("fobg", 10, 1, **LOUD, reference_effective_samples=2.0))
    assert as_json(doubtful)["rows"][0]["bias_verdict"] == few


def test_onsets_without_a_term_are_counted_and_say_nothing_else() -> None:
    """Missed as all of a rollout's may be, which then has neither a first step nor a strength."""
    begun, missed, none = [1, 1, 0, 0.3, 50, 0], [3, 0, 3, 0, math.nan, 0], [0, 0, 0, 0, math.nan, 0]
    whole = onset_numbers(np.array([begun, missed, begun[:4] + [60, 0], none], float))
    np.testing.assert_allclose(whole, [5, 2, 3, 0.3, 5, 0], rtol=1e-15)
    np.testing.assert_array_equal(onset_numbers(np.array([missed, none], float)), [3, 0, 3, math.nan, math.nan, 0])


def joined(dimension: str, values: list[Any], parts: list[xr.Dataset]) -> xr.Dataset:
    """Studies that differ in one dimension, as one."""
    along = [part.assign_coords({dimension: [value]}) for part, value in zip(parts, values, strict=True)]
    return xr.concat(along, dimension, data_vars="minimal", coords="minimal", compat="override")


def test_seeds_are_counted_and_not_repeated() -> None:
    shares, p_values = (0.02, 0.03, 0.044), (0.001, 0.001, 0.4)
    rows = [row("fobg", 10, 1, relative_error=share, bias_p_value=p) for share, p in zip(shares, p_values, strict=True)]
    parts = [result(row("zobg", 10, variance), each) for each, variance in zip(rows, (100, 100, 1), strict=True)]
    assert findings_of(joined("seed", [0, 1, 2], parts)) == [
        "penalty: FoBG's variance is not significantly different from ZoBG's at K = 10 N/m (95 % intervals)",
        "penalty: FoBG's mean is biased by 2.5 ± 0 % at K = 10 N/m in 2 of 3 seeds (p <= 0.001)",
    ]
    below = joined("seed", [0, 1], parts[:2])
    assert findings_of(below)[0] == "penalty: FoBG's variance is below ZoBG's at K = 10 N/m (95 % intervals)"


def test_a_label_has_the_onset_term() -> None:
    labels = {
        ("fobg", "none"): "FoBG", ("fobg", "linear"): "FoBG (onset)", ("fobg_onset", "linear"): "FoBG (onset)",
        ("fobg_clipped", "linear"): "FoBG (clipped, onset)", ("aobg_onset", "jump"): "AoBG (jump)",
        ("zobg_antithetic", "jump"): "ZoBG (antithetic)", ("mine:Own", "jump"): "Own",
    }  # fmt: skip
    assert {given: label_of(*given) for given in labels} == labels


def test_noises_are_told_apart() -> None:
    """Not the last one's verdict for all."""
    parts = [result(row("zobg", 10, 100), row("fobg", 10, variance)) for variance in (1, 1e6)]
    quiet, loud = findings_of(joined("sigma", [0.01, 1.0], parts))
    assert quiet == "sigma 0.01, penalty: FoBG's variance is below ZoBG's at K = 10 N/m (95 % intervals)"
    assert loud == "sigma 1, penalty: FoBG's variance is above ZoBG's at K = 10 N/m (95 % intervals)"


def as_json(dataset: xr.Dataset) -> dict[str, Any]:
    return as_document(dataset, console.rows_as_json)


def test_warnings_name_what_must_not_be_overlooked() -> None:
    some = {"unconverged": 3, "residual": 0.2, "onsets": 8, "onsets_bounded": 10, "onsets_missed": 2}
    told = warnings_of(result(row("fobg", 10, 1, nonfinite=7), row("zobg", 10, 1, **some)))
    assert "10 onsets and ends of contact are grazing, and their terms are bounded" in told  # not among onsets alone
    assert any(each.startswith("2 events of contact have no term") and "(8 onsets in all)" in each for each in told)
    assert any(line.startswith("7 samples overflowed or became NaN and were left out, ") for line in told)
    assert "3 rollouts in which the contact solver did not converge" in told


def test_an_unconverged_solve_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(tally.MOST_RESIDUAL, "float64", 1e-30)
    found = compare(stiffness=(10.0,), contact=("penalty",), chunk_size=4)
    assert all(row.unconverged > 0 for row in rows_of(found))
    assert any("the contact solver did not converge" in warning for warning in warnings_of(found))


def test_numbers_that_are_not_finite_become_null_in_json() -> None:
    document = as_json(result(row("fobg", 10, math.inf, cosine=math.nan)))
    assert document["rows"][0]["variance"] is None and document["rows"][0]["cosine"] is None


def test_a_step_is_unstable_beyond_the_limit() -> None:
    """Of an undamped spring of K / 0.05 kg and a step of 10 ms h^2 k = 4; of a critically damped one less."""
    k = np.array([10.0, 1000.0, 50_000.0]) / 0.05
    for damping, root, first in ((0 * k, 2.0, 2), (2 * np.sqrt(k), 2 * (math.sqrt(2) - 1), 1)):
        found = limit(0.05 * k, np.transpose([-k, -damping]), first, 0.01)
        assert found == pytest.approx(0.05 * (root / 0.01) ** 2, rel=0.01)


ERRORS = [
    (0.325, 0.298, 0.0098, "0.2980 ± 0.0098"), (7.825, 1.684, 10.088, "2 ± 10"), (0.25, 0.0, 0.2, "-"),
    (0.00047, 0.00031, 0.00012, "0.00031 ± 0.00012"), (0.0043, 0.0, 0.0002, "< 4.0e-4"), (0.25, 0.0, 0.01, "< 0.02"),
    (3.3e4, 240.0, 4.6e4, "0 ± 46000"), (3.0, 832.0912, 0.0123, "832.091 ± 0.012"), (0.1, 0.5, 1e-17, "0.5 ± 0"),
    (0.1, 6.8321e20, 1.2e18, "6.832e20 ± 1.2e18"), (0.1, 0.12345, math.nan, "0.123"), (0.1, math.inf, 1.0, "inf"),
]  # fmt: skip
COSINES = [(0.9, 1.0, 0.013, "> 0.97"), (0.9, 1.0, 0.0004, "> 0.9992"), (0.9, 1.0, 1e-9, "> 0.9999")]


@pytest.mark.parametrize(
    ("name", "value", "debiased", "error", "shown"),
    [*(("relative_error", *each) for each in ERRORS), *(("cosine", *each) for each in COSINES)],
)
def test_what_remains_without_noise(name: str, value: float, debiased: float, error: float, shown: str) -> None:
    """To the error's second digit; no error is rounded to nothing, and bounds are rounded outwards."""
    assert remains(name, value, debiased, error) == shown


def test_stepwise_estimators_take_a_task_without_controls() -> None:
    """Whose single-step derivatives have an axis of length 0."""
    stepwise = {"estimators": ("fobg_truncated", "fobg", "total_propagation"), "window": 1000}
    found = compare(tasks=("ball_wall",), contact=("reference",), **stepwise).gradient
    np.testing.assert_allclose(found.isel(estimator=0), found.isel(estimator=1), rtol=1e-9)  # longer than the rollout
    assert np.isfinite(found).all()


def test_a_task_in_place_of_a_name() -> None:
    """What a notebook builds runs as it is, with the configuration's noise; what does not fit is refused."""
    task = make_task("pusher", horizon=7).replace(name="mine", defaults=StudyDefaults(gamma=3.0))
    plan = plan_study(StudyConfig(tasks=(task,), sigma=(0.3,), stiffness=(10.0,)))
    assert plan.groups[0].task.scene is task.scene and plan.groups[0].task.horizon == 7
    assert {cell.sigma for cell in plan.cells} == {0.3}
    assert (estimators_of(plan, plan.cells[0])[2], plan.config.task_names) == (AlphaOrder(gamma=3.0), ["mine"])
    wrong = task.replace(final_cost=lambda state: state.qpos)
    with pytest.raises(ValueError, match="mine: the final_cost has shape .2,., and a cost is a scalar"):
        plan_study(StudyConfig(tasks=(wrong,)))
