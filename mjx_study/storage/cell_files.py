"""The file of a cell: its numbers or a checkpoint of them.

It holds digests of its content, of the study and of the cell, and counts only if all three match.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from mjx_study.disk import read_whole, write_whole
from mjx_study.experiment.checkpoint import StudyError, reason_of
from mjx_study.options.files import validated
from mjx_study.storage.arrays import MOST_CELL_BYTES, read_arrays, write_arrays

VERSIONS: Final = "versions"
"""Entry that records the versions that computed a cell."""


@dataclasses.dataclass(frozen=True)
class CellFile:
    """File of a cell's numbers, with digests of the study, and of the cell's index and coordinates."""

    path: Path
    study: str
    cell: str

    def write(self, arrays: Mapping[str, np.ndarray], versions: Mapping[str, str]) -> None:
        kept = dict(arrays) | {VERSIONS: np.array(json.dumps(versions))}
        digest = np.array([digest_of_arrays(kept), self.study, self.cell])
        write_whole(self.path, lambda file: write_arrays(file, {"digest": digest} | kept))

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
