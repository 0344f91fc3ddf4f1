"""Check sizes in an MJCF before MuJoCo allocates them, which may abort the process or exhaust memory."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

MOST: Final[dict[tuple[str, ...], float]] = {
    ("hfield", "nrow", "ncol"): 1e8,
    ("texture", "width", "height"): 1e8,
    ("mesh", "params"): 1e3,
    ("composite", "count"): 1e4,
    ("flexcomp", "count"): 1e5,
    ("replicate", "count"): 1e4,
    ("numeric", "size"): 1e6,
    ("size", "memory"): 1e10,
    ("size", "nuserdata"): 1e6,
    ("size", "nkey"): 1e4,
    ("size", "njmax"): 1e6,
    ("size", "nconmax"): 1e6,
    ("size", "nstack"): 1e9,
}
"""Limit on the product of an element's attributes; for nested `replicate`, the product over all levels."""
SAMPLES: Final = 1e5
"""Limit on `nsample` of any element."""
USER: Final = 1e4
"""Limit on nuser_body, nuser_jnt, ... of <size>."""
_UNITS: Final = {"K": 2.0**10, "M": 2.0**20, "G": 2.0**30, "T": 2.0**40, "P": 2.0**50, "E": 2.0**60}


def too_large(path: Path) -> str | None:
    """Describe the first excessive size in an MJCF or its includes; None if there is none or it is not XML."""
    files, seen = [path], {path}
    while files:
        found, included = _scan(files.pop())
        if found is not None:
            return found
        fresh = {path.parent / name for name in included} - seen
        files += [file for file in fresh if file.is_file()]
        seen |= fresh
    return None


def _scan(path: Path) -> tuple[str | None, list[str]]:
    included, repeats = [], [1.0]
    try:
        for event, element in ElementTree.iterparse(path, events=("start", "end")):
            if event == "start":
                if element.tag == "replicate":
                    repeats.append(repeats[-1] * (_product(element.get("count", "")) or 1.0))
                included += [element.get("file", "")] * (element.tag == "include")
                for what, size, limit in _sizes(element, repeats[-1]):
                    if size > limit:
                        return f"{what} of {size:.3g} in {path.name}; the limit is {limit:g}", included
            elif element.tag == "replicate":
                repeats.pop()
    except (ElementTree.ParseError, OSError, ValueError):  # MuJoCo reports what is wrong
        pass
    return None, [name for name in included if name and "\0" not in name]


def _sizes(element: ElementTree.Element, repeats: float) -> Iterator[tuple[str, float, float]]:
    """Yield description, size and limit of everything that an element's attributes request."""
    tag = str(element.tag)
    for (of, *names), limit in MOST.items():
        if of == tag and all(name in element.attrib for name in names):
            size = repeats if tag == "replicate" else math.prod(_product(element.attrib[name]) for name in names)
            yield f"<{tag}> with {' x '.join(names)}", size, limit
    for name, text in element.attrib.items():
        if name == "nsample" or (tag == "size" and name.startswith("nuser_")):
            yield f"<{tag}> with {name}", _product(text), SAMPLES if name == "nsample" else USER


def _product(text: str) -> float:
    """Product of the numbers in an attribute such as 10, 3 3 3 or 2G; 0 if there are none."""
    try:
        numbers = [float(part.rstrip("KMGTPE")) * _UNITS.get(part[-1], 1.0) for part in text.split()]
    except ValueError:
        return 0.0
    return math.prod(abs(number) for number in numbers) if numbers else 0.0
