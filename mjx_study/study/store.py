"""A study's folder: its configuration, one file per cell, and the labelled arrays that they make together.

    study.json       configuration, digests of what it is about, versions, machine, and every cell's coordinates
    cells/00042.npz  the numbers of one cell, with digests of them, of the study and of the cell's place
    results.nc       all of them as one NetCDF file, written when the last cell is there
    study.lock       which cells are being computed, and by which process

Every file is moved into place when it is complete, so that a process may be killed at any moment. Locks are the
operating system's and go with their process.
"""

import fcntl
import hashlib
import io
import json
import os
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from mjx_study.disk import open_regular, prepare_folder, read_whole, write_whole
from mjx_study.study.dataset import as_plain
from mjx_study.study.document import read_document, read_format
from mjx_study.study.identity import ACCEPT, differences

FORMAT: Final = 3
"""Of the folder; a number that goes up when an older program could not read a newer folder."""


IDENTITY: Final = ("contents", "config")
"""Parts of study.json that must not differ for a study to go on."""
VERSIONS: Final = "versions"
"""Entry of a cell that says what computed it."""


class StudyError(ValueError):
    """A folder that holds no study, another study, or a damaged file."""


class Store:
    """The folder of one study; `Store.create` and `Store.open` make one.

    Attributes:
        folder: its path.
        document: what study.json holds.
    """

    def __init__(self, folder: Path, document: dict[str, Any]):
        self.folder, self.document = folder, document
        self._versions: dict[str, str] = document.get("versions", {})
        self._study = _digest_of_text({name: document.get(name) for name in IDENTITY})

    @classmethod
    def create(cls, folder: Path, document: dict[str, Any], *, accept_versions: bool = False) -> "Store":
        """A folder for a study, or the one that is there, which must be of the same configuration and contents.

        Args:
            folder: of the study.
            document: `config`, `cells`, and where there are any `contents` (digests of what the numbers depend on) and
                `versions` (of what computes them), and whatever else there is to keep; plain data.
            accept_versions: go on with a study of other versions, each of whose cells says which computed it.

        Raises:
            StudyError: another study is there, or one of other versions, or a file that is not one.
            ValueError: the folder cannot be written to.
        """
        prepare_folder(folder)
        prepare_folder(folder / "cells")
        document = as_plain({"format": FORMAT} | document)
        path = folder / "study.json"
        if path.exists():
            kept = cls.open(folder)
            theirs, ours = (_flat(each, IDENTITY) for each in (kept.document, document))
            if told := differences(theirs, ours):
                raise StudyError(f"{folder} holds another study ({told}); choose another folder")
            told = differences(*(_flat(each, ("versions",)) for each in (kept.document, document)))
            if told and kept.missing and not accept_versions:
                raise StudyError(f"{folder} was computed with other versions ({told}); {ACCEPT}")
            kept._versions = document.get("versions", {})
            return kept
        if any((folder / "cells").glob("*.npz")):
            raise StudyError(f"{folder} holds cells of a study without its study.json; choose another folder")
        write_whole(path, lambda file: file.write((json.dumps(document, indent=1) + "\n").encode()))
        return cls(folder, document)

    @classmethod
    def open(cls, folder: Path) -> "Store":
        """The study of a folder, to read.

        Raises:
            StudyError: there is none, or its study.json is damaged or of a newer format.
        """
        path = folder / "study.json"
        try:
            content = read_whole(path)
            version = read_format(content)
            document = read_document(content) if version == FORMAT else {}
        except FileNotFoundError as error:
            raise StudyError(f"{folder} holds no study: there is no study.json") from error
        except OSError as error:
            raise StudyError(f"cannot read {path}: {_told(error)}") from error
        except ValueError as error:
            raise StudyError(f"{path} is damaged ({error}); move the folder away to start again") from error
        if version != FORMAT:
            raise StudyError(f"{path} is of format {version}; this program reads {FORMAT}")
        return cls(folder, document)

    def path(self, index: int) -> Path:
        """Where a cell is kept."""
        return self.folder / "cells" / f"{index:05d}.npz"

    def has(self, index: int) -> bool:
        """Whether a cell is there; `read` says whether it is sound."""
        return self.path(index).exists()

    def write(self, index: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Keep the numbers of a cell."""
        kept = dict(arrays) | {VERSIONS: np.array(json.dumps(self._versions))}
        digest = np.array([_digest(kept), self._study, self._place(index)])
        write_whole(self.path(index), lambda file: np.savez(file, digest=digest, **kept))  # type: ignore[arg-type]

    def read(self, index: int) -> dict[str, np.ndarray]:
        """The numbers of a cell.

        Raises:
            StudyError: the file is damaged, or of another study or place.
        """
        return self.read_with_versions(index)[0]

    def read_with_versions(self, index: int) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """The numbers of a cell, and the versions of what computed them; see `read`."""
        path = self.path(index)
        try:
            with np.load(io.BytesIO(read_whole(path)), allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            content, study, place = arrays.pop("digest").tolist()
        except Exception as error:  # numpy, zipfile and zlib raise what they like
            raise StudyError(f"{path} is damaged ({_told(error)}); move it away to compute it again") from error
        for wrong, is_that in (
            (study != self._study, "a cell of another study"),
            (place != self._place(index), "another cell of this study"),
            (content != _digest(arrays), "damaged (its digest does not match)"),
        ):
            if wrong:
                raise StudyError(f"{path} is {is_that}; move it away to compute it again")
        return arrays, json.loads(str(arrays.pop(VERSIONS)))

    @contextmanager
    def claim(self, index: int) -> Generator[bool]:
        """Whether this process may compute a cell: no other one does, until the block is left or this process dies."""
        path = self.folder / "study.lock"
        try:
            descriptor = open_regular(path, os.O_RDWR | os.O_CREAT)
        except OSError as error:
            raise StudyError(f"cannot lock {path}: {_told(error)}") from error
        with os.fdopen(descriptor, "r+b") as file:
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, index)
            except (BlockingIOError, PermissionError):
                yield False
            else:
                yield True

    def _place(self, index: int) -> str:
        """Digest of a cell's index and coordinates."""
        cell, axes = self.document["cells"][index], self.document.get("axes", {})
        at = {name: axes[name][place] for name, place in cell.get("at", {}).items()}
        return _digest_of_text({"index": index, "cell": cell, "at": at})

    def read_all(self) -> dict[int, tuple[dict[str, np.ndarray], dict[str, str]]]:
        """Every cell that is there, with the versions of what computed it; see `read`."""
        there = [index for index in range(len(self.document["cells"])) if self.has(index)]
        return {index: self.read_with_versions(index) for index in there}

    @property
    def missing(self) -> list[int]:
        """Cells that are not there yet."""
        return [index for index in range(len(self.document["cells"])) if not self.has(index)]


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return sha.hexdigest()


def _digest_of_text(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _flat(document: Mapping[str, Any], parts: Sequence[str]) -> dict[str, Any]:
    return {name: value for part in parts for name, value in document.get(part, {}).items()}


def _told(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
