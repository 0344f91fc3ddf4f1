"""Check an MJCF and all files that it refers to before MuJoCo opens them, which may wait for ever, crash or exhaust
memory."""

import dataclasses
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from mjx_study.disk import read_bytes
from mjx_study.simulation.mjcf_limits import ELEMENTS, copies, not_finite, sizes
from mjx_study.simulation.mjcf_text import Element, elements

_FOLDERS: Final = ("meshdir", "texturedir", "assetdir")
_FILE: Final = re.compile("file.*")
"""Attributes that name files, of URDF as well."""
_NAMES: Final = ("name", "class", "dclass", "childclass", "prefix")
_MODELS: Final = ("include", "model")
"""Elements whose file is an MJCF."""
DEEPEST: Final = 50
"""Limit on the nesting of files."""
MOST_ASSET_BYTES: Final = 1_000_000_000
"""Maximum size of a mesh, texture, ... [bytes]."""
_UNCOUNTED: Final = "mujoco mujocoinclude include compiler option size default frame replicate".split()


class RefusedFileError(ValueError):
    """A file that MuJoCo must not open; the message names it and says why."""


@dataclasses.dataclass(frozen=True)
class _Contents:
    """What matters of a file's elements.

    Attributes:
        elements: all of them, with the number of their copies; 0 for what is no part of a world.
        folders: folders that `compiler` names.
        attached: copies of models that are attached.
    """

    elements: list[tuple[Element, float]]
    folders: set[str]
    attached: float


def check_files(path: Path) -> None:
    """Check an MJCF with everything that it includes, attaches and loads.

    Raises:
        RefusedFileError: a file is a pipe or device or too large, a model contains itself, or an attribute asks for too
            much or is not finite. What MuJoCo itself reports, such as a missing file, is no error here.
    """
    _Walk(path.parent).count(path, ())


class _Walk:
    """Goes through files once each; `main` is the folder of the model's own file."""

    def __init__(self, main: Path) -> None:
        self._main = main
        self._counts: dict[Path, float] = {}

    def count(self, path: Path, within: tuple[Path, ...]) -> float:
        """Number of elements of a model with all copies."""
        real = path.resolve()
        if real in within:
            raise RefusedFileError(f"{path} contains itself: it is included or attached again inside of itself")
        if len(within) >= DEEPEST:
            raise RefusedFileError(f"{path} is the end of a chain of files, each in the one before, of over {DEEPEST}")
        if real in self._counts:
            return self._counts[real]
        try:
            found = _read(path)
        except ValueError as error:
            raise RefusedFileError(str(error)) from None
        _check_attributes(path, found)
        largest, included = 0.0, 0.0
        for element, _ in found.elements:
            for file in self._files(path, element, found.folders):
                _check_file(file, f"<{element.tag}> in {path} refers to {file}")
                if element.tag in _MODELS and file.is_file():
                    count = self.count(file, (*within, real))
                    largest = max(largest, count * (element.tag == "model"))
                    included += count * (element.tag == "include")
        own = sum(copied for element, copied in found.elements if element.tag not in _UNCOUNTED)
        total = self._counts[real] = own + included + found.attached * largest
        if total > ELEMENTS:
            raise RefusedFileError(
                f"{path} asks for {total:.3g} elements, with those of <replicate>, <composite>, <flexcomp> and "
                f"<attach>; the limit is {ELEMENTS:g}"
            )
        return total

    def _files(self, path: Path, element: Element, folders: set[str]) -> Iterator[Path]:
        """Existing files that MuJoCo may open for an element: relative to the model or the including file, in the
        folders of `compiler`, without their own folder if `strippath` is set."""
        for name, text in element.attributes.items():
            if not (_FILE.fullmatch(name) and text):
                continue
            named = text.replace("\\", "/").removeprefix("file://").removeprefix("package://")
            for parent in {self._main, path.parent}:
                for folder in folders:
                    for form in {named, os.path.basename(named)}:
                        file = parent / folder / form
                        try:
                            if file.exists():
                                yield file
                        except (OSError, ValueError):  # a name that is none
                            continue


def _check_file(file: Path, reference: str) -> None:
    """A folder is left to MuJoCo, which reports it."""
    status = file.stat()
    if stat.S_ISDIR(status.st_mode):
        return
    if not stat.S_ISREG(status.st_mode):
        raise RefusedFileError(f"{reference}, which is not a regular file")
    if not 0 < status.st_size <= MOST_ASSET_BYTES:  # files of the kernel, which may wait for ever, have none
        raise RefusedFileError(
            f"{reference}, which has {status.st_size} bytes; the limits are 1 and {MOST_ASSET_BYTES}"
        )


def _read(path: Path) -> _Contents:
    found: list[tuple[Element, float]] = []
    folders, attached, repeats = {""}, 0.0, [1.0]
    for element in elements(read_bytes(path)):
        if element.ends:
            if element.tag == "replicate" and len(repeats) > 1:
                repeats.pop()
            continue
        if element.tag == "replicate":
            repeats.append(repeats[-1] * copies(element))
        made = copies(element) if element.tag in ("composite", "flexcomp") else 1.0
        found.append((element, repeats[-1] * made))
        attached += repeats[-1] * (element.tag == "attach")
        if element.tag == "compiler":
            folders |= {element.attributes.get(name, "").replace("\\", "/") for name in _FOLDERS}
    folders |= {f"{one}/{other}" for one in folders for other in folders}  # texturedir within assetdir
    return _Contents(found, folders, attached)


def _check_attributes(path: Path, found: _Contents) -> None:
    names = {element.attributes[name] for element, _ in found.elements for name in _NAMES if name in element.attributes}
    for element, _ in found.elements:
        for what, size, limit in sizes(element):
            if size > limit:
                raise RefusedFileError(f"{path} asks for {what} of {size:.3g}; the limit is {limit:g}")
        if wrong := not_finite(element, names):
            raise RefusedFileError(f"{path}: {wrong[0]} of <{element.tag}> must be finite, got {wrong[1]!r:.60}")
