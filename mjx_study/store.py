"""A study's folder: its configuration, one file per cell, and the labelled arrays that they make together.

    study.json       configuration, versions, machine, and every cell's coordinates
    cells/00042.npz  the numbers of one cell, with a digest of them and of the configuration
    results.nc       all of them as one NetCDF file, written when the last cell is there
    study.lock       which cells are being computed, and by which process

Every file is moved into place when it is complete, so that a process may be killed at any moment. Locks are the
operating system's and go with their process.
"""

import fcntl
import hashlib
import json
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr

from mjx_study.results import as_plain, prepare_folder, write_whole

FORMAT: Final = 1
"""Of the folder; a number that goes up when an older program could not read a newer folder."""


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
        self._identity = _digest({"config": np.array(json.dumps(document["config"], sort_keys=True))})

    @classmethod
    def create(cls, folder: Path, document: dict[str, Any]) -> "Store":
        """A folder for a study, or the one that is there, which must be of the same configuration.

        Args:
            folder: of the study.
            document: `config`, `cells` and whatever else there is to keep; plain data.

        Raises:
            StudyError: another study is there, or a file that is not one.
            ValueError: the folder cannot be written to.
        """
        prepare_folder(folder)
        prepare_folder(folder / "cells")
        document = json.loads(json.dumps(as_plain({"format": FORMAT} | document), allow_nan=False))
        path = folder / "study.json"
        if path.exists():
            kept = cls.open(folder)
            theirs, ours = kept.document["config"], document["config"]
            different = sorted(name for name in theirs | ours if theirs.get(name) != ours.get(name))
            if different:
                told = ", ".join(f"{name} {theirs.get(name)} there and {ours.get(name)} here" for name in different[:3])
                raise StudyError(f"{folder} holds another study ({told}); choose another folder")
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
            document = json.loads(path.read_text())
            version, _, _ = document["format"], document["config"], document["cells"]
        except FileNotFoundError as error:
            raise StudyError(f"{folder} holds no study: there is no study.json") from error
        except OSError as error:
            raise StudyError(f"cannot read {path}: {error.strerror or error}") from error
        except (ValueError, KeyError, TypeError) as error:
            raise StudyError(f"{path} is damaged; move the folder away to start again") from error
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
        kept = dict(arrays)
        digest = np.array(_digest(kept) + self._identity)
        write_whole(self.path(index), lambda file: np.savez(file, digest=digest, **kept))  # type: ignore[arg-type]

    def read(self, index: int) -> dict[str, np.ndarray]:
        """The numbers of a cell.

        Raises:
            StudyError: the file is damaged, or of another configuration.
        """
        path = self.path(index)
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                arrays = {name: stored[name] for name in stored.files}
            digest = str(arrays.pop("digest"))
        except Exception as error:  # numpy, zipfile and zlib raise what they like
            raise StudyError(f"{path} is damaged ({error}); move it away to compute it again") from error
        if not digest.endswith(self._identity):
            raise StudyError(f"{path} is a cell of another study; move it away to compute it again")
        if digest != _digest(arrays) + self._identity:
            raise StudyError(f"{path} is damaged (its digest does not match); move it away to compute it again")
        return arrays

    @contextmanager
    def claim(self, index: int) -> Generator[bool]:
        """Whether this process may compute a cell: no other one does, until the block is left or this process dies."""
        with (self.folder / "study.lock").open("ab") as file:
            try:
                fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, index)
            except (BlockingIOError, PermissionError):
                yield False
            else:
                yield True

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


def git_revision() -> str | None:
    """Of the checkout that the program runs from; None where it is installed, or git is not there."""
    git = Path(__file__).resolve().parents[1] / ".git"
    try:
        head = (git / "HEAD").read_text().strip()
        return (git / head.removeprefix("ref: ")).read_text().strip() if head.startswith("ref: ") else head
    except OSError:
        return None


def assemble(
    store: Store,
    dimensions: Mapping[str, Sequence[Any]],
    variables: Mapping[str, tuple[tuple[str, ...], str, str]],
    along: Mapping[str, tuple[str, Sequence[Any], str]],
    units: Mapping[str, str],
) -> xr.Dataset:
    """All cells of a study as labelled arrays; NaN for what is not there yet.

    Args:
        store: the folder; each cell of its document has the key "at", its index along every dimension of cells.
        dimensions: coordinates of each dimension; those of cells first, then those within a cell.
        variables: dimensions within a cell, unit and description of each variable.
        along: more coordinates: name to (dimension, values, unit).
        units: of the dimensions.
    """
    cells = store.document["cells"]
    outer = tuple(cells[0]["at"]) if cells else ()
    found = {index: store.read(index) for index in range(len(cells)) if store.has(index)}
    data: dict[str, Any] = {}
    for name, (inner, unit, description) in variables.items():
        held = {index: arrays[name] for index, arrays in found.items() if name in arrays}
        if not held:
            continue
        inner_shape = np.broadcast_shapes(*(array.shape for array in held.values()))
        values = np.full([len(dimensions[dimension]) for dimension in outer] + list(inner_shape), np.nan)
        for index, array in held.items():
            values[tuple(cells[index]["at"][dimension] for dimension in outer)] = array
        data[name] = ((*outer, *inner), values, {"units": unit, "long_name": description})
    used = {dimension for dims, *_ in data.values() for dimension in dims} | set(outer)
    coordinates: dict[str, Any] = {
        dimension: (dimension, list(values), {"units": units[dimension]} if units.get(dimension) else {})
        for dimension, values in dimensions.items()
        if dimension in used
    }
    for name, (dimension, values, unit) in along.items():
        coordinates[name] = (dimension, list(values), {"units": unit} if unit else {})
    dataset = xr.Dataset(data, coordinates)
    dataset.attrs = {
        key: json.dumps(value) if isinstance(value, dict | list) else value
        for key, value in store.document.items()
        if key not in ("cells", "format") and value is not None
    }
    dataset.attrs["missing_cells"] = len(store.missing)
    return dataset


def write_dataset(dataset: xr.Dataset, path: Path) -> Path:
    """A dataset as NetCDF 3, which every tool reads."""
    content = dataset.to_netcdf(engine="scipy")
    return write_whole(path, lambda file: file.write(bytes(content)))
