"""A study's folder: its configuration, one file per cell, and one file of all results.

    study.json       configuration, digests of what the numbers depend on, versions, machine, every cell's coordinates,
                     and a digest of all that
    cells/00042.npz  one cell's numbers, with digests of these, of the study and of the cell's coordinates
    cells/00042.part.npz  checkpoint of an unfinished cell (descents, or batches in blocks)
    results.nc       all cells as one NetCDF file, written after the last and never read
    study.lock       which cells are being computed, and by which process

Files are moved into place once complete, so a process may be killed at any time. Locks are the operating system's and
end with their process. A folder may come from anywhere: every file that is read is limited in size, is no link, and
matches its digest and its schema.
"""

import fcntl
import os
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

from estimators.user_inputs import inputs_now
from mjx_study.disk import MAX_BYTES, check_no_link, open_regular, prepare_folder, read_whole, write_whole
from mjx_study.experiment.study import Checkpoint, StudyError, StudyPlan, reason_of
from mjx_study.identity import ACCEPT, differences
from mjx_study.options.files import digest_of_json, validated
from mjx_study.progress import Progress
from mjx_study.storage.arrays import CellFile, check_cell
from mjx_study.storage.dataset import dataset_of
from mjx_study.storage.manifest import document_of, read_document, sealed
from mjx_study.table import as_plain

FORMAT: Final = 4
"""Format of the folder; increased when older programs cannot read newer folders."""


class Store:
    """The folder of one study, from `Store.create` or `Store.open`, with the contents of study.json."""

    def __init__(self, folder: Path, document: dict[str, Any]):
        self.folder, self.document = folder, document
        self._versions: dict[str, str] = document.get("versions", {})
        self._study = digest_of_json(_identity(document))
        self._before: dict[int, dict[str, str]] = {}  # versions that computed the checkpoints of cells

    @property
    def chunk_size(self) -> int:
        return self.document["config"]["chunk_size"]

    @classmethod
    def create(cls, folder: Path, document: dict[str, Any], *, accept_versions: bool = False) -> "Store":
        """Create a study's folder, or open an existing one with the same configuration and contents.

        Args:
            document: `config`, `cells`, and optionally `contents` (digests of what the numbers depend on), `versions`
                (of the software that computes them), and further plain data.
            accept_versions: resume a study begun by other versions; each cell records its own.

        Raises:
            StudyError: the folder holds another study, one of other versions, or a damaged file.
            ValueError: the folder cannot be written to.
        """
        kept = cls.begun(folder, document, accept_versions=accept_versions)
        prepare_folder(folder)
        prepare_folder(folder / "cells", follow=False)
        document = as_plain({"format": FORMAT} | document)
        if kept is not None:
            if _iterations(document) > _iterations(kept.document):
                kept._extend(document)
            kept.record(document.get("seen", {}))
            kept._versions = document.get("versions", {})
            return kept
        if any((folder / "cells").glob("*.npz")):
            raise StudyError(f"{folder} holds cells of a study without its study.json; choose another folder")
        created = cls(folder, document)
        created._write_document()
        return created

    @classmethod
    def begun(cls, folder: Path, document: dict[str, Any], *, accept_versions: bool = False) -> "Store | None":
        """Open a folder's study for reading, as `create` would resume it; None if there is none. Raises as `create`."""
        if not os.path.lexists(folder / "study.json"):
            return None
        document, kept = as_plain({"format": FORMAT} | document), cls.open(folder)
        theirs, ours = ({**parts["contents"], **parts["config"]} for parts in map(_identity, (kept.document, document)))
        seen = kept.document.get("seen", {})
        if different := differences(theirs, ours) or differences(seen, inputs_now(seen)):
            raise StudyError(f"{folder} holds another study ({different}); choose another folder")
        there, asked = _iterations(kept.document), _iterations(document)
        if asked < there:
            raise StudyError(
                f"{folder} holds {there} iterations, and {asked} are asked for: give --iterations {there} or more, "
                "or another folder"
            )
        different = differences(*(each.get("versions", {}) for each in (kept.document, document)))
        if different and (kept.missing or asked > there) and not accept_versions:
            raise StudyError(f"{folder} was computed with other versions ({different}); {ACCEPT}")
        return kept

    def _extend(self, document: dict[str, Any]) -> None:
        """Turn finished descents into checkpoints of longer ones; safe to repeat after a kill."""
        indices = range(len(self.document["cells"]))
        with self.claims() as claim:
            if not all(map(claim, indices)):
                raise StudyError(
                    f"another process computes descents in {self.folder}: make them longer once it has ended"
                )
            for index in filter(self.has, indices):
                self.file(index, part=True).write(*self.read_with_versions(index))
                self.path(index).unlink()
            self.document |= {"config": document["config"], "resolved": document["resolved"]}
            self._write_document()

    def record(self, seen: Mapping[str, str]) -> None:
        """Add to study.json what else the user's code has read; see `estimators.user_inputs`."""
        before = self.document.get("seen", {})
        if new := {name: digest for name, digest in seen.items() if name not in before}:
            self.document["seen"] = before | new
            self._write_document()

    def _write_document(self) -> None:
        write_whole(self.folder / "study.json", sealed(self.document))

    @classmethod
    def open(cls, folder: Path) -> "Store":
        """Open a folder for reading; StudyError if it holds no study, or its study.json is damaged or of another
        format."""
        path = folder / "study.json"
        try:
            content = read_whole(path, follow=False, most=MAX_BYTES)
            check_no_link(folder / "cells")
            version = str(validated(dict[str, Any], content).get("format"))
            document = read_document(content) if version == str(FORMAT) else {}
        except FileNotFoundError as error:
            raise StudyError(f"{folder} holds no study: there is no study.json") from error
        except OSError as error:
            raise StudyError(f"cannot read {error.filename or path}: {reason_of(error)}") from error
        except ValueError as error:
            raise StudyError(f"{path} is damaged ({error}); move the folder away to start again") from error
        if version != str(FORMAT):
            raise StudyError(f"{path} is of format {version}; this program reads {FORMAT}")
        return cls(folder, document)

    def path(self, index: int) -> Path:
        return self.folder / "cells" / f"{index:05d}.npz"

    def part_path(self, index: int) -> Path:
        return self.path(index).with_suffix(".part.npz")

    def file(self, index: int, *, part: bool = False) -> CellFile:
        """File of a cell, or of its checkpoint."""
        path = self.part_path(index) if part else self.path(index)
        return CellFile(path, self._study, self._cell_digest(index, part=part))

    def has(self, index: int) -> bool:
        """Whether a cell's file exists; `read` checks it."""
        return os.path.lexists(self.path(index))

    def write(self, index: int, arrays: Mapping[str, np.ndarray]) -> None:
        self.file(index).write(arrays, self._authors(index))
        self.part_path(index).unlink(missing_ok=True)

    def checkpoint(self, index: int, report: Progress) -> Checkpoint:
        """A cell's checkpoint; failing to write it must not cost the cell."""

        def save(arrays: Mapping[str, np.ndarray]) -> None:
            with suppress(OSError):
                self.file(index, part=True).write(arrays, self._authors(index))

        kept: dict[str, np.ndarray] = {}
        if os.path.lexists(self.part_path(index)):
            kept, self._before[index] = self.read_with_versions(index, part=True)
        return Checkpoint(kept, save, report, str(self.part_path(index)))

    def _authors(self, index: int) -> dict[str, str]:
        """Versions that computed a cell, including those of its checkpoint."""
        if (before := self._before.get(index)) is None:
            return self._versions
        names = dict.fromkeys([*before, *self._versions])
        both = {name: [*before.get(name, "none").split(" and "), self._versions.get(name, "none")] for name in names}
        return {name: " and ".join(dict.fromkeys(each)) for name, each in both.items()}

    def read(self, index: int) -> dict[str, np.ndarray]:
        return self.read_with_versions(index)[0]

    def read_part(self, index: int) -> dict[str, np.ndarray]:
        """Read a cell's checkpoint; empty if there is none."""
        return self.read_with_versions(index, part=True)[0] if os.path.lexists(self.part_path(index)) else {}

    def read_all(self) -> dict[int, tuple[dict[str, np.ndarray], dict[str, str]]]:
        indices = range(len(self.document["cells"]))
        return {index: self.read_with_versions(index) for index in indices if self.has(index)}

    def read_with_versions(self, index: int, *, part: bool = False) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """Read the numbers of a cell, or its checkpoint, and the versions that computed them; StudyError if the file is
        damaged, or belongs to another study or cell, or a cell lacks a variable or has one of another shape."""
        file = self.file(index, part=part)
        return file.read() if part else file.read(lambda arrays: check_cell(arrays, self.document, index))

    @contextmanager
    def claims(self) -> Generator[Callable[[int], bool]]:
        """Yield a function that claims a cell for this process, and returns False if another process has it.

        Claims end with the context or the process. A process may enter only one such context at a time: closing the
        file releases all of its locks.
        """
        path = self.folder / "study.lock"
        try:
            descriptor = open_regular(path, os.O_RDWR | os.O_CREAT, follow=False)
        except OSError as error:
            raise StudyError(f"cannot lock {path}: {reason_of(error)}") from error
        with os.fdopen(descriptor, "r+b") as file:

            def claim(index: int) -> bool:
                with suppress(BlockingIOError, PermissionError):
                    fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, index)
                    return True
                return False

            yield claim

    def _cell_digest(self, index: int, *, part: bool = False) -> str:
        """Digest of a cell's index and coordinates and, except for checkpoints, of the descents' length."""
        cell, axes = self.document["cells"][index], self.document.get("axes", {})
        at = {name: axes[name][index] for name, index in cell.get("at", {}).items()}
        iterations = None if part else self.document["config"].get("iterations")
        return digest_of_json({"index": index, "cell": cell, "at": at, "iterations": iterations})

    @property
    def missing(self) -> list[int]:
        return [index for index in range(len(self.document["cells"])) if not self.has(index)]


def open_store(plan: StudyPlan, folder: Path, command: str | None = None, *, accept_versions: bool = False) -> Store:
    """Open a plan's folder, new or begun; a begun one keeps its chunk size unless the configuration sets another.

    ValueError if the folder is not writable or holds another study. The command line is recorded, if one asked for the
    study; `accept_versions` resumes a study begun by other versions.
    """
    document = _document_in(plan, folder, command)
    return Store.create(folder, document, accept_versions=accept_versions)


def begun_store(plan: StudyPlan, folder: Path, *, accept_versions: bool = False) -> Store | None:
    """Open a plan's folder for reading, as `open_store` would resume it; None if nothing is begun."""
    return Store.begun(folder, _document_in(plan, folder), accept_versions=accept_versions)


def _document_in(plan: StudyPlan, folder: Path, command: str | None = None) -> dict[str, Any]:
    """Document of a plan, with the chunk size of a study begun in the folder."""
    document = document_of(plan, command)
    if plan.config.chunk_size is None:
        begun = os.path.lexists(folder / "study.json")
        document["config"]["chunk_size"] = Store.open(folder).chunk_size if begun else plan.chunk_size
    return document


def _identity(document: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """The parts that must match when a study resumes: all that its numbers depend on, except the length of descents."""
    config = {name: value for name, value in document["config"].items() if name != "iterations"}
    return {"contents": document.get("contents", {}), "config": config}


def _iterations(document: Mapping[str, Any]) -> int:
    return document["config"].get("iterations") or 0


def load_study(folder: str | Path) -> xr.Dataset:
    """Load the numbers of a study, even an unfinished one, as labelled arrays; NaN where missing.

    Dimensions: task, timestep, cone, model (a contact model, with coordinates `contact` for its family and
    `stiffness`), sigma, samples, then seed, estimator, iteration, point and param as far as a variable has them.

    Raises:
        StudyError: there is no study, or a file of it is damaged.
    """
    store = Store.open(Path(folder))
    return dataset_of(store.document, store.read_all())
