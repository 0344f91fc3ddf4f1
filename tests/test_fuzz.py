"""No input ends in a traceback or in no answer: thousands at random, of which the fast tests run a few."""

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjx_study.study import plan as plan_module
from mjx_study.study import run as sweep
from mjx_study.study.configuration import StudyConfig
from mjx_study.study.plan import plan_study
from tests import fuzzing

POLICY = {
    "task": "pusher", "estimator": "fobg", "seed": 0, "cost": 1.0, "contact": "mujoco", "stiffness": 1000.0,
    "damping": None, "cone": None, "model": None, "horizon": 4, "network": None, "theta": [0.0] * 4,
}  # fmt: skip


UNCHECKED = (HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current directory of every case, with a study that is begun."""
    path = tmp_path_factory.mktemp("fuzz")
    with pytest.MonkeyPatch.context() as monkeypatch:
        sweep.open_store(plan_study(StudyConfig(tasks=("pusher",), horizon=4, stiffness=(10.0, 100.0))), path / "study")
        shutil.copy(path / "study" / "study.json", path / "kept.json")
        monkeypatch.chdir(path)
        fuzzing.stub(monkeypatch)
        yield path


def options_(folder: Path, data: st.DataObject) -> list[str]:
    return data.draw(fuzzing.command_lines())


def toml(folder: Path, data: st.DataObject) -> list[str]:
    (folder / "study.toml").write_bytes(data.draw(fuzzing.toml_files()))
    return ["sweep", "--config", "study.toml", "--output", "out"]


def theta(folder: Path, data: st.DataObject) -> list[str]:
    (folder / "theta.json").write_bytes(data.draw(fuzzing.texts([0.0] * 4)))
    return ["compare", "pusher", "--horizon", "4", "--theta", "theta.json"]


def array(folder: Path, data: st.DataObject) -> list[str]:
    (folder / "theta.npy").write_bytes(data.draw(fuzzing.arrays()))
    return ["compare", "pusher", "--theta", "theta.npy"]


def policy(folder: Path, data: st.DataObject) -> list[str]:
    (folder / "policy.json").write_bytes(data.draw(fuzzing.texts(POLICY)))
    return ["rollout", "pusher", "--theta", "policy.json", "--output", "out"]


def mjcf(folder: Path, data: st.DataObject) -> list[str]:
    (folder / "mine.xml").write_bytes(data.draw(fuzzing.mjcf_files()))
    command = data.draw(st.sampled_from([["rollout"], ["rollout"], ["rollout"], ["gradcheck"]]))
    return [*command, "mine.xml"] + ["--output", "out"] * (command == ["rollout"])


def study(folder: Path, data: st.DataObject) -> list[str]:
    path = folder / "study" / "study.json"
    path.write_bytes(data.draw(fuzzing.texts(json.loads(path.read_text()))))
    return data.draw(
        st.sampled_from([["plot", "study", "--output", "out"], ["report", "study", "--output", "out/a.html"]])
    )


CASES: dict[str, Callable[[Path, st.DataObject], list[str]]] = {
    "options": options_, "toml": toml, "theta": theta, "array": array, "policy": policy, "mjcf": mjcf, "study": study,
}  # fmt: skip
"""By kind: writes a file at random, and gives the command that reads it."""


def run(kind: str, folder: Path, examples: int) -> Counter[int]:
    """Every case of a kind gets an answer; how many ended with which exit code."""
    codes: Counter[int] = Counter()
    kept = (folder / "kept.json").read_bytes()

    @settings(max_examples=examples, deadline=None, database=None, derandomize=True, suppress_health_check=UNCHECKED)
    @given(st.data())
    def cases(data: st.DataObject) -> None:
        (folder / "study" / "study.json").write_bytes(kept)
        codes[fuzzing.answer(CASES[kind](folder, data), folder)] += 1

    cases()
    return codes


@pytest.mark.parametrize("kind", CASES)
def test_a_few_inputs_get_an_answer(kind: str, folder: Path) -> None:
    run(kind, folder, 8)


@pytest.mark.slow
@pytest.mark.parametrize("kind", CASES)
def test_thousands_of_inputs_get_an_answer(kind: str, folder: Path) -> None:
    """Some are refused and, but for files that are seldom right, some are planned; figures with -rP."""
    codes = run(kind, folder, 2000)
    print(f"{kind}: {fuzzing.tally(codes)}")
    assert codes[2] > 100


def test_the_fuzzer_finds_a_traceback_and_an_exit(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a command must not do is noticed."""

    def broken(error: BaseException) -> Callable[..., None]:
        def plan(*_: Any, **__: Any) -> None:
            raise error

        return plan

    for error in (KeyError("theta"), SystemExit(0), fuzzing.TooSlow()):
        monkeypatch.setattr(plan_module, "plan_study", broken(error))
        with pytest.raises((KeyError, AssertionError, fuzzing.TooSlow)):
            fuzzing.answer(["compare", "pusher"], folder)

    def touching(*_: Any, **__: Any) -> None:
        (folder / "policy.json").write_text("mine")
        raise ValueError("and refuses")

    monkeypatch.setattr(plan_module, "plan_study", touching)
    with pytest.raises(AssertionError, match="a file was touched"):
        fuzzing.answer(["compare", "pusher"], folder)
