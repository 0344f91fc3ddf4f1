"""The file of a cell: its numbers, or a checkpoint of them.

It is an .npz without compression and objects, whose members are no larger than the file. It holds digests of its
content, of the study and of the cell, and counts only if all three match.
"""

import dataclasses
import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from mjx_study.disk import read_whole, write_whole
from mjx_study.experiment.study import StudyError, reason_of
from mjx_study.limits import MOST_GIB
from mjx_study.options.files import read_npy, validated
from mjx_study.results.kind import StudyResults, find_kind
from mjx_study.results.variables import ONSETS, with_metrics

MOST_CELL_BYTES: Final = int(MOST_GIB * 2**30)  # maximum size of a cell's file [bytes]
MOST_MEMBERS: Final = 1_000_000
"""Maximum number of arrays in a file."""
MEMBER: Final = b"PK\x01\x02"  # signature of an entry in a zip file's directory
NUMBERS: Final = "fiub"
"""Kinds of the types that a variable may have."""
MOST_COUNT: Final = 10**15  # maximum of a variable that counts
VERSIONS: Final = "versions"  # entry that records the versions that computed a cell


@dataclasses.dataclass(frozen=True)
class CellFile:
    """File of a cell's numbers, with digests of the study, and of the cell's index and coordinates."""

    path: Path
    study: str
    cell: str

    def write(self, arrays: Mapping[str, np.ndarray], versions: Mapping[str, str]) -> None:
        kept = dict(arrays) | {VERSIONS: np.array(json.dumps(versions))}
        digest = np.array([digest_of_arrays(kept), self.study, self.cell])
        write_whole(self.path, lambda file: np.savez(file, digest=digest, **kept))  # type: ignore[arg-type]

    def read(
        self, check: Callable[[dict[str, np.ndarray]], None] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, str]]:
        """Read numbers and versions; StudyError if the file is damaged, or belongs to another study or cell, or the
        check raises a ValueError."""
        path = self.path
        try:
            arrays = read_arrays(read_whole(path, follow=False, most=MOST_CELL_BYTES))
            content, study, cell = arrays.pop("digest").tolist()
        except Exception as error:  # numpy and zipfile may raise anything
            raise StudyError(f"{path} is damaged ({reason_of(error)}); move it away to compute it again") from error
        wrong = {
            "a cell of another study": study != self.study,
            "another cell of this study": cell != self.cell,
            "damaged (its digest does not match)": content != digest_of_arrays(arrays),
        }
        if is_that := next((what for what, holds in wrong.items() if holds), None):
            raise StudyError(f"{path} is {is_that}; move it away to compute it again")
        try:
            versions = validated(dict[str, str], str(arrays.pop(VERSIONS, "")))
            if check is not None:
                check(arrays)
        except ValueError as error:
            reason = f"does not fit the study ({reason_of(error)})"
            raise StudyError(f"{path} {reason}; move it away to compute it again") from error
        return arrays, versions


def digest_of_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return sha.hexdigest()


def read_arrays(content: bytes) -> dict[str, np.ndarray]:
    """Read what `numpy.savez` wrote, as read-only arrays; ValueError or an error of zipfile for anything else."""
    if content.count(MEMBER) > MOST_MEMBERS:
        raise ValueError(f"it holds more than {MOST_MEMBERS} arrays")
    found: dict[str, np.ndarray] = {}
    with zipfile.ZipFile(io.BytesIO(content)) as members:
        entries = members.infolist()
        if sum(entry.file_size for entry in entries) > len(content):
            raise ValueError("its arrays are larger than the file")
        for entry in entries:
            name = entry.filename.removesuffix(".npy")
            if entry.compress_type != zipfile.ZIP_STORED:
                raise ValueError("its arrays are compressed")
            if name in found:
                raise ValueError(f"it holds {name} twice")
            found[name] = read_npy(members.read(entry))
    return found


def required(kind: StudyResults) -> list[str]:
    """Variables that every cell of a kind of study has."""
    return [name for name in kind.variables if name not in kind.optional]


def sizes_of(document: Mapping[str, Any], index: int) -> dict[str, int]:
    config, task = document["config"], document["resolved"][document["cells"][index]["at"]["task"]]
    return find_kind(config["kind"]).sizes(config, task.get("parameters", 1))


def check_cell(arrays: Mapping[str, np.ndarray], document: Mapping[str, Any], index: int) -> None:
    """Raise ValueError unless a cell has all variables of its kind of study, in their shapes; others are ignored.

    Descents of a task may have fewer iterations than the longest of the study. Counts are neither negative nor huge,
    and not NaN except after the end of a descent and without an onset term.
    """
    kind, sizes = find_kind(document["config"]["kind"]), sizes_of(document, index)
    if missing := [name for name in required(kind) if name not in arrays]:
        raise ValueError(f"it has no {missing[0]}")
    for name, variable in with_metrics(kind.variables, arrays).items():
        if (array := arrays.get(name)) is None:
            continue
        if array.dtype.kind not in NUMBERS:
            raise ValueError(f"{name} is of type {array.dtype}, not a number")
        wanted = tuple(sizes[dim] for dim in variable.dims)
        shortened = array.shape[:1] if variable.dims[:1] == ("iteration",) else wanted[:1]
        if array.shape != shortened + wanted[1:] or array.shape[:1] > wanted[:1]:
            raise ValueError(f"{name} has shape {array.shape}; the study needs {wanted}")
        padded = np.isnan(array) if "iteration" in variable.dims or name in ONSETS else np.zeros(array.shape, bool)
        if not variable.digits and not np.all(padded | ((array >= 0) & (array <= MOST_COUNT))):
            raise ValueError(f"{name} is no count")
