"""Graphs of scalars as Python, with a NumPy vector of samples for every scalar: for machines without a compiler.

The statements are those of C, which are Python but for types, semicolons and constants. XLA calls a function as it
calls a library, and its name is a digest of its content, too: caches need not know what they keep.
"""

import ctypes
import math
import re
import traceback
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import numpy as np
from scipy import special

from mjx_study.graph.c import COMPARISONS, NAMES, Writer
from mjx_study.graph.function import Passes, ScalarFunction
from mjx_study.graph.parts import Loop, Statement

BLOCK: Final = 2048
"""Samples computed together: with fewer, Python takes longer than NumPy."""
BEGINNING: Final = "# NumPy"
"""First line of a source."""
MOST_IDLE: Final = 0.75  # share of lanes below which those in which a loop has ended are left out
_HANDLER: Final = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
_INVALID: Final = 13  # XLA's code of an internal error


def python_source(function: ScalarFunction, passes: Passes | None = None) -> str:
    """Write a function, or all passes of a loop whose body it is, as a module of Python.

    It has the forms of the arrays as `INPUTS` and `OUTPUTS`, and a function `samples(i, o, lanes)` that computes
    outputs, rows of samples per entry.

    Raises:
        NotWrittenError: an operation or a type is not covered.
    """
    writer = _Writer(function)
    items, inputs, outputs = writer.written(passes)
    text = _Text()
    lines = [*map(text.python, writer.loads.values()), *text.lines(items)]
    forms = [[(aval.size, aval.dtype.name, aval.ndim) for aval in each] for each in (inputs, outputs)]
    head = [BEGINNING, f"INPUTS, OUTPUTS = {forms[0]}, {forms[1]}"]
    known = [f"{name} = {value}" for value, name in text.constants.items()]
    known += [f"{name} = array({list(entries)}, {kind})" for (kind, entries), name in writer.constant_vectors.items()]
    return "\n".join([*head, *known, *text.loops, "def samples(i, o, lanes):", *_indented(lines), " pass", ""])


def _indented(lines: Iterable[str]) -> list[str]:
    return [f" {line}" for line in lines]


class _Writer(Writer):
    """Statements for NumPy, whose booleans are 0 and 1."""

    of_masks = COMPARISONS


class _Text:
    """Lines of Python for statements, with the constants and the functions for a pass of each loop that they use."""

    def __init__(self) -> None:
        self.constants: dict[str, str] = {}
        self.loops: list[str] = []

    def lines(self, items: Iterable[Statement | Loop], kept: Iterable[int] = ()) -> list[str]:
        """Lines for statements; what no later one uses is forgotten unless `kept`, so that its memory is used again."""
        items = list(items)
        wholes = list(map(_whole, items))
        last = {at: place for place, each in enumerate(wholes) for at in each.uses}
        ends: dict[int, list[int]] = {}
        for at in last.keys() - set(kept):
            ends.setdefault(last[at], []).append(at)
        found: list[str] = []
        for place, (item, whole) in enumerate(zip(items, wholes, strict=True)):
            if isinstance(item, Statement):
                found += map(self.python, item.text.split("\n"))
            elif item.again is None:
                found += self._passes(item)
            else:
                found.append(self._until_all_end(item, item.again, whole))
            found += [f"del {_named(ends[place])}"] if place in ends else []
        return found

    def _passes(self, loop: Loop) -> list[str]:
        """A loop of known length."""
        last, first = (re.search(pattern, loop.head) for pattern in (r"(\w+) < (\d+)", r"(\w+) = (\d+); \w+ >= 0"))
        found = last or first
        assert found is not None
        passes = f"range({found[2]})" if last else f"range({found[2]}, -1, -1)"
        inside = [*map(self.python, loop.loads.values()), *self.lines(loop.body, loop.together().uses)]
        return [f"for {found[1]} in {passes}:", *_indented(inside)]

    def _until_all_end(self, loop: Loop, again: int, whole: Statement) -> str:
        """The call of a loop whose passes are a function of their own."""
        carried = sorted(whole.defines)
        fixed = sorted(whole.uses.difference(carried))
        ended = Statement(f"if not any(x{again}): return x{again}, carried", frozenset({again}))
        inside = self.lines([*loop.test, ended, *loop.body], [again, *carried])
        name = f"pass{len(self.loops)}"
        unpacked = [f"({_named(carried)},) = carried", f"(lanes, {_named(fixed)}) = fixed"]
        returned = f"return x{again}, ({_named(carried)},)"
        lines = [*unpacked, *inside, returned]
        self.loops.append("\n".join([f"def {name}(i, carried, fixed):", *_indented(lines)]))
        return f"({_named(carried)},) = LOOP({name}, i, ({_named(carried)},), (lanes, {_named(fixed)}))"

    def python(self, line: str) -> str:
        """A statement of C in Python."""
        line = re.sub(r"ALL\((\w+), ([^()]+)\)", self._constant, line.removesuffix(";"))
        line = re.sub(r"MASK(?=\()", "", line)
        line = re.sub(r"\bselect_\w+\(([^,()]+), ([^,()]+), ([^,()]+)\)", r"where(\1, \3, \2)", line)
        line = re.sub(r"^\w+ (?=(x|next)[\d_]+ = )", "", line)
        line = re.sub(r"\bENTRY\(\w+, (\d+), (.*)\)$", r"i[\1][\2, lanes * (i[\1].shape[1] > 1)]", line)
        line = re.sub(r"\bTABLE\(\w+, (\w+), (.*)\)$", r"\1[\2]", line)
        line = re.sub(r"\bLOAD(?:_BOOL)?\((?:\w+, )?(\d+), ([^,]*)\)$", r"i[\1][\2]", line)
        return re.sub(r"^STORE(?:_BOOL)?\((?:[a-z]\w*, )?(\d+), ([^,]*), (.*)\)$", r"o[\1][\2] = \3", line)

    def _constant(self, found: re.Match[str]) -> str:
        """Name of a constant, a variable of the module."""
        value = f"{found[1]}({found[2].removesuffix('f' if found[1] == 'f32' else 'u')})"
        return self.constants.setdefault(value, f"c{len(self.constants)}")


def _whole(item: Statement | Loop) -> Statement:
    return item.together() if isinstance(item, Loop) else item


def _named(numbers: Iterable[int]) -> str:
    return ", ".join(f"x{at}" for at in numbers)


Values = Sequence[Any]
"""Arrays with an entry per lane, and others that are the same in all."""


def _looped(one_pass: Callable[..., tuple[Any, Values]], inputs: Values, carried: Values, fixed: Values) -> Values:
    """What a loop carries at its end; lanes in which it has ended are left out of later passes.

    Args:
        one_pass: from (inputs, carried, fixed) to where the loop goes on, and what it carries then.
        inputs: those of the function, for all lanes.
        fixed: the numbers of the lanes, and what does not change.
    """
    found = [np.array(np.broadcast_to(each, fixed[0].shape)) for each in carried]
    left = np.arange(len(fixed[0]))
    while True:
        again, carried = one_pass(inputs, carried, fixed)
        on = np.flatnonzero(np.broadcast_to(again, left.shape))
        if len(on) == 0 or len(on) < MOST_IDLE * len(left):
            for every, each in zip(found, carried, strict=True):
                every[left] = each
            if len(on) == 0:
                return found
            left = left[on]
            carried, fixed = ([each[on] if np.size(each) > 1 else each for each in some] for some in (carried, fixed))


def _divided(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    quotient = (one - np.fmod(one, other)) // np.where(other == 0, 1, other).astype(other.dtype)
    return np.where(other == 0, ~one.dtype.type(0), quotient).astype(one.dtype)


def _away(value: np.ndarray) -> np.ndarray:
    whole = np.trunc(value)
    return np.where(np.abs(value - whole) >= 0.5, whole + np.copysign(1, value), whole).astype(value.dtype)


def _saturated(kind: np.dtype[Any]) -> Callable[[np.ndarray], np.ndarray]:
    least, most = np.iinfo(kind).min, np.iinfo(kind).max

    def rounded(value: np.ndarray) -> np.ndarray:
        inside = (value > least) & (value < most)
        return np.where(inside, np.where(inside, value, 0).astype(kind), np.where(value > 0, most, least * (value < 0)))

    return lambda value: rounded(np.asarray(value, float)).astype(kind)


def _names() -> dict[str, Any]:
    """What the sources call, under the names that the prelude of C has."""
    alike = {"abs": np.abs, "max": np.maximum, "min": np.minimum, "pow": np.power, "round": _away, "erf": special.erf}
    others = "ceil cos cosh exp expm1 floor log log1p rint sin sinh sqrt tan tanh".split()
    alike |= {name: getattr(np, name) for name in others}
    alike |= {name: getattr(np, f"arc{name[1:]}") for name in ("acos", "asin", "atan", "atan2")}
    alike["sign"] = lambda value: np.where(value == 0, value, np.sign(value))
    names: dict[str, Any] = {"select_bool": lambda which, no, yes: np.where(which, yes, no), "mask": np.bool_}
    for kind, short in NAMES.items():
        names |= {f"{name}_{short}": function for name, function in alike.items()} | {short: kind.type}
        names |= {f"select_{short}": names["select_bool"], f"div_{short}": _divided, f"rem_{short}": np.fmod}
        if kind.kind in "iu":
            names[f"rem_{short}"] = lambda one, other: np.where(other == 0, one, np.fmod(one, other))
            names |= {f"{short}_of_f64": _saturated(kind), f"{short}_of_f32": _saturated(kind)}
    names |= {"AS": lambda kind, value: np.asarray(value).astype(kind), "any": np.any}
    names |= {"BITS": lambda kind, value: np.asarray(value).view(kind), "LOOP": _looped}
    return names | {
        "INFINITY": math.inf,
        "NAN": math.nan,
        "inf": math.inf,
        "nan": math.nan,
        "array": np.array,
        "where": np.where,
    }


class Library:
    """A source as a handler of XLA's foreign function interface."""

    def __init__(self, source: str):
        names = _names()
        exec(compile(source, "<graph>", "exec"), names)  # ours, or checked by its digest
        self._samples, self._forms = names["samples"], (names["INPUTS"], names["OUTPUTS"])
        self.handler: Final = _HANDLER(self._called)

    def _called(self, at: int) -> int | None:
        frame = _Frame.from_address(at)
        if frame.extension and _Extension.from_address(frame.extension).kind == 1:
            metadata = _Metadata.from_address(_Extension.from_address(frame.extension).metadata)
            metadata.version = _Api.from_address(frame.api).version
            return None
        try:
            self._compute(frame)
        except BaseException:  # ctypes would print and forget it
            message = traceback.format_exc().encode()
            error = _Error(ctypes.sizeof(_Error), None, message, _INVALID)
            return _Api.from_address(frame.api).create(ctypes.addressof(error))
        return None

    def _compute(self, frame: Any) -> None:
        inputs, outputs = (
            [_array(_Buffer.from_address(each.items[place]), *form) for place, form in enumerate(forms)]
            for each, forms in zip((frame.inputs, frame.outputs), self._forms, strict=True)
        )
        count = _without_copies(inputs, outputs[0].shape[1])
        with np.errstate(all="ignore"):
            for first in range(0, count, BLOCK):
                part = slice(first, min(first + BLOCK, count))
                some = [each if each.shape[1] == 1 else each[:, part] for each in inputs]
                self._samples(some, [each[:, part] for each in outputs], np.arange(part.stop - first))
        for each in outputs:
            each[:, count:] = each[:, count - 1 : count]


def _without_copies(inputs: Sequence[np.ndarray], count: int) -> int:
    """Number of samples without the copies of the last one that end a chunk."""
    same = np.ones(count, bool)
    for each in inputs:
        same &= np.all(each.view(f"u{each.itemsize}") == each[:, -1:].view(f"u{each.itemsize}"), axis=0)
    return count - int(np.argmin(same[::-1])) + 1 if not same.all() else 1


def _array(buffer: Any, size: int, kind: str, rank: int) -> np.ndarray:
    """Entries by samples."""
    dtype = np.dtype(kind)
    count = math.prod(buffer.dims[axis] for axis in range(buffer.rank - rank))
    memory = (ctypes.c_char * (size * count * dtype.itemsize)).from_address(buffer.data)
    return np.frombuffer(memoryview(memory), dtype).reshape(size, count)


def _struct(**fields: Any) -> Any:
    """A structure of XLA's interface, which begins with its size."""
    return type("Structure", (ctypes.Structure,), {"_fields_": [("size", ctypes.c_size_t), *fields.items()]})


_int, _long, _pointer = ctypes.c_int, ctypes.c_int64, ctypes.c_void_p
_Buffer: Final = _struct(extension=_pointer, kind=_int, data=_pointer, rank=_long, dims=ctypes.POINTER(_long))
_List: Final = _struct(extension=_pointer, count=_long, kinds=_pointer, items=ctypes.POINTER(_pointer))
_Error: Final = _struct(extension=_pointer, message=ctypes.c_char_p, code=_int)
_Version: Final = _struct(extension=_pointer, major=_int, minor=_int)
_Api: Final = _struct(extension=_pointer, version=_Version, internal=_pointer, create=_HANDLER)
_Frame: Final = _struct(extension=_pointer, api=_pointer, context=_pointer, stage=_int, inputs=_List, outputs=_List)
_Extension: Final = _struct(kind=_int, next=_pointer, metadata=_pointer)
_Metadata: Final = _struct(version=_Version)
