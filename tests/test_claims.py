"""Verdicts follow from intervals by the rules, changed claims are measured again, and the page is the code's."""

import dataclasses
import json
import math
import shlex
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex

from mjx_study import cli
from mjx_study.claims import CLAIMS, NUM_VERDICTS, ledger
from mjx_study.claims.laboratory import EFFORTS, Laboratory, Statistic, exact, mean_of, ratio_of, share_of
from mjx_study.claims.ledger import Claim, above, below, deciding_size, interval_of, measure_ledger, within
from mjx_study.claims.page import COLOURS, LEGEND, draw_matrix, markdown, table

DOCS = Path(__file__).parents[1] / "docs"
LEVEL = 1 - 0.05 / 200


def planted(mean: float, count: int = 400) -> Statistic:
    """Of as many values with this mean and a standard deviation of 1, to the digit."""
    values = np.random.default_rng(0).standard_normal(count)
    return mean_of((values - values.mean()) / values.std(ddof=1) + mean, "samples")


@pytest.mark.parametrize(
    ("criterion", "mean", "verdict"),
    [
        (above("x", 0.5, -0.5), 1.0, "holds"),
        (above("x", 0.5, -0.5), 0.6, "undecided"),  # half width 0.19
        (above("x", 0.5, -0.5), 0.0, "fails"),
        (above("x", 0.5, -0.5), -0.6, "fails"),
        (above("x", 0.5, -0.5), -1.0, "reversed"),
        (above("x", 0.5), -1.0, "fails"),
        (below("x", 0.5, 0.7), 0.0, "holds"),
        (below("x", 0.5, 0.7), 0.95, "reversed"),
        (within("x", -0.3, 0.3), 0.0, "holds"),
        (within("x", -0.3, 0.3), 0.2, "undecided"),
        (within("x", -0.3, 0.3), 0.6, "fails"),
        (within("x", -0.1, 0.1), 0.0, "undecided"),
    ],
)
def test_verdicts_of_planted_evidence(criterion: ledger.Criterion, mean: float, verdict: str) -> None:
    assert criterion.verdict(interval_of(planted(mean), LEVEL)) == verdict


def test_intervals() -> None:
    low, high = interval_of(planted(2.0), 0.95)
    assert (low, high) == pytest.approx((2 - 1.966 / 20, 2 + 1.966 / 20), abs=1e-4)
    assert interval_of(exact(1.0, 0.25), LEVEL) == (0.75, 1.25)
    assert interval_of(planted(2.0), 1 - 0.05 / 400)[1] > interval_of(planted(2.0), LEVEL)[1] > high
    share = share_of(np.arange(400) < 300, "trials")
    assert interval_of(share, 0.95) == pytest.approx((0.7053, 0.7899), abs=1e-3)  # Wilson's
    assert interval_of(Statistic(math.inf), LEVEL) == (-math.inf, math.inf)
    top, bottom = np.random.default_rng(0).chisquare(1, (2, 10_000)) * np.array([[10.0], [1.0]])
    ratio = ratio_of(top, bottom, "samples")
    assert ratio.estimate == pytest.approx(1.0, abs=4 * ratio.error)
    assert ratio.error == pytest.approx(2 / math.sqrt(10_000) / math.log(10), rel=0.05)


def test_the_sample_size_that_would_decide() -> None:
    """An interval about the same estimate decides from that size on, and not before."""
    criterion, few = above("x", 0.5), planted(0.6)
    size = deciding_size(few, criterion, LEVEL)
    assert size is not None and 1200 < size < 1600
    assert criterion.verdict(interval_of(planted(0.6, size + 20), LEVEL)) == "holds"
    assert criterion.verdict(interval_of(planted(0.6, size - 40), LEVEL)) == "undecided"
    assert deciding_size(exact(0.25, 0.5, 100), criterion, LEVEL) == 200  # of a quadrature, in proportion
    assert deciding_size(exact(0.45, 0.1), criterion, LEVEL) is None
    assert deciding_size(dataclasses.replace(few, slack=0.2), criterion, LEVEL) is None


@pytest.mark.parametrize("name", ["lemma-closed-form", "ramp-looks-like-a-jump", "jump-without-variance"])
def test_analytic_claims_hold(name: str) -> None:
    document = measure_ledger([CLAIMS[name]], "quick", verdicts=NUM_VERDICTS)
    (claim,) = document["claims"]
    assert {each["verdict"] for each in claim["evidence"]} == {"holds"}
    assert document["level"] == 1 - 0.05 / NUM_VERDICTS
    assert f"1 - 0.05 / {NUM_VERDICTS} (Bonferroni)" in markdown(document)


def test_a_wrong_estimator_is_seen() -> None:
    """The zeroth-order mean 20 % off, and a first order that sees the step."""

    def off(lab: Laboratory, system: str, family: str) -> Statistic:
        found = CLAIMS["zobg-unbiased"].measure(lab, system, family)
        return dataclasses.replace(found, estimate=1.2 * (1 + found.estimate) - 1)

    claim = dataclasses.replace(CLAIMS["zobg-unbiased"], systems={"step": ("reference",)})
    for measure, verdict in ((claim.measure, "holds"), (off, "fails")):
        document = measure_ledger([dataclasses.replace(claim, measure=measure)], "quick", verdicts=NUM_VERDICTS)
        assert document["claims"][0]["evidence"][0]["verdict"] == verdict


def test_a_stopped_run_goes_on_and_a_changed_claim_is_measured_again(tmp_path: Path) -> None:
    measured: list[str] = []
    stop = {"b"}

    def measure(lab: Laboratory, system: str, family: str) -> Statistic:
        if system in stop:
            raise KeyboardInterrupt
        measured.append(system)
        return exact(1.0)

    def claim(name: str, systems: str, bound: float = 0.0) -> Claim:
        return Claim(name, "", "", above("x", bound), dict.fromkeys(systems, ("reference",)), measure, "")

    with pytest.raises(KeyboardInterrupt):
        measure_ledger([claim("one", "ab")], "quick", tmp_path, verdicts=3)
    stop.clear()
    document = measure_ledger([claim("one", "ab"), claim("two", "c")], "quick", tmp_path, verdicts=3)
    assert measured == ["a", "b", "c"]
    assert table(document)[1].split() == ["one", "holds"]
    document = measure_ledger([claim("one", "ab", 2.0), claim("two", "c")], "quick", tmp_path, verdicts=3)
    assert measured == ["a", "b", "c", "a", "b"]
    assert table(document)[1].split() == ["one", "fails"]
    measure_ledger([claim("two", "c")], "full", tmp_path, verdicts=3)
    assert measured[5:] == ["c"]


def test_a_claim_depends_on_the_code_that_measures_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its module, what that imports, and the packages below; other code only where versions are accepted."""
    claim = dataclasses.replace(CLAIMS["lemma-closed-form"], systems={"step": ("reference",)})
    made = claim.made_by()
    assert made == claim.made_by() and made != CLAIMS["ball-over-wall"].made_by()  # of claims.theory, and of .descent
    measure_ledger([claim], "quick", tmp_path, verdicts=1)
    path = tmp_path / "parts" / "lemma-closed-form.json"
    kept = json.loads(path.read_text())
    planted = kept | {"cases": [kept["cases"][0] | {"estimate": 7.0}]}
    for changes, accept, again in (
        ({}, False, False),
        ({"made_by": "x"}, False, True),
        ({"made_by": "x"}, True, False),
    ):
        path.write_text(json.dumps(planted | changes))
        document = measure_ledger([claim], "quick", tmp_path, verdicts=1, accept_versions=accept)
        assert (document["claims"][0]["evidence"][0]["estimate"] != 7.0) == again
    path.write_text(json.dumps(planted | {"key": "x"}))
    document = measure_ledger([claim], "quick", tmp_path, verdicts=1, accept_versions=True)
    assert document["claims"][0]["evidence"][0]["estimate"] != 7.0


def test_the_page_is_what_the_code_says() -> None:
    document = json.loads((DOCS / "claims.json").read_text())
    assert (DOCS / "claims.md").read_text() == markdown(document)
    assert [claim["id"] for claim in document["claims"]] == list(CLAIMS)
    assert document["verdicts"] == NUM_VERDICTS and document["effort"]["name"] in EFFORTS
    for told in document["claims"]:
        claim = CLAIMS[told["id"]]
        said = (claim.place, claim.statement, claim.criterion.quantity, claim.criterion.lines(), claim.show)
        assert (told["place"], told["statement"], told["quantity"], told["criterion"], told["show"]) == said
        assert [(each["system"], each["family"]) for each in told["evidence"]] == claim.cases
        for each in told["evidence"]:
            ends = [-math.inf if each["lower"] is None else each["lower"]]
            ends.append(math.inf if each["upper"] is None else each["upper"])
            assert each["verdict"] == claim.criterion.verdict((ends[0], ends[1])), (told["id"], each)


def verdicts_of(*paths: Path) -> list[tuple[str, ...]]:
    """Claim and verdicts of each case, in ledgers of all claims."""
    ledgers = [json.loads(path.read_text())["claims"] for path in paths]
    return [
        (claims[0]["id"], *(each["verdict"] for each in cases))
        for claims in zip(*ledgers, strict=True)
        for cases in zip(*(claim["evidence"] for claim in claims), strict=True)
    ]


def test_the_page_names_what_the_quick_ledger_has_otherwise() -> None:
    pairs = verdicts_of(DOCS / "claims_quick.json", DOCS / "claims.json")
    told = LEGEND.partition("Both efforts")[2].partition("Not in the ledger")[0]
    revised = {claim for claim, quick, full in pairs if quick != "undecided" and quick != full}
    assert {part for part in told.split("`") if part in CLAIMS} == revised
    assert f"leaves {[quick for _, quick, _ in pairs].count('undecided')} verdicts undecided" in told


def test_no_undecided_verdict_lacks_the_sample_size_that_would_decide() -> None:
    for name in ("claims.json", "claims_quick.json"):
        document = json.loads((DOCS / name).read_text())
        evidence = [each for claim in document["claims"] for each in claim["evidence"]]
        assert all(each["deciding"] > each["samples"] for each in evidence if each["verdict"] == "undecided"), name


def test_the_picture_has_a_strip_for_each_verdict() -> None:
    document = json.loads((DOCS / "claims.json").read_text())
    (axes,) = draw_matrix(document).axes
    evidence = [each for claim in document["claims"] for each in claim["evidence"]]
    drawn = [to_hex(patch.get_facecolor()).upper() for patch in axes.patches]
    assert sorted(drawn) == sorted(COLOURS[each["verdict"]] for each in evidence)
    assert [label.get_text() for label in axes.get_yticklabels()] == [claim["id"] for claim in document["claims"]]


def test_the_commands_that_show_claims_exist() -> None:
    parser = cli.parser()
    for claim in CLAIMS.values():
        name, *rest = shlex.split(claim.show)
        assert name == "mjx-study"
        parser.parse_args(rest)


def test_ids_and_families_are_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert {family for claim in CLAIMS.values() for _, family in claim.cases} <= set(ledger.FAMILIES)
    assert cli.main(["claims", "--list", "--only", "lemma-closed-form"]) == 0
    assert "below 0.0001" in capsys.readouterr().out
    assert cli.main(["claims", "--only", "lemma"]) == 2
    assert "unknown claim 'lemma'; did you mean lemma-accuracy?" in capsys.readouterr().err


@pytest.mark.slow
def test_the_whole_quick_ledger(tmp_path: Path) -> None:
    """The same verdicts as committed, but for those close to a border."""
    assert cli.main(["claims", "--quick", "--output", str(tmp_path)]) == 0
    pairs = verdicts_of(tmp_path / "claims.json", DOCS / "claims_quick.json")
    assert not [pair for _, *pair in pairs if "undecided" not in pair and pair[0] != pair[1]]
    assert (tmp_path / "claims.png").stat().st_size > 10_000
