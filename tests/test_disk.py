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
from tests.faults import deadline, every_fault, put_no_file
from tests.processes import run_script

CELLS = 3
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
    ("code", "lasting"),
    [(errno.ENOSPC, False), (errno.EROFS, True)],
    ids=["full once", "read-only"],
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


@pytest.mark.parametrize("kind", ["fifo", "socket", "folder", "device"])
def test_non_regular_files_are_refused_at_once(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "study"
    study(folder)
    with deadline(5):
        put_no_file(folder / "cells" / "00001.npz", kind)
        with pytest.raises(StudyError, match="00001.npz is damaged .*; move it away to compute it again"):
            Store.open(folder).read(1)
        put_no_file(folder / "cells" / "00002.part.npz", kind)
        with pytest.raises(StudyError, match="00002.part.npz is damaged .*; move it away to compute it again"):
            Store.open(folder).read_part(2)
        put_no_file(folder / "study.lock", kind)
        with pytest.raises(StudyError, match="cannot lock .*study.lock"), Store.open(folder).claims():
            pass
        put_no_file(folder / "study.json", kind)
        with pytest.raises(StudyError, match="cannot read .*study.json"):
            Store.open(folder)
        with pytest.raises(StudyError, match="cannot read .*study.json"):
            Store.create(folder, DOCUMENT)
        put_no_file(tmp_path / temporary_name("x"), kind)
        prepare_folder(tmp_path)


def test_a_link_in_a_study_is_refused_and_not_followed(tmp_path: Path) -> None:
    folder, outside = tmp_path / "study", tmp_path / "outside"
    study(folder)
    outside.mkdir()

    def linked(path: Path, target: Path) -> None:
        path.unlink(missing_ok=True)
        path.symlink_to(target)

    whole = (folder / "cells" / "00001.npz").read_bytes()
    (outside / "cell").write_bytes(whole)
    linked(folder / "cells" / "00001.npz", outside / "cell")
    with pytest.raises(StudyError, match="00001.npz is damaged .it is a symbolic link.; move it away"):
        Store.open(folder).read(1)
    (folder / "cells" / "00001.npz").unlink()
    linked(folder / "study.lock", outside / "new")
    with (
        pytest.raises(StudyError, match="cannot lock .*study.lock: it is a symbolic link"),
        Store.open(folder).claims(),
    ):
        pass
    os.rename(folder / "cells", tmp_path / "cells")
    (folder / "cells").symlink_to(tmp_path / "cells")
    with pytest.raises(StudyError, match="cannot read .*cells: it is a symbolic link"):
        Store.open(folder)
    (folder / "study.json").unlink()
    with pytest.raises(ValueError, match="cannot write to the output folder .*cells: it is a symbolic link"):
        Store.create(folder, DOCUMENT)
    assert [path.name for path in outside.iterdir()] == ["cell"]


def test_a_file_that_is_too_large_is_not_read(tmp_path: Path) -> None:
    with (tmp_path / "file").open("wb") as file:
        file.truncate(10**12)
    with pytest.raises(OSError, match="it has 1000000000000 bytes; the limit is 100"):
        read_whole(tmp_path / "file", most=100)
    for folder, name in ((tmp_path / "one", "study.json"), (tmp_path / "two", "cells/00001.npz")):
        study(folder)
        with (folder / name).open("wb") as file:
            file.truncate(10**12)
        with pytest.raises(StudyError, match=f"{Path(name).name}.*it has 1000000000000 bytes"):
            Store.open(folder).read(1)


def test_only_files_made_here_are_removed(tmp_path: Path) -> None:
    """A name that merely looks like a temporary one is somebody else's."""
    mine = [
        f".notes{TEMPORARY}",
        f".old.abcdefgh{TEMPORARY}",
        f".study.json.{'0' * 12}{'1' * 12}{TEMPORARY}",
        f"a{TEMPORARY}",
    ]
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
    for _ in every_fault(errno.EROFS, lambda: check_whole(folder), lasting=True):
        pytest.fail("reading a study wrote")
    assert json.loads(read_whole(folder / "study.json"))["config"] == DOCUMENT["config"]
    assert os.access(folder, os.R_OK)
