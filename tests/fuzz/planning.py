"""Answer inputs at random by commands that plan, and compute nothing."""

import contextlib
import functools
import shutil
from collections.abc import Generator
from pathlib import Path
from typing import Any, Final

import mujoco
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjx_study import bench, cli, gradcheck, tasks
from mjx_study.choices import is_file
from mjx_study.claims import ledger
from mjx_study.cli import motions, options, studies
from mjx_study.diagnose import means
from mjx_study.diagnose import run as diagnosis
from mjx_study.execution import run
from mjx_study.experiment.plan import plan_study
from mjx_study.options.configuration import StudyConfig
from mjx_study.runtime import print_warning
from mjx_study.tasks import make_task
from tests.fuzz import strategies
from tests.fuzz.answers import Planned, Row, answer
from tests.fuzz.cases import CASES

UNCHECKED: Final = (HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example)


@contextlib.contextmanager
def fuzzed_folder(path: Path) -> Generator[Path]:
    """Make a folder the current one, with a study that is begun in it; nothing computes meanwhile."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        if not path.exists():
            path.mkdir(parents=True)
            config = StudyConfig(tasks=("pusher",), horizon=4, stiffness=(10.0, 100.0))
            run.open_store(plan_study(config), path / "study")
            shutil.copy(path / "study" / "study.json", path / "kept.json")
        monkeypatch.chdir(path)
        stub(monkeypatch)
        yield path


def stub(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let commands plan what they are asked for, and end with exit code 0 where they would compute.

    JAX's settings are those of the process. Parsers are built once, and tasks once for each set of options.
    """

    def planned(*_: Any, **__: Any) -> None:
        raise Planned

    begin = studies.open_store

    def opened(plan: Any, folder: Path, *more: Any, **named: Any) -> None:
        if str(folder) != "out":  # which has no study of others' options
            begin(plan, folder, *more, **named)
        raise Planned

    monkeypatch.setattr(options, "configure", lambda **_: None)
    mujoco.set_mju_user_warning(print_warning)  # as `configure` does
    for module, names in (
        (studies, ("_compute_in", "run_study")),
        (gradcheck, ("gradcheck",)), (means, ("check_mean",)), (bench, ("run_bench",)), (diagnosis, ("diagnose_task",)),
        (motions, ("_simulate_task", "_simulate_passive")), (ledger, ("measure_ledger",)),
    ):  # fmt: skip
        for name in names:
            monkeypatch.setattr(module, name, planned)
    monkeypatch.setattr(studies, "open_store", opened)
    monkeypatch.setattr(cli, "parser", _parser)
    for command in strategies.COMMANDS:
        strategies.flags_of(command)  # outside of strategies: building a parser uses the random module
    monkeypatch.setattr(
        tasks, "make_task", lambda name, **given: (make_task if is_file(name) else _built)(name, **given)
    )


_parser = functools.cache(cli.parser)
_built = functools.lru_cache(maxsize=256)(make_task)


def fuzz(kind: str, count: int, root: Path) -> Row:
    """Answer inputs of one of `CASES`."""
    row = Row(kind)

    @settings(max_examples=count, deadline=None, database=None, derandomize=True, suppress_health_check=UNCHECKED)
    @given(st.data())
    def cases(data: st.DataObject) -> None:
        (folder / "study" / "study.json").write_bytes(kept)
        arguments, refuse = CASES[kind](folder, data)
        with row.counting(arguments):
            row.codes[answer(arguments, folder, refuse=refuse)] += 1

    with fuzzed_folder(root / "inputs") as folder:
        kept = (folder / "kept.json").read_bytes()
        cases()
    return row
