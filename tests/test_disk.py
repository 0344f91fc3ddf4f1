"""Faults of the disk and of processes: no half-written file, no lost one, one line, no wait."""

import errno
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from mjx_study.disk import TEMPORARY, prepare_folder, read_whole, temporary_name, write_whole
from mjx_study.experiment.study import StudyError
from mjx_study.storage.dataset import write_dataset
from mjx_study.storage.folder import Store
from tests.documents import cell_arrays, study_document
from tests.faults import NO_FILES, deadline, every_fault, put_no_file
from tests.processes import run_script

CELLS = 2
DOCUMENT = study_document(CELLS)


def numbers(index: int) -> dict[str, np.ndarray]:
    values = np.random.default_rng(index).normal(size=3000)  # more than a buffer, so that a write is several
    return cell_arrays(DOCUMENT, index, values=values)


def study(folder: Path) -> Store:
    """Begin or resume a study, and write the missing cells."""
    store = Store.create(folder, DOCUMENT)
    for index in store.missing:
        with store.claims() as claim:
            if claim(index):
                store.write(index, numbers(index))
    write_dataset(xr.Dataset({"values": ("value", np.arange(3000.0))}), folder / "results.nc")
    return store


def check_whole(folder: Path) -> int:
    """Number of cells, each with its own numbers; every other file is complete."""
    if not (folder / "study.json").exists():
        return 0
    store = Store.open(folder)
    there = [index for index in range(CELLS) if store.has(index)]
    for index in there:
        np.testing.assert_array_equal(store.read(index)["values"], numbers(index)["values"])
    return len(there)


def leftovers(folder: Path) -> list[Path]:
    return list(folder.rglob(f"*{TEMPORARY}"))


@pytest.mark.parametrize(
    ("code", "lasting"), [(errno.ENOSPC, False), (errno.EROFS, True)], ids=["full once", "read-only"]
)
def test_a_fault_at_any_write_keeps_complete_files(tmp_path: Path, code: int, lasting: bool) -> None:
    """A disk that is full once, or read-only from then on, at the first write of a study, the second, and so on."""
    folders = [tmp_path / "0"]
    for at in every_fault(code, lambda: study(folders[-1]), lasting=lasting):
        folder = folders[-1]
        before = check_whole(folder)
        assert leftovers(folder) == []  # the process lives, and removes what it began
        study(folder)
        assert check_whole(folder) == CELLS >= before
        folders.append(tmp_path / str(at + 1))
    assert len(folders) > 20


def test_a_fault_at_any_write_leaves_the_file_before(tmp_path: Path) -> None:
    path = write_whole(tmp_path / "file", lambda file: file.write(b"before"))
    new = b"x" * 30_000
    points = 0
    for at in every_fault(errno.ENOSPC, lambda: write_whole(path, lambda file: file.write(new))):
        assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]
        points = at + 1
    assert points >= 4 and path.read_bytes() == new


KILLED = """
import sys
from pathlib import Path
import numpy as np
from mjx_study.disk import TEMPORARY, prepare_folder, write_whole
from tests.faults import killed_at_every_system_call

folder = Path(sys.argv[1])
path = folder / "file"
old, new = b"o" * 20_000, b"n" * 30_000
write_whole(path, lambda file: file.write(old))
points = left = changed = 0
for points, _ in enumerate(killed_at_every_system_call(lambda: write_whole(path, lambda file: file.write(new))), 1):
    assert path.read_bytes() in (old, new), points
    changed += path.read_bytes() == new
    left += len(list(folder.glob(f".*{TEMPORARY}")))
    prepare_folder(folder)
    assert list(folder.iterdir()) == [path], points
    write_whole(path, lambda file: file.write(old))
assert path.read_bytes() == new
print(points, left, changed)
"""


def test_killed_at_any_system_call_a_file_is_the_old_or_the_new_one(tmp_path: Path) -> None:
    """Temporary files of the dead process are removed when the folder is next opened."""
    points, left, changed = map(int, run_script(KILLED, tmp_path).stdout.split())
    assert points > 20 and left > 5 and changed >= 2


KILLED_STUDY = """
import sys
from pathlib import Path
from tests.faults import killed_at_every_system_call
from tests.test_disk import CELLS, check_whole, leftovers, study

root = Path(sys.argv[1])
folders = [root / "0"]
for at in killed_at_every_system_call(lambda: study(folders[-1])):
    before = check_whole(folders[-1])
    study(folders[-1])
    assert check_whole(folders[-1]) == CELLS >= before and leftovers(folders[-1]) == [], at
    folders.append(root / str(at + 1))
print(len(folders) - 1)
"""


@pytest.mark.slow
def test_killed_at_any_system_call_a_study_goes_on(tmp_path: Path) -> None:
    assert int(run_script(KILLED_STUDY, tmp_path).stdout) > 200


def test_what_a_living_process_writes_stays(tmp_path: Path) -> None:
    """Leftovers are known by their lock, not by their age; other programs' files are not touched."""
    (tmp_path / ".hidden").write_text("another program's")
    (tmp_path / temporary_name("old")).write_text("a dead process's")

    def opening(file: Any) -> None:
        file.write(b"whole")
        prepare_folder(tmp_path)
        assert len(leftovers(tmp_path)) == 1

    path = write_whole(tmp_path / "file", opening)
    assert path.read_bytes() == b"whole" and {each.name for each in tmp_path.iterdir()} == {".hidden", "file"}


@pytest.mark.parametrize("kind", [*NO_FILES, "link"])
def test_non_regular_files_are_refused_at_once(tmp_path: Path, kind: str) -> None:
    """Nor are links followed, or locked, to a file that would do."""
    folder = tmp_path / "study"
    study(folder)

    def replaced(name: str) -> str:
        path = folder / name
        kept = path.rename(tmp_path / path.name) if path.exists() else tmp_path / path.name
        put_no_file(path, kind) if kind != "link" else path.symlink_to(kept)
        return path.name

    with deadline(5):
        for name, read in (("00001.npz", Store.read), ("00001.part.npz", Store.read_part)):
            replaced(f"cells/{name}")
            with pytest.raises(StudyError, match=f"{name} is damaged .*; move it away to compute it again"):
                read(Store.open(folder), 1)
        replaced("study.lock")
        with pytest.raises(StudyError, match="cannot lock .*study.lock"), Store.open(folder).claims():
            pass
        replaced("study.json")
        for begin in (lambda: Store.open(folder), lambda: Store.create(folder, DOCUMENT)):
            with pytest.raises(StudyError, match="cannot read .*study.json"):
                begin()
        put_no_file(tmp_path / temporary_name("x"), kind if kind != "link" else "device")
        prepare_folder(tmp_path)


def test_a_link_for_the_folder_of_cells_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    study(folder)
    (folder / "cells").rename(tmp_path / "cells")
    (folder / "cells").symlink_to(tmp_path / "cells")
    with pytest.raises(StudyError, match="cannot read .*cells: it is a symbolic link"):
        Store.open(folder)
    (folder / "study.json").unlink()
    with pytest.raises(ValueError, match="cannot write to the output folder .*cells: it is a symbolic link"):
        Store.create(folder, DOCUMENT)


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    study(tmp_path)
    with (tmp_path / "cells" / "00001.npz").open("wb") as file:
        file.truncate(10**12)
    with pytest.raises(StudyError, match="00001.npz.*it has 1000000000000 bytes"):
        Store.open(tmp_path).read(1)


def test_only_files_made_here_are_removed(tmp_path: Path) -> None:
    """A name that merely looks like a temporary one is somebody else's."""
    mine = [f"{name}{TEMPORARY}" for name in (".notes", ".old.abcdefgh", f".study.json.{'0' * 12}{'1' * 12}", "a")]
    for name in mine:
        (tmp_path / name).write_text("mine")
    ours = [temporary_name(name) for name in ("study.json", "00001.npz", "with\nline", "\udcff")]
    for name in ours:
        (tmp_path / name).write_text("left")
    copied = tmp_path / ours[0].replace("study.json", "study.toml")
    copied.write_text("mine")
    prepare_folder(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {*mine, copied.name}


def test_a_read_only_disk_can_be_read(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    study(folder)
    assert check_whole(folder) == CELLS  # whose errors the loop takes for faults
    for _ in every_fault(errno.EROFS, lambda: check_whole(folder), lasting=True):
        pytest.fail("reading a study wrote")
    assert json.loads(read_whole(folder / "study.json"))["config"] == DOCUMENT["config"]
    assert os.access(folder, os.R_OK)
