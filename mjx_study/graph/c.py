"""Write graphs of scalars as C, with a vector of samples for every scalar.

Every node becomes a variable that holds one value per lane. Booleans are masks of all bits, so that selections need no
branches. A loop runs until it has ended in all lanes, and a lane in which it has ended keeps its values: what a sample
gives does not depend on the samples beside it.
"""

import math
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import Any, Final

import numpy as np
from jax import lax

from mjx_study.graph.function import ScalarFunction
from mjx_study.graph.nodes import Node, needed_for, no_type_check

_OPERATORS: Final = {
    **{"add": "+", "add_any": "+", "sub": "-", "mul": "*", "and": "&", "or": "|", "xor": "^"},
}
_COMPARISONS: Final = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
_OF_MASKS: Final = {"lt": ">", "le": ">=", "gt": "<", "ge": "<=", "eq": "==", "ne": "!="}
"""Comparisons of booleans; as an integer, a true one is -1."""
_FUNCTIONS: Final = frozenset(
    (
        *("abs", "acos", "asin", "atan", "atan2", "ceil", "cos", "cosh", "erf", "exp", "expm1", "floor", "log"),
        *("log1p", "max", "min", "rem", "sign", "sin", "sinh", "sqrt", "tan", "tanh"),
    )
)
"""Operations that the prelude has as functions, by type."""
_TYPES: Final = (*("float64", "float32", "int64", "int32", "int16", "int8", "uint64", "uint32", "uint16", "uint8"),)
_NAMES: Final = {np.dtype(name): f"{name[0]}{8 * np.dtype(name).itemsize}" for name in _TYPES} | {
    np.dtype(bool): "mask"
}


MAX_ARGUMENT: Final = 4000
"""Maximum size of a kernel's argument [bytes]."""


class NotWrittenError(Exception):
    """The graph has an operation or a type that C is not written for."""


def source_of(function: ScalarFunction, platform: str = "cpu") -> str:
    """Write a function of arrays as C: a handler of XLA's foreign function interface for batches of samples.

    For "gpu" the same text is the source of a kernel in CUDA and of the handler that starts it.

    The handler takes the inputs and gives the outputs with the batch as their fastest dimension; inputs may have none.

    Raises:
        NotWrittenError: an operation or a type is not covered.
    """
    body = _Writer()
    for place, array in enumerate(function.inputs):
        for at, node in enumerate(array.flat):
            body.loaded(node, place, at)
    body.write(function.needed)
    for place, (array, aval) in enumerate(zip(function.outputs, function.avals, strict=True)):
        for at, value in enumerate(array.flat):
            body.store(place, at, value, aval.dtype)
    forms_in = [(array.size, array.flat[0].dtype, array.ndim) for array in function.inputs]
    forms_out = [(math.prod(aval.shape), aval.dtype, aval.ndim) for aval in function.avals]
    if platform == "gpu":
        samples = [_text("prelude.cu"), "SAMPLES {", "BEGIN", *body.lines, "}"]
        parts = ["#ifdef __CUDACC_RTC__", *samples, "#else", _text("launcher.c"), "#endif"]
        return "\n".join([_batch(forms_in, forms_out), *parts, ""])
    wide = any(dtype.itemsize == 8 for dtype in body.dtypes)
    return "\n".join(
        [
            f"#define WIDE {int(wide)}",
            f"#define INPUTS {_forms(forms_in)}",
            f"#define OUTPUTS {_forms(forms_out)}",
            f"#define BYTES {sum(size * np.dtype(dtype).itemsize for size, dtype, _ in forms_in + forms_out)}",
            _text("prelude.c"),
            "static void samples(const char *const *in, const long *in_step, char *const *out, const long *out_step) {",
            *body.lines,
            "}",
            "",
            _text("handler.c"),
        ]
    )


Forms = Sequence[tuple[int, Any, int]]
"""Entries, type and dimensions of arrays."""


def _batch(inputs: Forms, outputs: Forms) -> str:
    """Argument of a kernel, for the kernel and for what starts it."""
    if 12 * len(inputs) + 8 * len(outputs) > MAX_ARGUMENT:
        raise NotWrittenError(f"{len(inputs)} inputs and {len(outputs)} outputs")
    return f"""\
#define THREADS 128
#define NUM_IN {len(inputs)}
#define NUM_OUT {len(outputs)}
#define RANKS_OF_INPUTS {", ".join(str(rank) for *_, rank in inputs)}
#define RANK_OF_OUTPUT {outputs[0][2]}
struct batch {{
  long count;
  const char *in[NUM_IN];
  char *out[NUM_OUT];
  int shared[NUM_IN];  // whether an array is the same for all samples
}};"""


def _text(name: str) -> str:
    return resources.files("mjx_study.graph").joinpath(name).read_text()


def _forms(arrays: Forms) -> str:
    """Initialisers of the handler's descriptions of arrays: entries, bytes of an entry, dimensions."""
    return ", ".join(f"{{{size}, {np.dtype(dtype).itemsize}, {rank}}}" for size, dtype, rank in arrays)


def _type(dtype: Any) -> str:
    name = _NAMES.get(np.dtype(dtype))
    if name is None:
        raise NotWrittenError(f"values of type {dtype}")
    return name


@no_type_check
def _constant(value: Any) -> str:
    kind, value = _type(value.dtype), value.item()
    if kind == "mask":
        return f"ALL(mask, {-int(value)})"
    if isinstance(value, int):
        return f"ALL({kind}, {value + 1} - 1)" if value < 0 else f"ALL({kind}, {value}{'u' if kind[0] == 'u' else ''})"
    if math.isfinite(value):
        return f"ALL({kind}, {value.hex()}{'f' if kind == 'f32' else ''})"
    return f"ALL({kind}, {'NAN' if math.isnan(value) else 'INFINITY' if value > 0 else '-INFINITY'})"


@no_type_check
class _Writer:
    """Statements that compute nodes, and the C expressions of those computed so far."""

    def __init__(self):
        self.lines: list[str] = []
        self.dtypes: set[Any] = set()
        self._names: dict[int, str] = {}

    def value(self, argument: Any) -> str:
        self.dtypes.add(argument.dtype)
        return self._names[argument.number] if isinstance(argument, Node) else _constant(argument)

    def loaded(self, node: Node, place: int, at: int) -> None:
        kind = _type(node.dtype)
        self.dtypes.add(node.dtype)
        self._names[node.number] = f"x{node.number}"
        load = f"LOAD_BOOL({place}, {at})" if kind == "mask" else f"LOAD({kind}, {place}, {at})"
        self.lines.append(f"{kind} x{node.number} = {load};")

    def store(self, place: int, at: int, value: Any, dtype: Any) -> None:
        kind = _type(dtype)
        form = f"STORE_BOOL({place}, {at}, " if kind == "mask" else f"STORE({kind}, {place}, {at}, "
        self.lines.append(f"{form}{self.value(value)});")

    def write(self, nodes: Iterable[Node]) -> None:
        for node in nodes:
            if node.number in self._names:
                continue
            match node.operation:
                case "loop":
                    self._loop(node)
                    self._names[node.number] = ""
                case "output":
                    (loop,), (place, _) = node.arguments, node.parameters
                    self._names[node.number] = self._names[loop.parameters[0][place].number]
                case "whole":
                    raise NotWrittenError(node.parameters[0].primitive.name)
                case primitive:
                    self._names[node.number] = name = f"x{node.number}"
                    self.dtypes.add(node.dtype)
                    self.lines.append(f"{_type(node.dtype)} {name} = {self._expression(primitive.name, node)};")

    def _loop(self, node: Node) -> None:
        carried, again, after = node.parameters
        for each, start in zip(carried, node.arguments, strict=False):
            self.lines.append(f"{_type(each.dtype)} x{each.number} = {self.value(start)};")
            self._names[each.number] = f"x{each.number}"
        outside = dict(self._names)
        self.lines.append("for (;;) {")
        self.write(needed_for(again))
        self.lines.append(f"mask again = {self.value(again[0])};\nif (!any(again)) break;")
        self.write(needed_for(after))
        kinds = [_select(each.dtype) for each in carried]
        self.lines += [
            f"{_type(each.dtype)} next{place} = {kind}(again, x{each.number}, {self.value(value)});"
            for place, (each, kind, value) in enumerate(zip(carried, kinds, after, strict=True))
        ]
        self.lines += [f"x{each.number} = next{place};" for place, each in enumerate(carried)]
        self.lines.append("}")
        self._names = outside

    def _expression(self, name: str, node: Node) -> str:
        values = [self.value(each) for each in node.arguments]
        (first, *others), kind, parameters = values, _type(node.dtype), node.parameters or {}
        of = node.arguments[0].dtype
        match name:
            case _ if name in _COMPARISONS:
                signs = _OF_MASKS if _type(of) == "mask" else _COMPARISONS
                return f"MASK({first} {signs[name]} {others[0]})"
            case "max" | "min" if kind == "mask":
                return f"{first} {'|' if name == 'max' else '&'} {others[0]}"
            case _ if name in _OPERATORS:
                return f"{first} {_OPERATORS[name]} {others[0]}"
            case "div":
                return f"{first} / {others[0]}" if node.dtype.kind == "f" else f"div_{kind}({first}, {others[0]})"
            case "abs" if node.dtype.kind in "iu":
                return first if node.dtype.kind == "u" else f"max_{kind}({first}, -{first})"
            case _ if name in _FUNCTIONS:
                return f"{name}_{kind}({', '.join(values)})"
            case "neg":
                return f"-{first}"
            case "not":
                return f"~{first}"
            case "square":
                return f"{first} * {first}"
            case "integer_pow":
                return self._power(first, parameters["y"], node)
            case "pow":
                exponent = others[0] if node.arguments[1].dtype == node.dtype else f"AS({kind}, {others[0]})"
                return f"pow_{kind}({first}, {exponent})"
            case "rsqrt":
                return f"1 / sqrt_{kind}({first})"
            case "logistic":
                return f"1 / (1 + exp_{kind}(-{first}))"
            case "round":
                even = parameters["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN
                return f"{'rint' if even else 'round'}_{kind}({first})"
            case "is_finite":
                return f"MASK(abs_{_type(of)}({first}) < INFINITY)"
            case "clamp":
                return f"min_{kind}(max_{kind}({others[0]}, {first}), {others[1]})"
            case "select_n":
                return self._selection(node.arguments[0], values, _select(node.dtype))
            case "convert_element_type":
                return _converted(first, np.dtype(of), node.dtype)
        raise NotWrittenError(name)

    def _power(self, base: str, exponent: int, node: Node) -> str:
        """Multiply by repeated squaring, like XLA."""
        kind, name = _type(node.dtype), f"x{node.number}"
        product, square, left = None, base, abs(exponent)
        for place in range(left.bit_length()):
            if place:
                self.lines.append(f"{kind} {name}_{place} = {square} * {square};")
                square = f"{name}_{place}"
            if left >> place & 1:
                product = square if product is None else f"{product} * {square}"
        product = product or f"ALL({kind}, 1)"
        return product if exponent >= 0 else f"1 / ({product})"

    def _selection(self, which: Any, values: Sequence[str], select: str) -> str:
        index, first, *others = values
        if _type(which.dtype) == "mask":
            return f"{select}({index}, {first}, {others[0]})"
        for place, other in enumerate(others, 1):
            first = f"{select}(MASK({index} == {place}), {first}, {other})"
        return first


def _select(dtype: Any) -> str:
    kind = _type(dtype)
    return f"select_{'bool' if kind == 'mask' else kind}"


def _converted(value: str, old: np.dtype[Any], new: np.dtype[Any]) -> str:
    of, to = _type(old), _type(new)
    if of == "mask":
        return f"select_{to}({value}, ALL({to}, 0), ALL({to}, 1))"
    if to == "mask":
        return f"MASK({value} != 0)"
    if old.kind == "f" and new.kind in "iu":
        return f"{to}_of_{of}({value})"
    return f"AS({to}, {value})"
