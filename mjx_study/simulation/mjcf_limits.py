"""Limits on what an element of an MJCF may ask for: sizes, which MuJoCo would allocate, and finite numbers."""

import math
import re
from collections.abc import Collection, Iterator
from typing import Final

from mjx_study.simulation.mjcf_text import Element

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
_OF_TEXT: Final = ("text", "config")
"""Elements whose attributes are text."""
_NUMBER: Final = re.compile(
    r"([+-]?(?:(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|nan|inf(?:inity)?))(?:(?<=nan)\(\w*\))?", re.IGNORECASE
)


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
