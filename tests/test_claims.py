"""Verdicts follow from intervals, changed claims are measured again, and the page states the code's claims."""

import dataclasses
import json
import math
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.claims import merged
from mjx_study import cli
from mjx_study.choices import laws_of
from mjx_study.claims import CLAIMS, NUM_VERDICTS, ledger
from mjx_study.claims.claim import Claim, Criterion
from mjx_study.claims.laboratory import EFFORTS, FAMILIES, Laboratory, Statistic, exact, mean_of, ratio_of, share_of
from mjx_study.claims.ledger import deciding_size, interval_of, measure_ledger
from mjx_study.claims.page import markdown, matrix_lines, verdict_counts
from mjx_study.claims.theory import relative_bias
from mjx_study.simulation import law

ROOT = Path(__file__).parents[1]
FULL, QUICK = (ROOT / "experiments" / "data" / f"{name}.json" for name in ("claims", "claims_quick"))
LEVEL = 1 - 0.05 / 200


def evidence_of(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """The cases of a measured ledger, each with its claim."""
    return [(claim["id"], each) for claim in json.loads(path.read_text())["claims"] for each in claim["evidence"]]


def planted(mean: float, count: int = 400) -> Statistic:
    """As many values with exactly this mean and a standard deviation of 1."""
    values = np.random.default_rng(0).standard_normal(count)
    return mean_of((values - values.mean()) / values.std(ddof=1) + mean, "samples")


@pytest.mark.parametrize(
    ("criterion", "verdicts"),
    [  # intervals have a half width of 0.19
        (
            Criterion("x", (0.5, math.inf), (-math.inf, -0.5)),
            {1.0: "holds", 0.6: "undecided", 0.0: "fails", -0.6: "fails", -1.0: "reversed"},
        ),
        (Criterion("x", (0.5, math.inf)), {-1.0: "fails"}),
        (Criterion("x", (-math.inf, 0.5), (0.7, math.inf)), {0.0: "holds", 0.95: "reversed"}),
        (Criterion("x", (-0.3, 0.3)), {0.0: "holds", 0.2: "undecided", 0.6: "fails"}),
        (Criterion("x", (-0.1, 0.1)), {0.0: "undecided", math.inf: "undecided"}),
    ],
)
def test_verdicts_of_planted_evidence(criterion: Criterion, verdicts: dict[float, str]) -> None:
    for mean, verdict in verdicts.items():
        statistic = planted(mean) if math.isfinite(mean) else Statistic(mean)
        assert criterion.verdict(interval_of(statistic, LEVEL)) == verdict, mean


def test_intervals() -> None:
    low, high = interval_of(planted(2.0), 0.95)
    assert (low, high) == pytest.approx((2 - 1.966 / 20, 2 + 1.966 / 20), abs=1e-4)
    assert interval_of(exact(1.0, 0.25), LEVEL) == (0.75, 1.25)
    assert interval_of(planted(2.0), 1 - 0.05 / 400)[1] > interval_of(planted(2.0), LEVEL)[1] > high
    share = share_of(np.arange(400) < 300, "trials")
    assert interval_of(share, 0.95) == pytest.approx((0.7053, 0.7899), abs=1e-3)  # Wilson's
    for unknown in (Statistic(math.inf), Statistic(1.0, math.nan)):
        assert interval_of(unknown, LEVEL) == (-math.inf, math.inf)
    top, bottom = np.random.default_rng(0).chisquare(1, (2, 10_000)) * np.array([[10.0], [1.0]])
    ratio = ratio_of(top, bottom, "samples")
    assert ratio.estimate == pytest.approx(1.0, abs=4 * ratio.error)
    assert ratio.error == pytest.approx(2 / math.sqrt(10_000) / math.log(10), rel=0.05)


def test_the_sample_size_that_would_decide() -> None:
    """An interval about the same estimate decides from that size on, and not before."""
    criterion, few = Criterion("x", (0.5, math.inf)), planted(0.6)
    size = deciding_size(few, criterion, LEVEL)
    assert size is not None and 1200 < size < 1600
    assert criterion.verdict(interval_of(planted(0.6, size + 20), LEVEL)) == "holds"
    assert criterion.verdict(interval_of(planted(0.6, size - 40), LEVEL)) == "undecided"
    assert deciding_size(exact(0.25, 0.5, 100), criterion, LEVEL) == 200  # of a quadrature, in proportion
    assert deciding_size(exact(0.45, 0.1), criterion, LEVEL) is None
    assert deciding_size(dataclasses.replace(few, slack=0.2), criterion, LEVEL) is None
    for path in (FULL, QUICK):
        undecided = [each for _, each in evidence_of(path) if each["verdict"] == "undecided"]
        assert undecided and all(each["deciding"] > each["samples"] for each in undecided)


@pytest.mark.parametrize("name", ["lemma-closed-form", "ramp-looks-like-a-jump", "jump-without-variance"])
def test_analytic_claims_hold(name: str) -> None:
    document = measure_ledger([CLAIMS[name]], "quick", verdicts=NUM_VERDICTS)
    (claim,) = document["claims"]
    assert {each["verdict"] for each in claim["evidence"]} == {"holds"}
    assert document["level"] == 1 - 0.05 / NUM_VERDICTS


def test_a_wrong_estimator_is_seen() -> None:
    """The zeroth-order mean 20 % off."""
    claim = dataclasses.replace(CLAIMS["zobg-unbiased"], systems={"step": ("reference",)})

    def off(lab: Laboratory, system: str, family: str) -> Statistic:
        found = claim.measure(lab, system, family)
        return dataclasses.replace(found, estimate=1.2 * (1 + found.estimate) - 1)

    for measure, verdict in ((claim.measure, "holds"), (off, "fails")):
        document = measure_ledger([dataclasses.replace(claim, measure=measure)], "quick", verdicts=NUM_VERDICTS)
        assert document["claims"][0]["evidence"][0]["verdict"] == verdict


def test_claims_on_laws_are_counted_without_their_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(law, "installed", lambda: False)
    monkeypatch.setattr(ledger, "installed", lambda: False)
    chosen = [CLAIMS["lemma-closed-form"], CLAIMS["laws-unbiased"]]
    document = measure_ledger(chosen, "quick", verdicts=NUM_VERDICTS)
    assert [claim["id"] for claim in document["claims"]] == ["lemma-closed-form"]
    assert document["not_checked"] == len(chosen[1].cases)
    assert verdict_counts(document).endswith(f"; not checked: {len(chosen[1].cases)}, which need mjx-study[laws]")
    assert cli.main(["claims", "--only", "laws-unbiased"]) == 2
    assert "laws-unbiased needs MuJoDiCo: pip install 'mjx-study[laws]'" in capsys.readouterr().err


def test_claims_on_laws_have_no_sampling_error() -> None:
    """The level of the others' intervals depends on it."""
    of_laws = [each for name, each in (*evidence_of(FULL), *evidence_of(QUICK)) if CLAIMS[name].of_laws]
    assert {each["of"] for each in of_laws} == {"points"}
    assert {each["family"] for each in of_laws} == set(laws_of(FAMILIES))


def test_the_bias_of_a_law_is_that_of_its_own_smoothing_and_of_what_touches() -> None:
    """A ball through a cone is right where MuJoCo's default is not; a box through the cone is wrong."""
    pytest.importorskip("mujodico", reason="the extra laws is not installed")
    lab = Laboratory(dataclasses.replace(EFFORTS["quick"], density=10))
    bias = {
        (system, family): relative_bias(lab, f"{system}, 0.05 m", family).estimate
        for system, family in (("throw", "conic"), ("throw", "mujoco_default"), ("box", "conic"))
    }
    assert abs(bias["throw", "conic"]) < 0.01 and bias["throw", "mujoco_default"] < -0.5 and bias["box", "conic"] < -0.5
    moved, usual = (lab.slopes("throw", "log_barrier", 0.05, stiffness=1e4, smoothing=each) for each in (10.0, 1.0))
    assert abs(moved.gradient / usual.gradient - 1) > 0.5 and abs(moved.relative) < 0.01


def test_merged_claims_replace_their_like() -> None:
    stored = json.loads(QUICK.read_text())
    name = stored["claims"][3]["id"]
    changed = stored["claims"][3] | {"evidence": [], "revision": "new"}
    found = stored | {"claims": [changed]}
    after = merged(stored, found)
    assert [claim["id"] for claim in after["claims"]] == list(CLAIMS)
    assert {claim["id"] for claim in after["claims"] if claim not in stored["claims"]} == {name}
    assert "new" in after["revisions"]
    for other, message in (
        ({"level": 0.9}, "another level"),
        ({"effort": {"name": "full"}}, "another effort"),
        ({"environment": {"versions": {"jax": "0"}}}, "other versions"),
    ):
        with pytest.raises(ValueError, match=message):
            merged(stored, found | other)
    with pytest.raises(ValueError, match=f"never measured: {name}$"):
        merged(stored | {"claims": stored["claims"][:3] + stored["claims"][4:]}, found | {"claims": []})


def test_a_stopped_run_resumes_and_changed_claims_are_measured_again(tmp_path: Path) -> None:
    measured: list[str] = []
    stop = {"b"}

    def measure(lab: Laboratory, system: str, family: str, value: float = 1.0) -> Statistic:
        if system in stop:
            raise KeyboardInterrupt
        measured.append(system)
        return exact(value)

    def claim(name: str, systems: str, bound: float = 0.0, quantity: str = "x", **options: float) -> Claim:
        criterion, chosen = Criterion(quantity, (bound, math.inf)), dict.fromkeys(systems, ("reference",))
        return Claim(name, "", "", criterion, chosen, measure, options=options)

    def again(*claims: Claim, effort: str = "quick", accept: bool = False) -> tuple[str, str]:
        """What is measured anew, and the first verdict."""
        before = len(measured)
        document = measure_ledger(claims, effort, tmp_path, verdicts=3, accept_versions=accept)
        return "".join(measured[before:]), matrix_lines(document)[1].split()[1]

    with pytest.raises(KeyboardInterrupt):
        again(claim("one", "ab"))
    stop.clear()
    assert again(claim("one", "ab"), claim("two", "c")) == ("bc", "holds")
    assert again(claim("one", "ab", 2.0), claim("two", "c")) == ("ab", "fails")
    assert again(claim("two", "c", quantity="in other words")) == ("", "holds")
    assert again(claim("two", "c"), effort="full") == ("c", "holds")
    assert again(claim("two", "c", value=-1.0), effort="full", accept=True) == ("", "holds")
    assert again(claim("two", "c", value=-1.0), effort="full") == ("c", "fails")


def test_a_claim_depends_on_the_code_that_measures_it() -> None:
    """The module of the measure, what that imports, and the packages below."""
    made = CLAIMS["lemma-closed-form"].made_by()
    assert made == CLAIMS["friction-variance"].made_by() != CLAIMS["different-minima"].made_by()
    assert CLAIMS["ball-over-wall"].made_by() != CLAIMS["soft-push"].made_by()  # the options of one function


def test_the_page_states_the_claims_of_the_code() -> None:
    document = json.loads(FULL.read_text())
    assert (ROOT / "docs" / "claims.md").read_text() == markdown(document)
    assert [claim["id"] for claim in document["claims"]] == list(CLAIMS)
    assert document["verdicts"] == NUM_VERDICTS and document["effort"]["name"] in EFFORTS
    for stored in document["claims"]:
        claim = CLAIMS[stored["id"]]
        expected = (claim.place, claim.statement, claim.criterion.quantity, claim.criterion.lines(), claim.show)
        assert tuple(stored[name] for name in ("place", "statement", "quantity", "criterion", "show")) == expected
        assert [(each["system"], each["family"]) for each in stored["evidence"]] == claim.cases
        for each in stored["evidence"]:
            low, high = (math.inf if each[end] is None else each[end] for end in ("lower", "upper"))
            interval = (-math.inf if math.isinf(low) else low, high)
            assert each["verdict"] == claim.criterion.verdict(interval), (stored["id"], each)


def test_the_page_names_the_claims_that_the_quick_ledger_decides_otherwise() -> None:
    pairs = list(zip(evidence_of(QUICK), evidence_of(FULL), strict=True))
    verdicts = [(name, quick["verdict"], full["verdict"]) for (name, quick), (_, full) in pairs]
    page = (ROOT / "docs" / "claims.md").read_text().partition("A quick run leaves")[2].partition("\n\n")[0]
    revised = {claim for claim, quick, full in verdicts if quick != "undecided" and quick != full}
    assert {part for part in page.split("`") if part in CLAIMS} == revised
    assert page.startswith(f" {[quick for _, quick, _ in verdicts].count('undecided')} verdicts undecided")


def test_commands_and_families_exist(capsys: pytest.CaptureFixture[str]) -> None:
    parser = cli.parser()
    for claim in CLAIMS.values():
        name, *rest = shlex.split(claim.show)
        assert name == "mjx-study"
        parser.parse_args(rest)
    assert {family for claim in CLAIMS.values() for _, family in claim.cases} <= set(FAMILIES)
    assert cli.main(["claims", "--list", "--only", "lemma-closed-form"]) == 0
    assert "below 0.0001" in capsys.readouterr().out


@pytest.mark.slow
def test_the_whole_quick_ledger(tmp_path: Path) -> None:
    """The same verdicts as committed, but for those close to a border, and on times, which other processes change."""
    assert cli.main(["claims", "--quick", "--output", str(tmp_path)]) == 0
    pairs = zip(evidence_of(tmp_path / "claims.json"), evidence_of(QUICK), strict=True)
    verdicts = [{one["verdict"], other["verdict"]} for (name, one), (_, other) in pairs if name != "fobg-costs-more"]
    assert not [pair for pair in verdicts if "undecided" not in pair and len(pair) > 1]
    assert (tmp_path / "claims.png").stat().st_size > 10_000
