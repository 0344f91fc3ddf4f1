"""Notebooks run from top to bottom, keep the outputs of one run, and use only public names."""

import ast
import os
import re
import resource
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

import mjx_study

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LARGEST = 300_000
"""Largest notebook with its outputs [bytes]."""
LONGEST = 120
"""Limit of a full run with compiled programs, as the README promises [s]."""
SMALL = {
    "1_stiffness_sweep": "STIFFNESS, SEEDS, SAMPLES, REFERENCE_SAMPLES = (10.0, 1200.0), 3, 8, 40",
    "2_which_estimator": "SAMPLES, REFERENCE_SAMPLES, ITERATIONS = 8, 20, 3",
    "3_bring_your_own": (
        "STATES, SAMPLES, REFERENCE_SAMPLES, POINTS = 1, 8, 20, 3\n"
        "CONTACT, STIFFNESS, HORIZON = ('mujoco',), 1000.0, 100"
    ),
    "4_are_mjx_gradients_right": (
        "STATES, STEPS, FORCES, POINTS = 1, 5, 3, 3\nCONTACT, HORIZON = ('mujoco_default', 'smooth_onset'), 190"
    ),
    "5_identify_contact": "TOSSES, STEPS = 2, 60",
    "6_teach_a_robot": "STEPS, SAMPLES, UPDATES = 80, 2, 2",
    "7_teach_a_quadruped": "STEPS, SAMPLES, UPDATES, SEEDS, STARTS, SECONDS, PACE = 16, 2, 2, 1, 1, 0.4, 0.5",
}
"""Parameters of a short run."""
ABSOLUTE = re.compile(r"(?<![\w.~])/(?:home|root|Users|tmp|var|usr|opt|mnt|srv|private|proc)/|[A-Z]:\\\\")

each = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> nbformat.NotebookNode:
    return nbformat.read(path, as_version=4)


def code_cells(notebook: nbformat.NotebookNode) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def python(cell: Any) -> ast.Module:
    """Parse a cell's code without its magics."""
    return ast.parse("\n".join(line for line in cell.source.splitlines() if not line.startswith("%")))


def assigned(source: str) -> set[str]:
    return {node.id for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name)}


def shown(output: Any) -> list[str]:
    """Texts of an output."""
    if output.output_type == "stream":
        return [output.text]
    return [text for kind, text in output.get("data", {}).items() if kind.startswith("text/")]


def private(tree: ast.AST) -> list[str]:
    """Private names that code uses."""
    modules = [name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for name in [f"{node.module}"]]
    attributes = [node for node in ast.walk(tree) if isinstance(node, ast.Attribute)]
    ours = [node.attr for node in attributes if isinstance(node.value, ast.Name) and node.value.id == "mjx_study"]
    found = [name for name in ours if name not in mjx_study.__all__] + [name for name in modules if "._" in f".{name}"]
    return found + [node.attr for node in attributes if node.attr.startswith("_")]


def test_there_is_one_for_each_question() -> None:
    assert [path.stem for path in NOTEBOOKS] == list(SMALL)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder to run in."""
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))  # no start-up files of whoever runs the tests
    monkeypatch.delenv("XLA_FLAGS")  # a reader's programs are optimised
    path = tmp_path / "run"
    path.mkdir()
    return path


def execute(notebook: nbformat.NotebookNode, folder: Path, timeout: int = 600) -> float:
    """Run it in a kernel of its own, and return the processor time that the kernel took [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=timeout, kernel_name="python3", resources=resources).execute()  # raises errors
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert all(cell.execution_count for cell in code_cells(notebook))
    assert list(folder.iterdir()) == []
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.slow
@each
def test_runs(path: Path, folder: Path) -> None:
    """At a small size, without leaving files."""
    notebook = read(path)
    (parameters,) = [cell for cell in code_cells(notebook) if "parameters" in cell.metadata.get("tags", ())]
    assert assigned(SMALL[path.stem]) == assigned(parameters.source)
    parameters.source = SMALL[path.stem]
    execute(notebook, folder)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the number of cores cannot be set")
@each
def test_a_warm_run_takes_under_two_minutes(path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At full size on two cores; the first run compiles, the second is warm.

    What counts is the processor time of the kernel, user and system, so that whatever else the machine does has no part
    in it. By the clock, a run on an idle machine takes that long if one core does all the work, half if two share it.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", str(ROOT / ".pytest_cache" / "notebooks"))
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(cores)[:2])  # the kernel inherits it
    try:
        first, warm = (execute(read(path), folder, timeout=3600) for _ in range(2))
    finally:
        os.sched_setaffinity(0, cores)
    print(f"{path.stem}: {first:.0f} s of processor time, {warm:.0f} s warm")
    assert 1 < warm < LONGEST


@each
def test_outputs_come_from_one_complete_run(path: Path) -> None:
    cells = code_cells(read(path))
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.output_type == "error"]
    assert not [output.text for output in outputs if output.get("name") == "stderr"]
    assert not [text for output in outputs for text in shown(output) if "Traceback" in text or "Warning" in text]


@each
def test_outputs_reveal_nothing_of_the_machine(path: Path) -> None:
    notebook = read(path)
    texts = [cell.source for cell in notebook.cells]
    texts += [text for cell in code_cells(notebook) for output in cell.outputs for text in shown(output)]
    for text in texts:
        assert not ABSOLUTE.search(text) and str(ROOT) not in text, text
    assert {key for cell in notebook.cells for key in cell.metadata} <= {"tags"}
    assert set(notebook.metadata) == {"kernelspec", "language_info"}
    assert path.stat().st_size < LARGEST


@each
def test_the_title_asks_and_the_text_answers(path: Path) -> None:
    notebook = read(path)
    first, *rest = notebook.cells
    title, _, answer = first.source.partition("\n")
    assert first.cell_type == "markdown" and title.startswith("# ") and title.endswith("?")
    assert len(re.findall(r"\.(?:\s|$)", answer)) == 2, "an answer has two sentences"
    known = [text for cell in code_cells(notebook) for output in cell.outputs for text in shown(output)]
    known += [cell.source for cell in code_cells(notebook)]
    for number in re.findall(r"\d+(?:\.\d+)?", answer):
        assert any(number in text for text in known), f"{number} is nowhere in the code or its outputs"
    install, setup, *_ = [cell for cell in rest if cell.cell_type == "code"]
    assert install.metadata.tags == ["install"] and "mjx_study.configure()" in setup.source


def test_the_first_cell_installs_a_missing_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the wheel beside the notebook, with CUDA if there is a GPU; it does nothing if the package is installed."""
    (source,) = {code_cells(read(path))[0].source for path in NOTEBOOKS}
    commands: list[list[str]] = []
    monkeypatch.setattr("subprocess.run", lambda command, check: commands.append(command))
    monkeypatch.setattr("shutil.which", lambda _: "/somewhere/nvidia-smi")
    monkeypatch.chdir(tmp_path)
    exec(source, {})
    assert commands == []
    (tmp_path / "mjx_study-0.1.0-py3-none-any.whl").touch()
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    exec(source, {})
    ((*_, what),) = commands
    assert what == "mjx_study-0.1.0-py3-none-any.whl[cuda]"


@each
def test_only_public_names_are_used(path: Path) -> None:
    assert not [name for cell in code_cells(read(path)) for name in private(python(cell))]
