"""Read the elements of an MJCF as leniently as MuJoCo's parser does, which accepts `a & b` and ignores encodings."""

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

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


@dataclass(frozen=True)
class Element:
    """Start of an element, or its end, which has no attributes."""

    tag: str
    attributes: dict[str, str]
    ends: bool = False


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
