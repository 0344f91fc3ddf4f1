"""A defect that somebody could write: a replacement in one file."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True)
class Defect:
    """A fault, and who may find it.

    Attributes:
        name: of the fault.
        file: where, from the root of the repository.
        old, new: the text that occurs once there, and what replaces it.
        why: how somebody could come to write it.
        tests: files of the fast tests, or single tests of them, that are likely to see it.
        model: of `tests.planted.models`, where gradcheck could see it; None where it has no part in the physics.
    """

    name: str
    file: str
    old: str
    new: str
    why: str
    tests: tuple[str, ...]
    model: str | None = None


def plant(defect: Defect, tree: Path) -> None:
    """Replace the text in a copy of the repository.

    Raises:
        ValueError: the old text does not occur exactly once, or the new one is the same.
    """
    path = tree / defect.file
    text = path.read_text()
    if text.count(defect.old) != 1:
        raise ValueError(f"{defect.name}: {defect.file} has the text {text.count(defect.old)} times: {defect.old!r}")
    if defect.old == defect.new:
        raise ValueError(f"{defect.name} changes nothing")
    path.write_text(text.replace(defect.old, defect.new))
