"""Comparisons: what is shared, what is compiled, what the findings say, what a plan refuses."""

import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from matplotlib.patches import Rectangle

import mjx_study.report  # noqa: F401  # registers `Dataset.mjx_study`, which no other import here does
from estimators import (
    AlphaOrder,
    Differentiation,
    DiscontinuityGated,
    FirstOrder,
    GradientEstimate,
    summarise,
)
from estimators.registry import label_of
from mjx_study.cli import console
from mjx_study.cli.studies import as_document
from mjx_study.execution.run import run_study
from mjx_study.experiment import sampling
from mjx_study.experiment.checkpoint import StudyError
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import estimators_of
from mjx_study.objective import BlankObjective, MjxObjective, Simulator
from mjx_study.options.configuration import StudyConfig
from mjx_study.plots.panels import limit
from mjx_study.plots.study import plot_study
from mjx_study.results.kind import findings_of
from mjx_study.results.rows import Row, rows_of
from mjx_study.results.variables import GRADIENTS
from mjx_study.results.warnings import warnings_of
from mjx_study.storage.dataset import dataset_of
from mjx_study.tasks import make_task
from mjx_study.tasks.task import StudyDefaults

pytestmark = pytest.mark.usefixtures("shared_programs")

SMALL: dict[str, Any] = {"horizon": 4, "samples": (8,), "reference_samples": 8, "seeds": 1}


def config(**changes: Any) -> StudyConfig:
    chosen: dict[str, Any] = {"tasks": ("pusher",)} | SMALL | changes
    return StudyConfig(**chosen)


@pytest.fixture(autouse=True)
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tables that no terminal breaks up."""
    monkeypatch.setenv("COLUMNS", "200")


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
    at = {"task": 0, "timestep": 0, "cone": 0, "sigma": 0, "samples": 0}
    axes = {"task": ["pusher"], "timestep": [0.01], "cone": ["pyramidal"]}
    axes |= {"model": [f"penalty {stiffness:g}" for stiffness in stiffnesses], "sigma": [0.1], "samples": [100]}
    document: dict[str, Any] = {
        "config": {"kind": "gradients", "tasks": ["pusher"], "estimators": names, "seeds": 1, "iterations": None}
        | {"confidence": 0.95, "samples": [100], "seed": 0, "reference_samples": 600},
        "environment": {"precision": "float64"},
        "warnings": [],
        "axes": axes,
        "models": [{"contact": "penalty", "stiffness": stiffness} for stiffness in stiffnesses],
        "resolved": [{"horizon": [4], "noise": "gaussian", "estimators": {"aobg": {"gamma": gamma}}}],
        "cells": [
            {"at": at | {"model": index}} | {key: at[key] for key in ("sigma", "samples")}
            for index in range(len(stiffnesses))
        ],
    }
    for cell in document["cells"]:
        cell["at"] = {name: cell["at"][name] for name in axes}
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


def one(*rows: dict[str, Any]) -> Row:
    return rows_of(result(*rows))[0]


@pytest.fixture(scope="module")
def spied() -> tuple[xr.Dataset, int, dict[str, list[np.ndarray]]]:
    """A sweep over 13 stiffness values in two families: its result, compilations, and the keys of each batch."""
    keys: dict[str, list[np.ndarray]] = {"evaluate": [], "differentiate": []}
    simulators: list[Simulator] = []

    def spy(name: str):
        method = getattr(MjxObjective, name)

        def recorded(self, theta, batch):
            if not isinstance(self, BlankObjective):
                keys[name].append(np.asarray(jax.random.key_data(batch)))
            if self.simulator not in simulators:
                simulators.append(self.simulator)
            return method(self, theta, batch)

        return recorded

    with pytest.MonkeyPatch.context() as patch:
        for name in keys:
            patch.setattr(MjxObjective, name, spy(name))
        found = compare(stiffness=tuple(np.geomspace(10, 1000, 13)), contact=("penalty", "mujoco"), chunk_size=4)
    (simulator,) = simulators
    return found, simulator.num_compilations, keys


def test_a_sweep_compiles_each_program_once(spied) -> None:
    found, compilations, _ = spied
    assert compilations == 2
    assert len(rows_of(found)) == 13 * 2 * 3


def test_batches_are_independent_and_the_same_in_every_cell(spied) -> None:
    _, _, keys = spied
    zeroth, first = keys["evaluate"][1:], keys["differentiate"][1:]  # the first call of each only compiles
    assert len(zeroth) == 26 and len(first) == 53  # FoBG and control variate of each cell, and of the softest contact
    first = [first[0], *first[2:]]
    for batch in zeroth:
        np.testing.assert_array_equal(batch, zeroth[0])
    pools = [{tuple(key) for key in batch} for batch in (zeroth[0], first[0], first[1])]
    assert all(len(pool) == len(batch) for pool, batch in zip(pools, (zeroth[0], first[0], first[1]), strict=True))
    assert not (pools[0] & pools[1] or pools[0] & pools[2] or pools[1] & pools[2])


def test_an_alpha_order_row_follows_from_the_other_two(spied) -> None:
    found, _, _ = spied
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


def test_a_second_run_gives_the_same_numbers(spied) -> None:
    found, _, _ = spied
    again = compare(stiffness=(10.0,), contact=("penalty",), chunk_size=4)
    np.testing.assert_array_equal(again["gradient"].isel(model=0), found["gradient"].isel(model=0))
    other = compare(stiffness=(10.0,), contact=("penalty",), chunk_size=4, seed=1)
    assert np.all(other["gradient"].values != again["gradient"].values)


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


def test_findings_follow_the_intervals() -> None:
    rows = (row("zobg", 10, 100), row("fobg", 10, 1), row("zobg", 100, 100), row("fobg", 100, 150))
    rows += (row("zobg", 1000, 100), row("fobg", 1000, 1e6))
    (sentence,) = findings_of(result(*rows))
    assert sentence == (
        "penalty: FoBG's variance is below ZoBG's at K = 10 N/m; above ZoBG's at K = 1000 N/m; not significantly "
        "different from ZoBG's at K = 100 N/m (95 % intervals)"
    )


def test_no_variance_is_called_less_on_too_few_effective_samples() -> None:
    """A batch without one of the rare samples that carry the gradient varies little, or not at all."""
    for variance, effective in ((0, 0.0), (1, 2.0)):
        doubtful = row("fobg", 10, variance, effective_samples=effective, debiased_error_se=0.01)
        (sentence,) = findings_of(result(row("zobg", 10, 100), doubtful))
        assert sentence == (
            "penalty: FoBG's variance is undecided (too few effective samples) at K = 10 N/m (95 % intervals)"
        )


def test_bias_is_reported_only_beyond_what_noise_explains() -> None:
    quiet = row("fobg", 10, 1, relative_error=0.044, bias_p_value=0.002)
    loud = row("fobg", 10, 1, relative_error=0.044, bias_p_value=0.001)
    assert findings_of(result(quiet)) == []
    (sentence,) = findings_of(result(loud))
    assert sentence == "penalty: FoBG's mean is biased by 4.4 % at K = 10 N/m (p <= 0.001)"
    mixed = row("aobg", 10, 1, relative_error=16.95, bias_p_value=0.001)
    (sentence,) = findings_of(result(mixed))
    assert sentence == "penalty: AoBG's mean is biased by 1700 % at K = 10 N/m (p <= 0.001)"
    (sentence,) = findings_of(result(mixed, gamma="inf"))
    assert sentence.endswith("(p <= 0.001): it has no accuracy bound; set one with --gamma")


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
        "penalty: FoBG's mean is biased by 2.5 % at K = 10 N/m in 2 of 3 seeds (p <= 0.001)",
    ]
    below = joined("seed", [0, 1], parts[:2])
    assert findings_of(below)[0] == "penalty: FoBG's variance is below ZoBG's at K = 10 N/m (95 % intervals)"


def test_the_onset_term_is_judged_like_the_rest() -> None:
    (sentence,) = findings_of(result(row("fobg_onset", 10, 1, relative_error=0.044, bias_p_value=0.001)))
    assert sentence == "penalty: FoBG (onset)'s mean is biased by 4.4 % at K = 10 N/m (p <= 0.001)"


@pytest.mark.parametrize(
    ("name", "onset", "label"),
    [
        ("fobg", "none", "FoBG"),
        ("fobg", "linear", "FoBG (onset)"),
        ("fobg_onset", "linear", "FoBG (onset)"),
        ("fobg_clipped", "linear", "FoBG (clipped, onset)"),
        ("aobg_onset", "jump", "AoBG (jump)"),
        ("zobg_antithetic", "jump", "ZoBG (antithetic)"),
        ("mine:Own", "jump", "Own"),
    ],
)
def test_a_label_has_the_onset_term(name: str, onset: str, label: str) -> None:
    assert label_of(name, onset) == label


def test_a_table_and_its_findings_say_that_there_is_an_onset_term() -> None:
    dataset = result(row("zobg", 10, 100.0), row("fobg", 10, 1.0))
    dataset.attrs["config"] = json.dumps(json.loads(dataset.attrs["config"]) | {"onset": "linear"})
    printed = table(dataset)
    assert any(" FoBG (onset) " in line for line in printed) and any(" ZoBG " in line for line in printed)
    assert findings_of(dataset)[0].startswith("penalty: FoBG (onset)'s variance is below ZoBG's")


def test_an_onset_term_that_is_not_to_be_trusted_is_told() -> None:
    """Noise that does not reach the next step, and onsets that take much of the speed in one; not so for the jump."""
    events = {"onsets": 100.0, "onset_spread": 2.0, "onset_strength": 0.1}
    assert findings_of(result(row("fobg_onset", 10, 1, **events))) == []
    (narrow,) = findings_of(result(row("fobg_onset", 10, 1, **events | {"onset_spread": 0.4})))
    assert narrow.startswith(
        "penalty: the onset term may be off at K = 10 N/m, since the noise is narrow: the step at which contact "
    )
    both = events | {"onset_spread": 0.4, "onset_strength": 0.25}
    assert findings_of(result(row("fobg_onset", 10, 1, **both))) == [narrow]  # narrow noise spoils the jump as much
    (strong,) = findings_of(result(row("fobg_onset", 10, 1, **events | {"onset_strength": 0.25})))
    assert strong.startswith("penalty: the linear onset term can be off by 12 % of what it adds at K = 10 N/m (")
    (beyond,) = findings_of(result(row("fobg_onset", 10, 1, **events | {"onset_strength": 1.2})))
    assert beyond.startswith("penalty: the linear onset term can leave more than it adds at K = 10 N/m (more at ")
    assert findings_of(result(row("fobg_onset", 10, 1, **events | {"onset_strength": 0.0}))) == []


def test_noises_are_told_apart() -> None:
    """Not the last one's verdict for all."""
    parts = [result(row("zobg", 10, 100), row("fobg", 10, variance)) for variance in (1, 1e6)]
    quiet, loud = findings_of(joined("sigma", [0.01, 1.0], parts))
    assert quiet == "sigma 0.01, penalty: FoBG's variance is below ZoBG's at K = 10 N/m (95 % intervals)"
    assert loud == "sigma 1, penalty: FoBG's variance is above ZoBG's at K = 10 N/m (95 % intervals)"


def test_a_bias_beyond_computing_is_no_number() -> None:
    wild = row("fobg", 10, 1, relative_error=math.nan, bias_p_value=0.001)
    (sentence,) = findings_of(result(wild))
    assert sentence == "penalty: FoBG's mean is biased by more than can be computed at K = 10 N/m (p <= 0.001)"


def test_a_bias_is_no_share_of_a_reference_that_is_not_known() -> None:
    unsure = row("fobg", 10, 1, relative_error=6.2, debiased_error=6.2, bias_p_value=0.001, reference_uncertainty=0.6)
    assert (
        findings_of(result(unsure))[0]
        == "penalty: FoBG's mean is biased by an unknown share at K = 10 N/m (p <= 0.001)"
    )


def test_a_result_that_means_nothing_says_so() -> None:
    """Contact that is never met, a reference as uncertain as the errors, a bound below ZoBG's own radius."""
    same = (row("zobg", 10, 5.0), row("fobg", 10, 1.0), row("zobg", 100, 5.0), row("fobg", 100, 1.0))
    assert findings_of(result(*same))[-1] == (
        "penalty: nothing depends on K: the contact whose stiffness is swept was never active"
    )
    assert not any("never active" in each for each in findings_of(result(*same[:3], row("fobg", 100, 1.001))))
    (sentence,) = findings_of(result(row("fobg", 10, 1.0, reference_uncertainty=0.25)))
    assert sentence.startswith("penalty: the reference's own uncertainty exceeds 20 % at K = 10 N/m: errors and")
    (sentence,) = findings_of(result(row("aobg", 10, 1.0, alpha=0.0, epsilon=7.0, discrepancy=1.0), gamma=5.0))
    assert sentence.startswith("penalty: AoBG equals ZoBG at K = 10 N/m: its bound gamma is below epsilon")
    assert findings_of(result(row("aobg", 10, 1.0, alpha=0.3, epsilon=7.0, discrepancy=1.0), gamma=9.0)) == []


def test_nothing_is_called_biased_on_too_few_effective_samples() -> None:
    loud: dict[str, Any] = {"relative_error": 0.44, "debiased_error_se": 0.03, "bias_p_value": 0.001}
    assert one(row("fobg", 10, 1, **loud)).bias_verdict == "biased"
    few = row("fobg", 10, 1, **loud, effective_samples=1.9)
    (sentence,) = findings_of(result(few))
    assert sentence == (
        "penalty: FoBG's mean is off by 44 % at K = 10 N/m, from bias or lack of rare samples: too few effective "
        "samples (1.9)"
    )
    equal = row("fobg", 10, 1, **loud | {"bias_p_value": math.nan}, effective_samples=0.0, top_share=math.nan)
    (sentence,) = findings_of(result(equal))
    assert sentence.endswith("too few effective samples (all equal)")
    unsure = row("fobg", 10, 1, **loud, reference_effective_samples=2.0)
    for doubtful in (few, equal, unsure):
        assert one(doubtful).bias_verdict == "too few effective samples"
        assert as_json(result(doubtful))["rows"][0]["bias_verdict"] == "too few effective samples"
    agrees = row("fobg", 10, 1, debiased_error=0.01, debiased_error_se=0.01, effective_samples=0.0)
    assert findings_of(result(agrees)) == []
    assert one(row("fobg", 10, 1)).bias_verdict == "none seen"


def as_json(dataset: xr.Dataset) -> dict[str, Any]:
    return as_document(dataset, console.rows_as_json)


def table(dataset: xr.Dataset, details: bool = True) -> list[str]:
    return console.gradient_lines(dataset, as_json(dataset), details)


def test_doubtful_numbers_are_marked_in_the_table() -> None:
    sure = row("zobg", 10, 1, relative_error=0.325, debiased_error=0.298, debiased_error_se=0.0098)
    lines = table(result(sure, row("fobg", 20, 1, effective_samples=1.2, top_share=0.9)))
    (above,) = [line for line in lines if "0.325 -> 0.2980 ± 0.0098" in line]
    assert "30 (10 %)" in above and "?" not in above
    (below,) = [line for line in lines if "1.2 (90 %)" in line]
    assert "(0.5 to 2)?" in below
    assert any(line.startswith("?: fewer than 3 effective samples") for line in lines)
    assert not any("?" in line for line in table(result(sure)))
    nothing = row("fobg", 20, 1, effective_samples=1.2, relative_error=0.3, debiased_error=0.0, debiased_error_se=0.5)
    assert any("0.3 -> ?  " in line for line in table(result(nothing)))


def test_warnings_name_what_must_not_be_overlooked() -> None:
    told = warnings_of(result(row("fobg", 10, 1, nonfinite=7), row("zobg", 10, 1, unconverged=3, residual=0.2)))
    assert any(line.startswith("7 samples overflowed or became NaN and were left out: ") for line in told)
    assert "3 rollouts in which the contact solver did not converge" in told


def test_an_unconverged_solve_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sampling.MOST_RESIDUAL, "float64", 1e-30)
    found = compare(stiffness=(10.0,), contact=("penalty",), chunk_size=4)
    assert all(row.unconverged > 0 for row in rows_of(found))
    assert any("the contact solver did not converge" in warning for warning in warnings_of(found))


def test_numbers_that_are_not_finite_become_null_in_json() -> None:
    document = as_json(result(row("fobg", 10, math.inf, cosine=math.nan)))
    assert document["rows"][0]["variance"] is None and document["rows"][0]["cosine"] is None


def test_the_unstable_band_begins_at_the_limit() -> None:
    """Of an undamped spring of K / 0.05 kg and a step of 10 ms: h^2 k = 4, not the middle of the grid's stiffnesses."""
    made_up = result(*(row("zobg", stiffness, 1.0) for stiffness in (10, 1000, 50_000)))
    (figure,) = plot_study(made_up).values()
    (band,) = [patch for patch in figure.axes[0].patches if isinstance(patch, Rectangle)]
    assert band.get_x() == pytest.approx(0.05 * 4 / 0.01**2, rel=0.01)
    k = np.array([10.0, 1000.0, 50_000.0]) / 0.05
    critical = limit(0.05 * k, np.transpose([-k, -2 * np.sqrt(k)]), 1, 0.01)
    assert critical == pytest.approx(0.05 * (2 * (math.sqrt(2) - 1) / 0.01) ** 2, rel=0.01)


@pytest.mark.parametrize(
    ("value", "error", "shown"),
    [
        (832.0912, 0.0123, "832.091 ± 0.012"),
        (-1.42, 0.13, "-1.42 ± 0.13"),
        (0.00012, 0.0101, "0 ± 0.010"),
        (-0.009331, 2.14e-5, "-0.009331 ± 2.1e-5"),
        (39123.4, 37456.0, "39000 ± 37000"),
        (6.8321e20, 1.2e18, "6.832e20 ± 1.2e18"),
        (0.5, 0.0, "0.5 ± 0"),
        (0.5, 1e-17, "0.5 ± 0"),
        (0.12345, None, "0.123"),
        (0.12345, math.nan, "0.123"),
        (math.inf, 1.0, "inf"),
    ],
)
def test_a_number_and_its_error_have_the_same_digits(value: float, error: float | None, shown: str) -> None:
    assert console.with_error(value, error) == shown


@pytest.mark.parametrize(
    ("value", "debiased", "error", "shown"),
    [
        (0.325, 0.298, 0.0098, "0.325 -> 0.2980 ± 0.0098"),
        (7.825, 1.684, 10.088, "7.83 -> 2 ± 10"),
        (0.00047, 0.00031, 0.00012, "4.7e-4 -> 0.00031 ± 0.00012"),
        (0.0043, 0.0, 0.0002, "0.0043 -> < 4.0e-4"),
        (0.25, 0.0, 0.01, "0.25 -> < 0.02"),
        (0.25, 0.0, 0.2, "0.25 -> -"),
        (3.3e4, 240.0, 4.6e4, "3.3e4 -> 0 ± 46000"),
    ],
)
def test_no_error_is_rounded_to_nothing(value: float, debiased: float, error: float, shown: str) -> None:
    each = row("fobg", 10, 1, relative_error=value, debiased_error=debiased, debiased_error_se=error)
    assert any(f"  {shown}  " in line for line in table(result(each)))


@pytest.mark.parametrize(
    ("cosine", "error", "shown"),
    [(0.9, 0.013, "> 0.97"), (0.9, 0.0004, "> 0.9992"), (0.9, 1e-9, "> 0.9999"), (1.0, 0.0, "1 -> 1 ± 0")],
)
def test_a_bound_of_a_cosine_is_rounded_down(cosine: float, error: float, shown: str) -> None:
    each = row("fobg", 10, 1, cosine=cosine, debiased_cosine=1.0, debiased_cosine_se=error)
    assert any(f"{shown}  " in line for line in table(result(each)))


def test_stepwise_estimators_take_a_task_without_controls() -> None:
    """Whose single-step derivatives have an axis of length 0."""
    stepwise = {"estimators": ("fobg_truncated", "fobg", "total_propagation"), "window": 1000}
    found = compare(tasks=("ball_wall",), contact=("reference",), **stepwise).gradient
    np.testing.assert_allclose(found.isel(estimator=0), found.isel(estimator=1), rtol=1e-9)  # longer than the rollout
    assert np.isfinite(found).all()


@pytest.mark.parametrize(("columns", "tables"), [(200, 1), (80, 3)])
def test_the_table_fits_the_terminal(monkeypatch: pytest.MonkeyPatch, columns: int, tables: int) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    full = row("aobg", 1000, 6.4e20, alpha=0.5, epsilon=641.0, discrepancy=1.2e11, relative_error=4.1e9)
    shown = [line for line in table(result(full)) if "K [N/m]" in line or "AoBG" in line]
    assert sum("K [N/m]" in line for line in shown) == tables
    assert max(map(len, shown)) <= columns


def test_theta_and_sigma_reach_the_plan() -> None:
    plan = plan_study(config(theta=(0.0, 1.0, 2.0, 3.0), sigma=(0.3,)))
    assert {cell.sigma for cell in plan.cells} == {0.3} and plan.groups[0].cone == "pyramidal"
    theta = plan.groups[0].task.theta
    np.testing.assert_array_equal(theta, np.arange(4))
    assert theta.dtype == jnp.float64


def test_a_task_in_place_of_a_name() -> None:
    """What a notebook builds runs as it is, with the configuration's noise; what does not fit is refused."""
    task = make_task("pusher", horizon=7).replace(name="mine", defaults=StudyDefaults(gamma=3.0))
    plan = plan_study(StudyConfig(tasks=(task,), sigma=(0.3,), stiffness=(10.0,)))
    assert plan.groups[0].task.scene is task.scene and plan.groups[0].task.horizon == 7
    assert {cell.sigma for cell in plan.cells} == {0.3}
    assert (estimators_of(plan, plan.cells[0])[2], plan.config.task_names) == (AlphaOrder(gamma=3.0), ["mine"])
    with pytest.raises(ValueError, match="`cone` is for tasks given by name"):
        plan_study(StudyConfig(tasks=(task,), cone=("elliptic",), horizon=3))
    wrong = task.replace(final_cost=lambda state: state.qpos)
    with pytest.raises(ValueError, match="mine: the final_cost has shape .2,., and a cost is a scalar"):
        plan_study(StudyConfig(tasks=(wrong,)))
