"""Arrays on disk: what is written is read, and what a forged file promises is neither unpacked nor believed."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimators.merged_samples import moments_of
from mjx_study.experiment.merged_samples import Blocks, pack
from mjx_study.experiment.study import Checkpoint, StudyError
from mjx_study.experiment.tally import Tally
from mjx_study.limits import MOST_GIB
from mjx_study.storage import arrays as module
from mjx_study.storage.arrays import read_arrays
from mjx_study.storage.folder import Store
from tests.documents import cell_arrays, study_document
from tests.fuzz.forgeries import npy, packed


def test_arrays_come_back(tmp_path: Path) -> None:
    path, rng = tmp_path / "arrays.npz", np.random.default_rng(0)
    given = {"a": rng.normal(size=(2, 3)), "b": np.asfortranarray(rng.normal(size=(3, 2))), "c": np.array(["x", "yz"]),
             "d": np.array(3), "e": np.zeros((0, 4)), "f": np.array(""), "g": np.array([True])}  # fmt: skip
    with path.open("wb") as file:
        np.savez(file, **given)
    found = read_arrays(path.read_bytes())
    assert found.keys() == given.keys() and all(found[name].dtype == given[name].dtype for name in given)
    for name, array in given.items():
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (packed({"a.npy": npy((1,), content=bytes(8))}, zipfile.ZIP_DEFLATED), "its arrays are compressed"),
        (packed({"a.npy": npy((10**5,), content=bytes(8 * 10**5))}, zipfile.ZIP_DEFLATED), "arrays are larger than"),
        (packed({"a.npy": npy((2,), content=bytes(8))}), "an array differs in size from its header"),
        (packed({"a.npy": npy((1,), "|O", bytes(8))}), "an array differs in size from its header"),
        (packed({"a.npy": npy((1,), version=b"\x03\x00", content=bytes(8))}), "an array is in version 3.0 of NumPy's"),
        (packed({"a.npy": npy((0,)), "a": npy((0,))}), "it holds a twice"),
    ],
    ids=["compressed", "larger", "size", "objects", "version", "twice"],
)
def test_other_files_are_refused(content: bytes, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        read_arrays(content)


def test_a_file_of_too_many_arrays_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_MEMBERS", 2)
    with pytest.raises(ValueError, match="it holds more than 2 arrays"):
        read_arrays(packed({name: npy((0,)) for name in "abc"}))


def test_a_checkpoint_may_be_as_large_as_the_memory_of_a_plan() -> None:
    assert module.MOST_CELL_BYTES >= MOST_GIB * 2**30


DOCUMENT = study_document(2)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"variance": np.zeros((2, 1))}, r"variance has shape \(2, 1\); the study needs \(1, 1\)"),
        ({"variance": np.zeros((1, 1), complex)}, "variance is of type complex128, not a number"),
        ({"residual": np.zeros(3)}, r"residual has shape \(3,\); the study needs \(1,\)"),
        ({"reference_norm": np.zeros(1)}, r"reference_norm has shape \(1,\); the study needs \(\)"),
        ({"gradient": np.zeros((1, 1, 5))}, r"gradient has shape \(1, 1, 5\); the study needs \(1, 1, 1\)"),
        ({"metric_way": np.zeros(2)}, "metric_way has shape"),
        ({"variance": None}, "it has no variance"),
        ({"nonfinite": np.full((1, 1), np.nan)}, "nonfinite is no count"),
        ({"nonfinite": np.full((1, 1), 1e300)}, "nonfinite is no count"),
        ({"unconverged": np.full(1, -1.0)}, "unconverged is no count"),
    ],
)
def test_a_cell_has_the_variables_of_its_study(changes: dict[str, Any], says: str, tmp_path: Path) -> None:
    store = Store.create(tmp_path, DOCUMENT)
    store.write(0, cell_arrays(DOCUMENT, 0))
    assert store.read(0).keys() == cell_arrays(DOCUMENT, 0).keys()
    changed = cell_arrays(DOCUMENT, 1) | changes
    store.write(1, {name: array for name, array in changed.items() if array is not None})
    with pytest.raises(
        StudyError, match=f"00001.npz does not fit the study .{says}.*; move it away to compute it again"
    ):
        store.read(1)


# Checkpoints.


def summary(rows: int = 6, params: int = 3) -> dict[str, Any]:
    rng = np.random.default_rng(0)
    moments = moments_of((rng.normal(size=(rows, params)),), 0, 1)
    tally = Tally(np.array(1.0), np.array(0.0), np.array(0), np.zeros(9))
    return {"0.0": moments[0], "evaluation": tally}


def checked(kept: dict[str, np.ndarray]) -> None:
    with Checkpoint(name="00000.part.npz").restored():
        Blocks(1, 4, kept).check(["0"], ["evaluation"], 3)


def node(place: str, found: dict[str, Any]) -> dict[str, np.ndarray]:
    return {f"{place}.{name}": array for name, array in pack(found).items()}


def test_blocks_of_a_checkpoint_fit_or_are_refused() -> None:
    whole = node("0.0.1", summary())
    checked(whole | node("0.1.1", summary()) | {"reference": np.zeros((5, 3))})
    refused: list[tuple[dict[str, np.ndarray], str]] = [
        (node("0.0.9", summary()), "it has a block 0.0.9"),
        (node("0.0.1", summary()) | node("0.1.0", summary()), "it has a block twice"),
        (node("0.0.1", {"evaluation": summary()["evaluation"]}), "block 0.0.1 is of evaluation"),
        (whole | {"0.0.1.0.0.mean": np.zeros((1, 2))}, "mean|extremes"),
        (whole | {"0.0.1.0.0.count": np.array(1.5)}, "count"),
        (whole | {"0.0.1.evaluation.onsets": np.zeros(3)}, "onsets"),
        (whole | {"reference": np.zeros((5, 2))}, "its reference has shape"),
        (whole | {"nonsense": np.zeros(3)}, "not enough values to unpack"),
        ({name: array for name, array in whole.items() if "scatter" not in name}, "scatter"),
        (whole | {"0.0.1.0.0.more": np.zeros(3)}, "more"),
        (
            whole | node("0.0.0", summary() | {"0.0": moments_of([np.zeros((4, 3))] * 2, 0, 1)[2]}),
            "differ in their parts",
        ),
    ]
    for kept, says in refused:
        with pytest.raises(StudyError, match=f"(?s)00000.part.npz does not fit the study .*(?:{says}).*; move it away"):
            checked(kept)
