"""Check an MJCF and all files that it refers to before MuJoCo opens them, which may wait for ever, crash or exhaust
memory.

Elements are read as leniently as by MuJoCo's parser, which accepts `a & b` and ignores encodings.
"""

import dataclasses
import math
import os
import re
import stat
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final

from mjx_study.disk import read_bytes

_FOLDERS: Final = ("meshdir", "texturedir", "assetdir")
_FILE: Final = re.compile("file.*")  # attributes that name files, of URDF as well
_NAMES: Final = ("name", "class", "dclass", "childclass", "prefix")
_MODELS: Final = ("include", "model")  # elements whose file is an MJCF
DEEPEST: Final = 50
"""Limit on the nesting of files."""
MOST_ASSET_BYTES: Final = 1_000_000_000
"""Maximum size of a mesh, texture, ... [bytes]."""
_UNCOUNTED: Final = "mujoco mujocoinclude include compiler option size default frame replicate".split()
MOST: Final[dict[tuple[str, ...], float]] = {
    ("hfield", "nrow", "ncol"): 1e8,
    ("texture", "width", "height"): 1e8,
    ("mesh", "params"): 1e3,
    ("numeric", "size"): 1e6,
    ("camera", "resolution"): 1e8,
    ("contact", "num"): 1e4,
    ("size", "memory"): 1e10,
    ("size", "nuserdata"): 1e6,
    ("size", "nkey"): 1e4,
    ("size", "njmax"): 1e6,
    ("size", "nconmax"): 1e6,
    ("size", "nstack"): 1e9,
}
"""Limit on the product of an element's attributes."""
ELEMENTS: Final = 2e4
"""Limit on the number of bodies, joints, geoms, ... after all of `replicate`, `composite`, `flexcomp` and `attach`."""
SAMPLES: Final = 1e5
"""Limit on `nsample` of any element."""
USER: Final = 1e4
"""Limit on nuser_body, nuser_jnt, ... of <size>."""
_GRID: Final = "10 10 10"  # of a flexcomp without count
_UNITS: Final = {"K": 2.0**10, "M": 2.0**20, "G": 2.0**30, "T": 2.0**40, "P": 2.0**50, "E": 2.0**60}
_TEXTS: Final = re.compile("name|.*class|model|file.*|.*dir|prefix|instance|plugin|content_type")
"""Attributes whose value is text, whatever it looks like."""
_OF_TEXT: Final = ("text", "config")  # elements whose attributes are text
_NUMBER: Final = re.compile(
    r"([+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|nan|inf(?:inity)?))(?:(?<=nan)\(\w*\))?", re.IGNORECASE
)
_NAME: Final = r"[:A-Za-z_\x80-\uffff][\w:.\-\x80-\uffff]*+"
_TOKEN: Final = re.compile(
    rf"""<!--.*?-->|<!\[CDATA\[.*?\]\]>|<\?.*?\?>
    |</\s*(?P<closed>{_NAME})
    |<(?P<tag>{_NAME})(?P<attributes>(?:\s*+{_NAME}\s*+=\s*+(?:"[^"]*+"|'[^']*+'))*+)\s*+(?P<empty>/?)""",
    re.DOTALL | re.VERBOSE,
)
_ATTRIBUTE: Final = re.compile(rf"""({_NAME})\s*+=\s*+(?:"([^"]*+)"|'([^']*+)')""")
_ENTITY: Final = re.compile(r"&(?:#(\d{1,7}+)|#x([0-9a-fA-F]{1,6}+)|(quot|amp|apos|lt|gt));")
_ENTITIES: Final = {"quot": '"', "amp": "&", "apos": "'", "lt": "<", "gt": ">"}


@dataclasses.dataclass(frozen=True)
class Element:
    """Start of an element, or its end, which has no attributes."""

    tag: str
    attributes: dict[str, str]
    ends: bool = False


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


def sizes(element: Element) -> Iterator[tuple[str, float, float]]:
    """Yield description, size and limit of everything that an element's attributes request."""
    for (of, *names), limit in MOST.items():
        if of == element.tag and all(name in element.attributes for name in names):
            size = math.prod(_product(element.attributes[name]) for name in names)
            yield f"<{of}> with {' x '.join(names)}", size, limit
    for name, text in element.attributes.items():
        if name == "nsample" or (element.tag == "size" and name.startswith("nuser_")):
            yield f"<{element.tag}> with {name}", _product(text), SAMPLES if name == "nsample" else USER


def copies(element: Element) -> float:
    """Number of bodies that an element makes by itself, or of copies of what is inside a `replicate`."""
    return _product(element.attributes.get("count", _GRID if element.tag == "flexcomp" else "")) or 1.0


def not_finite(element: Element, names: Collection[str]) -> tuple[str, str] | None:
    """First attribute that holds a number which is not finite, with its value; a value among `names` is a reference."""
    if element.tag in _OF_TEXT:
        return None
    for name, text in element.attributes.items():
        if "n" not in text and "N" not in text and "e" not in text and "E" not in text:
            continue  # as nearly all: neither nan, inf nor an exponent
        if _TEXTS.fullmatch(name) or text in names:
            continue
        numbers = list(map(_NUMBER.fullmatch, text.split()))
        if all(numbers) and not all(math.isfinite(float(number[1])) for number in numbers if number):
            return name, text
    return None


def _product(text: str) -> float:
    """Product of the numbers in an attribute such as 10, 3 3 3 or 2G; 0 if there are none."""
    try:
        numbers = [float(part.rstrip("KMGTPE")) * _UNITS.get(part[-1], 1.0) for part in text.split()]
    except ValueError:
        return 0.0
    return math.prod(abs(number) for number in numbers) if numbers else 0.0


def elements(content: bytes) -> Iterator[Element]:
    """Yield the start and the end of every element; no text is expanded, and text that is no XML is skipped."""
    text = os.fsdecode(content.partition(b"\0")[0])
    for found in _TOKEN.finditer(text):
        if found["closed"]:
            yield Element(found["closed"], {}, ends=True)
        elif found["tag"]:
            pairs = _ATTRIBUTE.findall(found["attributes"])
            yield Element(found["tag"], {name: _expanded(double or single) for name, double, single in pairs})
            if found["empty"]:
                yield Element(found["tag"], {}, ends=True)


def _expanded(text: str) -> str:
    return _ENTITY.sub(_character, text) if "&" in text else text


def _character(found: re.Match[str]) -> str:
    decimal, hexadecimal, name = found.groups()
    if name:
        return _ENTITIES[name]
    code = int(decimal) if decimal else int(hexadecimal, 16)
    return chr(code) if 0 < code < 0x110000 else found[0]
