"""The checkpoint of an unfinished cell, and errors about files of a study."""

import dataclasses
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager

import numpy as np

Arrays = dict[str, np.ndarray]


class StudyError(ValueError):
    """A folder holds no study, another study, or a damaged file."""


def reason_of(error: Exception) -> str:
    """What is wrong with a file, in one line."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Checkpointing within a cell.

    Attributes:
        kept: arrays of the last checkpoint.
        report: reports progress within the cell: done, total, and what is being computed.
        name: name of the checkpoint in messages.
    """

    kept: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    save: Callable[[Arrays], None] = lambda arrays: None
    report: Callable[[int, int, str], None] = lambda done, total, what: None
    name: str = "the checkpoint"

    @contextmanager
    def restored(self) -> Generator[None]:
        """Let arrays of the checkpoint that are missing or of another form be a StudyError."""
        try:
            yield
        except (KeyError, IndexError, TypeError, ValueError) as error:
            reason = f"no {error}" if isinstance(error, KeyError) else reason_of(error)
            message = f"{self.name} does not fit the study ({reason}); move it away to compute its cell again"
            raise StudyError(message) from error
