"""No input ends in a traceback or in no answer: thousands at random (`make fuzz`), of which fast tests run a few."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from mjx_study import caches
from mjx_study.experiment import plan as plan_module
from mjx_study.storage import manifest as document
from tests.fuzz import FUZZERS, flips, fuzz, studies
from tests.fuzz.answers import Row, TooSlow, WrongError, answer
from tests.fuzz.forgeries import FORGERIES
from tests.fuzz.planning import fuzzed_folder

SAMPLE = {"bit flips in files of studies": 36, "bit flips in files of caches": 60} | dict.fromkeys(FORGERIES, 2)
"""Numbers of inputs in the fast tests; of other kinds 8."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that fuzzers share."""
    return tmp_path_factory.mktemp("fuzz").resolve()


@pytest.mark.parametrize("kind", FUZZERS)
def test_a_few_inputs_get_an_answer(kind: str, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flips, "DRAWN", 36)
    wanted = SAMPLE.get(kind, 8)
    row = fuzz(kind, root, wanted / FUZZERS[kind][1])
    assert row.inputs == wanted and not row.wrong


@pytest.mark.slow
@pytest.mark.parametrize("kind", FUZZERS)
def test_thousands_of_inputs_get_an_answer(kind: str, root: Path) -> None:
    """Some are refused."""
    row = fuzz(kind, root)
    assert not row.wrong
    assert row.codes[2] > row.inputs / 20


def test_every_wrong_answer_is_counted() -> None:
    row = Row("options")
    for error in (WrongError("a"), KeyError("b"), TooSlow()):
        with row.counting(["compare"]):
            raise error
    with row.counting(["compare"]):
        pass
    assert row.inputs == 4 and len(row.wrong) == 3 and row.wrong[0] == "options: ['compare']: WrongError a"
    with pytest.raises(KeyboardInterrupt), row.counting(["compare"]):
        raise KeyboardInterrupt


@pytest.fixture
def folder(root: Path) -> Iterator[Path]:
    with fuzzed_folder(root / "inputs") as path:
        yield path


def test_the_fuzzer_finds_a_traceback_and_an_exit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a command must not do is noticed."""

    def broken(error: BaseException) -> Callable[..., None]:
        def plan(*_: Any, **__: Any) -> None:
            raise error

        return plan

    for error in (KeyError("theta"), SystemExit(0), TooSlow()):
        monkeypatch.setattr(plan_module, "plan_study", broken(error))
        with pytest.raises((KeyError, WrongError, TooSlow)):
            answer(["compare", "pusher"], folder)

    def touching(*_: Any, **__: Any) -> None:
        (folder / "policy.json").write_text("mine")
        raise ValueError("and refuses")

    monkeypatch.setattr(plan_module, "plan_study", touching)
    with pytest.raises(WrongError, match="a file was touched"):
        answer(["compare", "pusher"], folder)
    with pytest.raises(WrongError, match="exit code 2 of"):
        answer(["compare", "nobody"], folder, refuse=False)


def test_a_flip_that_is_believed_is_counted(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without digests, flips change content."""
    monkeypatch.setattr(caches, "undigested", lambda content: content[caches.LENGTH :])
    assert flips.flip("bit flips in files of caches", 1, root).wrong


def test_a_flip_that_changes_a_study_is_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the digest of study.json, other texts and numbers are read."""
    monkeypatch.setattr(document, "digest_of_json", lambda _: "0")
    monkeypatch.setattr(studies, "STUDIES", {"landscapes": studies.STUDIES["landscapes"]})
    assert flips.flip("bit flips in files of studies", 40, tmp_path).wrong
