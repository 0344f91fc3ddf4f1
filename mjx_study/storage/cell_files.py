"""Files of one cell: its numbers or a checkpoint of them, and the reason why it could not be computed.

Each holds digests of its content, of the study and of the cell, and counts only if all three match.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import BaseModel, ConfigDict

from mjx_study.disk import MAX_BYTES, read_whole, write_whole
from mjx_study.experiment.checkpoint import StudyError, reason_of
from mjx_study.options.files import digest_of_json
from mjx_study.storage.arrays import MOST_CELL_BYTES, read_arrays, write_arrays
from mjx_study.storage.schema import validated

VERSIONS: Final = "versions"
"""Entry that records the versions that computed a cell."""


class _Failure(BaseModel):
    model_config = ConfigDict(strict=True)

    reason: str
    digest: str


@dataclasses.dataclass(frozen=True)
class CellFile:
    """A file of a cell's numbers, and beside it one that states why they could not be computed.

    Attributes:
        study: digest of the study.
        cell: digest of the cell's index and coordinates.
    """

    path: Path
    study: str
    cell: str

    def write(self, arrays: Mapping[str, np.ndarray], versions: Mapping[str, str]) -> None:
        """Write numbers, and the versions that computed them."""
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

    @property
    def failure(self) -> Path:
        return self.path.with_suffix(".failed")

    def write_failure(self, reason: str) -> None:
        failure = _Failure(reason=reason, digest=self._digest(reason))
        write_whole(self.failure, failure.model_dump_json().encode())

    def read_failure(self) -> str:
        """Read why the cell could not be computed; StudyError if the file is damaged."""
        try:
            found = validated(_Failure, read_whole(self.failure, follow=False, most=MAX_BYTES))
            if found.digest != self._digest(found.reason):
                raise ValueError("its digest does not match")
        except (OSError, ValueError) as error:
            raise StudyError(f"{self.failure} is damaged ({reason_of(error)}); remove it") from error
        return found.reason

    def _digest(self, reason: str) -> str:
        return digest_of_json({"reason": reason, "study": self.study, "place": self.cell})


def digest_of_arrays(arrays: Mapping[str, np.ndarray]) -> str:
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        sha.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return sha.hexdigest()
