"""docs/coverage.md agrees with its script: some rows are recomputed, all have the right shape."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

from experiments import coverage

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "coverage.md").read_text()


def rows(name: str) -> list[list[str]]:
    """Rows of a table of the page, without its header."""
    (text,) = re.findall(rf"<!-- table: {name} -->\n(.*?)\n<!-- end -->", PAGE, re.DOTALL)
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:]]


def same(found: list[str], said: list[str]) -> None:
    """Equal words, and numbers within the last digit, since rounding may turn a trial or two."""
    assert len(found) == len(said)
    for one, other in zip(found, said, strict=True):
        try:
            assert float(one) == pytest.approx(float(other), abs=0.011), (found, said)
        except ValueError:
            assert one == other


@pytest.mark.parametrize("kind", ["lognormal", "Student's t, 3 degrees"])
def test_intervals_and_the_test_for_bias(kind: str) -> None:
    assert jax.config.read("jax_enable_x64")
    intervals, test = coverage.coverage_rows(kind, 10)
    for found, name in ((intervals, "intervals"), (test, "test")):
        (said,) = [row for row in rows(name) if row[:2] == [kind, "10"]]
        same(found, said)


@pytest.mark.slow
def test_rare_samples() -> None:
    """The fast suite has the same case in `test_bias`, with fewer trials."""
    (said,) = [row for row in rows("rare") if row[:2] == ["0.4", "50"]]
    same(coverage.rare_row(0.4, 50), said)


def test_tables_have_every_kind_and_size() -> None:
    expected = [[kind, str(samples)] for kind in coverage.KINDS for samples in coverage.SAMPLES]
    assert [row[:2] for row in rows("intervals")] == expected == [row[:2] for row in rows("test")]
    assert all(len(row) == 2 + len(coverage.COLUMNS) for row in rows("intervals"))


def test_sentences_of_the_page_hold() -> None:
    """Sentences that a change of the estimators could falsify."""
    for row in rows("rare"):
        assert float(row[3]) < 0.06  # rejects at 5 %, whether believable or not
    for row in rows("dimensions"):
        assert float(row[6]) > 0.9 and float(row[10]) > 0.9  # the debiased numbers
    weights = [[float(cell.partition(",")[0]) for cell in row[2:]] for row in rows("weights")]  # of ten samples
    plugged, fitted, ratios = zip(*weights, strict=True)
    assert max(plugged) > 4 and max(fitted) < 2 and np.mean(ratios) > 1
