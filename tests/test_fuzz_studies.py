"""No damaged or forged study is believed: a few in the fast tests, thousands in a slow one; see `fuzzing_studies`."""

from pathlib import Path

import pytest

from mjx_study.cli import options
from mjx_study.disk import write_whole
from tests import fuzzing_studies
from tests.fuzzing_studies import Row


@pytest.fixture(autouse=True)
def configured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands run under the settings of the tests."""
    monkeypatch.setattr(options, "configure", lambda **_: None)


def check(rows: list[Row]) -> None:
    assert not [told for row in rows for told in row.told]


def test_a_few_flips_are_noticed(tmp_path: Path) -> None:
    check([fuzzing_studies.flip_studies(45, tmp_path, every=45), fuzzing_studies.flip_cached(200, tmp_path)])


def test_a_few_forged_folders_get_an_answer(tmp_path: Path) -> None:
    check(fuzzing_studies.forge_studies(3, tmp_path))


@pytest.mark.slow
def test_thousands_of_flips_and_hundreds_of_forged_folders_get_an_answer(tmp_path: Path) -> None:
    """Figures with -rP."""
    rows = fuzzing_studies.fuzz_studies(1000, 100, tmp_path)
    print(*rows, sep="\n")
    check(rows)
    assert sum(row.inputs for row in rows) >= 2400


def test_the_fuzzer_finds_what_is_wrong(tmp_path: Path) -> None:
    """Silence, a traceback, no answer, and a file outside are each counted."""
    row = Row("any")
    silent, outside = fuzzing_studies.SilentError("x"), fuzzing_studies.OutsideError("x")
    for error in (silent, fuzzing_studies.TooSlow(), outside, KeyError()):
        with row.counting("this"):
            raise error
    assert (row.inputs, row.silent, row.hangs, row.outside, row.tracebacks, row.wrong) == (4, 1, 1, 1, 1, 4)


def test_a_flip_that_is_believed_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without digests, flips change numbers."""
    monkeypatch.setattr(fuzzing_studies, "read_cached", Path.read_bytes)
    monkeypatch.setattr(fuzzing_studies, "write_cached", lambda path, content: write_whole(path, content))
    (tmp_path / "cache").mkdir()
    assert fuzzing_studies.flip_cached(10, tmp_path).silent == 10
