"""What holds for every kind of study: a table of kinds and properties, and numbers that stay what they were."""

import ast
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import mjx_study.report  # noqa: F401  # registers `Dataset.mjx_study`
from mjx_study.choices import KINDS
from mjx_study.execution import cells
from mjx_study.execution.cells import Cells, compute_here
from mjx_study.execution.forecast import forecast_study
from mjx_study.execution.run import run_study
from mjx_study.experiment import descents
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import StudyError
from mjx_study.options.configuration import StudyConfig
from mjx_study.progress import silent
from mjx_study.report import render_report
from mjx_study.results.kind import find_kind, findings_of
from mjx_study.results.warnings import warnings_of
from mjx_study.storage import arrays as cell_files
from mjx_study.storage import folder
from mjx_study.storage.arrays import required
from mjx_study.storage.folder import Store, load_study
from tests.documents import MEASURED, content, same, study_document
from tests.faults import Killed, kill_after
from tests.processes import ROOT
from tests.test_layering import FILES

NUMBERS = Path(__file__).parent / "data" / "kinds.json"
"""Sums of the absolute finite values of every variable, per kind of study."""
COMMON: dict[str, Any] = {"tasks": ("ball_wall",), "contact": ("reference",), "stiffness": (300.0, 3000.0), "seeds": 2}
STUDIES: dict[str, dict[str, Any]] = {
    "gradients": {"estimators": ("zobg", "fobg", "aobg"), "samples": (6, 9), "reference_samples": 20},
    "blocks": {"estimators": ("zobg", "aobg"), "samples": (20,), "block_size": 8, "reference_samples": 20},
    "descents": {"estimators": ("zobg", "fobg"), "samples": (5,), "iterations": 12, "evaluation_samples": 6},
    "landscapes": {"estimators": ("zobg", "fobg"), "samples": (6,), "points": 3},
}
"""A small study of each kind, of two contact models, and one in blocks."""
FIGURES = {
    "gradients": {"variance", "error_against_samples", "alpha", "map_stiffness_samples"},
    "blocks": {"variance", "alpha"},
    "descents": {"achieved", "descent"},
    "landscapes": {"landscape"},
}
each_kind = pytest.mark.parametrize("name", STUDIES)


def config(name: str, **changes: Any) -> StudyConfig:
    return StudyConfig(**(COMMON | STUDIES[name] | changes))


@pytest.fixture(scope="module")
def studies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A folder of each study, computed without disturbance."""
    found = {name: tmp_path_factory.mktemp("kinds") / name for name in STUDIES}
    for name, path in found.items():
        run_study(config(name), path)
    return found


@pytest.fixture
def copy(studies: dict[str, Path], tmp_path: Path, name: str) -> Path:
    """A copy of one of the folders."""
    return Path(shutil.copytree(studies[name], tmp_path / "copy"))


@each_kind
def test_a_folder_holds_what_a_run_returns(studies: dict[str, Path], name: str) -> None:
    """As does memory; and every variable has a unit and a name, and a cell all that its kind requires."""
    loaded = load_study(studies[name])
    assert same(run_study(config(name)), loaded) and loaded.attrs["missing_cells"] == 0
    assert not same(run_study(config(name, seed=1)), loaded)
    with xr.open_dataset(studies[name] / "results.nc") as stored:
        assert stored.equals(loaded)
    assert set(required(find_kind(config(name).settings.kind))) <= set(loaded)
    assert all(each.attrs["units"] and each.attrs["long_name"] for each in loaded.data_vars.values())


@each_kind
def test_numbers_are_those_of_earlier_versions(studies: dict[str, Path], name: str) -> None:
    """Up to rounding, which depends on the processor."""
    loaded, expected = load_study(studies[name]), json.loads(NUMBERS.read_text())[name]
    found = {str(key): float(np.nansum(np.abs(each.values))) for key, each in loaded.items() if key not in MEASURED}
    assert found.keys() == expected.keys()
    for key, value in found.items():
        assert value == pytest.approx(expected[key], rel=1e-6, abs=1e-12), key


@each_kind
def test_a_cell_depends_on_no_other(studies: dict[str, Path], name: str) -> None:
    """Computed in reverse order, the last one alone; bit for bit."""
    plan, kept = plan_study(config(name)), Store.open(studies[name])
    order = range(len(plan.cells))[::-1]
    for indices in (order, order[:1]):
        for index, arrays in compute_here(Cells(plan, plan.kind.computation(plan), silent), indices):
            stored = kept.read(index)
            for key in arrays.keys() - {*MEASURED, *(each for each in arrays if each.startswith("seconds"))}:
                np.testing.assert_array_equal(stored[key], arrays[key], err_msg=key)


@each_kind
@pytest.mark.parametrize("moment", [1, 2])
def test_a_killed_run_resumes_to_the_same_numbers(
    studies: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, moment: int
) -> None:
    """Killed after one of its first writes of a cell or a checkpoint."""
    with monkeypatch.context() as patch:
        written = kill_after(patch, lambda path, count: count == moment)
        for module in (descents, cells):
            patch.setattr(module, "SAVE_SECONDS", 0.0)
        with pytest.raises(Killed):
            run_study(config(name), tmp_path)
    assert load_study(tmp_path).attrs["missing_cells"] or len(written) == len(list(tmp_path.glob("cells/*")))
    assert same(run_study(config(name), tmp_path), load_study(studies[name]))
    assert not list(tmp_path.glob("cells/*.part.npz"))


@each_kind
def test_only_missing_cells_are_computed(copy: Path, studies: dict[str, Path], name: str) -> None:
    before = content(copy)
    (copy / "cells" / "00001.npz").unlink()
    assert any("1 cells are not computed yet" in each for each in warnings_of(load_study(copy)))
    found = run_study(config(name), copy)
    assert found.attrs["computed_cells"] == 1 and same(found, load_study(studies[name]))
    assert {path.name for path, written in content(copy).items() if written != before[path]} <= {
        "00001.npz",
        "results.nc",
    }
    assert run_study(config(name), copy).attrs["computed_cells"] == 0


@each_kind
def test_a_folder_of_another_study_is_refused_and_left_alone(copy: Path, name: str) -> None:
    before = content(copy)
    with pytest.raises(StudyError, match="holds another study .seed 0 there and 1 here.; choose another folder"):
        run_study(config(name, seed=1), copy)
    assert content(copy) == before


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        *((name, "flipped") for name in STUDIES),
        *(("blocks", each) for each in ("truncated", "foreign", "nonsense", "swapped")),
    ],
)
def test_a_damaged_cell_is_refused_and_left_alone(copy: Path, tmp_path: Path, name: str, damage: str) -> None:
    path = copy / "cells" / "00001.npz"
    written, says = path.read_bytes(), "is damaged"
    if damage == "foreign":
        other, says = Store.create(tmp_path / "other", study_document(2)), "is a cell of another study"
        other.write(1, Store.open(copy).read(1))
        damaged = other.path(1).read_bytes()
    elif damage == "swapped":
        damaged, says = (copy / "cells" / "00000.npz").read_bytes(), "is another cell of this study"
    else:
        number = written.index(max(Store.open(copy).read(1).values(), key=np.size).tobytes()) + 1
        flipped = written[:number] + bytes([written[number] ^ 4]) + written[number + 1 :]
        damaged = {"truncated": written[:number], "flipped": flipped, "nonsense": b"nonsense"}[damage]
    path.write_bytes(damaged)
    for use in (lambda: run_study(config(name), copy), lambda: load_study(copy)):
        with pytest.raises(StudyError, match=f"00001.npz {says}.*; move it away to compute it again"):
            use()
    assert path.read_bytes() == damaged


@each_kind
def test_a_write_that_fails_keeps_the_cells_before_it(
    studies: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """As on a full disk: the run ends, or goes on in memory; the same command computes the rest."""
    whole, written = cell_files.write_whole, list[Path]()

    def failing(path: Path, write: Any) -> Path:
        if path.name.endswith("1.npz") or path.suffix == ".nc":
            raise OSError(28, "No space left on device")
        written.append(path)
        return whole(path, write)

    with monkeypatch.context() as patch:
        for module in (folder, cell_files):
            patch.setattr(module, "write_whole", failing)
        with pytest.raises(OSError, match="No space left"):
            run_study(config(name), tmp_path)
        kept = run_study(config(name), tmp_path, keep_going=True)
    assert "No space left on device" in kept.attrs["unwritten"] and same(kept, load_study(studies[name]))
    assert 1 in Store.open(tmp_path).missing and 0 not in Store.open(tmp_path).missing
    assert same(run_study(config(name), tmp_path), load_study(studies[name]))


@each_kind
def test_a_study_is_drawn_reported_and_tabulated(studies: dict[str, Path], copy: Path, name: str) -> None:
    found = load_study(studies[name])
    figures = found.mjx_study.plot()
    assert set(figures) == FIGURES[name]
    for figure in figures.values():
        panels = [(axes, axes.get_subplotspec()) for axes in figure.axes]
        lowest = [axes for axes, panel in panels if panel is not None and panel.is_last_row()]
        assert lowest and all(axes.get_xlabel() or axes.get_xticklabels() for axes in lowest)
        assert any(axes.get_ylabel() for axes in figure.axes)
    assert found.mjx_study.findings() == findings_of(found) and len(found.mjx_study.table()) >= 2
    page = render_report(found)
    assert page.count("data:image/png;base64,") == len(FIGURES[name])
    assert all(f'alt="{figure}: ' in page for figure in figures) and "jaxlib" in page
    assert "://" not in page and "<script" not in page  # it needs nothing else; figures may spell "http" by chance
    assert page.count("<td>FoBG</td>") == 2 * ("fobg" in found["estimator"].values)
    first, *others = sorted((copy / "cells").iterdir())
    first.unlink()
    partly = set(load_study(copy).mjx_study.plot())
    assert partly and partly <= FIGURES[name]
    for path in others:
        path.unlink()
    empty = load_study(copy)
    assert empty.mjx_study.plot() == {} and findings_of(empty) == [] and "no cell is computed" in render_report(empty)


@each_kind
def test_a_forecast_counts_what_is_computed(studies: dict[str, Path], copy: Path, name: str) -> None:
    """Sizes are exact but for what is left out: no program is compiled for analytic systems."""
    plan = plan_study(config(name))
    found, finished = forecast_study(plan), forecast_study(plan, copy)
    held = [sum(array.nbytes for key, array in Store.open(copy).read(index).items() if key in plan.kind.variables)
            for index in range(len(plan.cells))]  # fmt: skip
    optional = 8 * sum(1000 for _ in plan.cells)
    assert sum(held) <= found.kept <= sum(held) + optional and found.programs == 0
    assert (found.cells, found.computed, finished.computed) == (len(held), 0, len(held))
    assert found.rollouts > found.gradients > 0 == finished.rollouts


@pytest.mark.slow
@each_kind
def test_a_cluster_finds_the_same_bits(workers: Any, studies: dict[str, Path], tmp_path: Path, name: str) -> None:
    assert same(run_study(config(name), tmp_path, cluster=workers), load_study(studies[name]))


def comparisons(source: str) -> Iterator[str]:
    """Comparisons with the name of a kind of study, and `isinstance` of a kind."""
    classes = {type(find_kind(name)).__name__ for name in KINDS}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Compare):
            named = {each.value for each in ast.walk(node) if isinstance(each, ast.Constant)}
            if named & KINDS.keys():
                yield ast.unparse(node)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
            if classes & {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}:
                yield ast.unparse(node)


def test_nothing_asks_for_the_kind_of_a_study() -> None:
    """Kinds are objects: what differs between them is theirs."""
    found = {str(path.relative_to(ROOT)): list(comparisons(path.read_text())) for path in FILES}
    assert {path: each for path, each in found.items() if each} == {}
    assert list(comparisons('kind == "descents" or isinstance(kind, Gradients)')) == [
        "kind == 'descents'", "isinstance(kind, Gradients)"
    ]  # fmt: skip
