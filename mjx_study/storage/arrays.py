"""The arrays of a cell on disk: an .npz without compression and objects, whose members are no larger than the file."""

import io
import math
import zipfile
from collections.abc import Mapping
from typing import IO, Any, Final

import numpy as np

from mjx_study.results.kind import StudyResults, find_kind
from mjx_study.results.variables import ONSETS, with_metrics

MOST_CELL_BYTES: Final = 2**31
"""Maximum size of a cell's file [bytes]."""
MOST_MEMBERS: Final = 1_000_000
"""Maximum number of arrays in a file."""
MEMBER: Final = b"PK\x01\x02"
"""Signature of an entry in a zip file's directory."""
HEADERS: Final = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
"""Readers of .npy headers, by version of the format."""
NUMBERS: Final = "fiub"
"""Kinds of the types that a variable may have."""
MOST_COUNT: Final = 10**15
"""Maximum of a variable that counts."""


def write_arrays(file: IO[bytes], arrays: Mapping[str, np.ndarray]) -> None:
    np.savez(file, **arrays)  # type: ignore[arg-type]


def read_arrays(content: bytes) -> dict[str, np.ndarray]:
    """Read what `write_arrays` wrote, as read-only arrays; ValueError or an error of zipfile for anything else."""
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
            found[name] = _array(members.read(entry))
    return found


def _array(content: bytes) -> np.ndarray:
    """Read a .npy file whose header promises as many bytes as follow."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(f"an array is in version {'.'.join(map(str, version))} of NumPy's format")
    shape, by_column, dtype = HEADERS[version](stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ValueError("an array differs in size from its header")
    flat = np.frombuffer(content, dtype, offset=stream.tell()) if dtype.itemsize else np.zeros(math.prod(shape), dtype)
    return flat.reshape(shape, order="F" if by_column else "C")


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
