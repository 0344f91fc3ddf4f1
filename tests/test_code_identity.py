"""The code that results depend on is all that a study imports while it computes, and nothing beyond."""

import hashlib
import shutil
from pathlib import Path

import pytest

from mjx_study.choices import KINDS
from mjx_study.digest import FORMER, digest_of
from mjx_study.identity import NOT_COMPUTING, computing_code, contents
from mjx_study.reference import MomentumTransfer
from mjx_study.tasks import make_task
from tests.test_layering import FILES, LAYERS, ROOT, module_of, read

RUN = "mjx_study.execution.run"
IMPORTS = {module_of(path): read(path) for path in FILES}
PATHS = {module_of(path): path.relative_to(ROOT) for path in FILES}
PACKAGED = [
    path.relative_to(ROOT)
    for package in ("estimators", "mjx_study")
    for path in sorted((ROOT / package).rglob("*"))
    if path.is_file() and path.suffix != ".pyc"
]
NO_CODE = {"estimators/py.typed", "mjx_study/py.typed", "mjx_study/templates/report.html"}


def imported_by(*roots: str) -> set[str]:
    """Modules, and all that they import, directly or not, at their top or within functions; packages included.

    What the package itself imports is for type checkers and for `mjx_study.NAME`, and kinds of study import figures
    where these are drawn, which no computation does.
    """
    found, waiting = set(), [*roots]
    while waiting:
        name = waiting.pop()
        if name in IMPORTS and name not in found:
            found.add(name)
            figures = {each for each in IMPORTS[name] if name in KINDS.values() and each.startswith("mjx_study.plots.")}
            imported = IMPORTS[name] - figures if name != "mjx_study" else set()
            waiting += [*imported, name.rpartition(".")[0]]
    return found


def counts(path: Path) -> bool:
    """Whether a change of a file changes the digest: any file of the packages, unless it is known not to compute."""
    return str(path) not in NO_CODE and (path.parts[0] != "mjx_study" or path.parts[1] not in NOT_COMPUTING)


def test_all_that_a_study_imports_counts() -> None:
    static = imported_by(RUN, *KINDS.values())
    assert {"mjx_study.simulation.dynamics", "mjx_study.experiment.gradients"} <= static
    assert not [name for name in static if not counts(PATHS[name])]


def test_parts_above_execution_do_not_count() -> None:
    above = LAYERS[LAYERS.index("mjx_study.execution") + 1 :]
    names = {path.parts[1] for path in PATHS.values() if path.parts[0] == "mjx_study"}
    assert names >= NOT_COMPUTING
    assert {name.partition(".")[2] for name in above} <= {part.removesuffix(".py") for part in NOT_COMPUTING} | {""}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A copy of the sources."""
    for path in PACKAGED:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / path, tmp_path / path)
    return tmp_path


def test_a_change_of_a_file_changes_the_digest_if_the_file_counts(tree: Path) -> None:
    def digest() -> str:
        return computing_code.__wrapped__(tree / "mjx_study")

    before = digest()
    assert before == computing_code()
    assert {"mjx_study/simulation/dynamics.py", "mjx_study/graph/prelude.c"} <= set(map(str, PACKAGED))
    for path in PACKAGED:
        content = (tree / path).read_bytes()
        (tree / path).write_bytes(content + b"# changed\n")
        assert (digest() != before) is counts(path), path
        (tree / path).write_bytes(content)


TASKS_OF_0_1 = {
    "pusher": "5b28e22fc7986058",
    "sliding_box": "811bb5ec7f975d5a",
    "ball_wall": "5973a39ce012e441",
    "momentum_transfer": "09286b973cffa55f",
    "tennis": "03caf6341cb9ce0e",
    "double_pendulum": "67326dfa2023e920",
}


@pytest.mark.parametrize("name", TASKS_OF_0_1)
def test_folders_of_built_in_tasks_are_recognised(name: str) -> None:
    """Those of version 0.1.0: another digest refuses every unfinished study of the task."""
    assert contents({name: [make_task(name)]})[f"task {name}"] == TASKS_OF_0_1[name]


def test_a_moved_class_keeps_its_digest() -> None:
    """Classes of this package are digested by name alone; folders of tasks that hold one outlive a move."""
    assert FORMER.keys() <= IMPORTS.keys() and not IMPORTS.keys() & set(FORMER.values())
    text = "class\0mjx_study.reference.launch\0MomentumTransfer\0\n"
    assert digest_of(MomentumTransfer) == hashlib.sha256(text.encode()).hexdigest()[:16]
