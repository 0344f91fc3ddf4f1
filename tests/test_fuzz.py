"""No input ends in a traceback or in no answer: thousands at random (`make fuzz`), of which fast tests run a few."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mjx_study.study import plan as plan_module
from tests import fuzz, fuzzing
from tests.fuzzing_cases import CASES, FULL, Row, fuzzed_folder
from tests.fuzzing_cases import fuzz as answers


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with fuzzed_folder(tmp_path_factory.mktemp("fuzz")) as path:
        yield path


@pytest.mark.parametrize("kind", CASES)
def test_a_few_inputs_get_an_answer(kind: str, folder: Path) -> None:
    row = answers(kind, folder, 8)
    assert row.inputs == 8 and row.wrong == 0, row.told


@pytest.mark.slow
@pytest.mark.parametrize("kind", CASES)
def test_thousands_of_inputs_get_an_answer(kind: str, folder: Path) -> None:
    """Some are refused and, but for files that are seldom right, some are planned."""
    row = answers(kind, folder, FULL[kind])
    assert row.wrong == 0, row.told
    assert row.codes[2] > FULL[kind] / 20


def test_enough_is_tried() -> None:
    """Of every command too, about as often as of any other."""
    assert sum(FULL.values()) >= 4000 and FULL.keys() == CASES.keys()
    assert FULL["options of every command"] >= 100 * len(fuzzing.COMMANDS)


def test_every_wrong_answer_has_its_column() -> None:
    row = Row("options")
    errors = fuzzing.SilentError("a"), KeyError("b"), fuzzing.TooSlow(), fuzzing.OutsideError("c")
    for error in errors:
        with row.counting(["compare"]):
            raise error
    with row.counting(["compare"]):
        pass
    assert fuzz.cells(row) == ["options", "5", "1", "1", "1", "1"] and row.wrong == 4
    assert row.told[0] == "options: ['compare']: SilentError a"
    with pytest.raises(KeyboardInterrupt), row.counting(["compare"]):
        raise KeyboardInterrupt


def test_the_table_goes_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{fuzz.BEGIN}old\n{fuzz.END}after\n")
    table = fuzz.markdown([Row("options", 1200, silent=3), Row("files", 7)])
    fuzz.put_into(page, table)
    fuzz.put_into(page, table)
    assert page.read_text() == f"before\n{fuzz.BEGIN}\n{table}\n{fuzz.END}after\n"
    assert table.splitlines()[0] == "1,207 inputs, 3 answered wrongly."
    assert table.splitlines()[-2:] == ["| options | 1200 | 3 | 0 | 0 | 0 |", "| files | 7 | 0 | 0 | 0 | 0 |"]


def test_the_fuzzer_finds_a_traceback_and_an_exit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a command must not do is noticed."""

    def broken(error: BaseException) -> Callable[..., None]:
        def plan(*_: Any, **__: Any) -> None:
            raise error

        return plan

    for error in (KeyError("theta"), SystemExit(0), fuzzing.TooSlow()):
        monkeypatch.setattr(plan_module, "plan_study", broken(error))
        with pytest.raises((KeyError, fuzzing.SilentError, fuzzing.TooSlow)):
            fuzzing.answer(["compare", "pusher"], folder)

    def touching(*_: Any, **__: Any) -> None:
        (folder / "policy.json").write_text("mine")
        raise ValueError("and refuses")

    monkeypatch.setattr(plan_module, "plan_study", touching)
    with pytest.raises(fuzzing.OutsideError, match="a file was touched"):
        fuzzing.answer(["compare", "pusher"], folder)
    with pytest.raises(fuzzing.SilentError, match="exit code 2 of"):
        fuzzing.answer(["compare", "nobody"], folder, refuse=False)
