"""Write graphs of scalars as C, with a vector of samples for every scalar.

Every node becomes a variable that holds one value per lane. Booleans are masks of all bits, so that selections need no
branches. A loop runs until it has ended in all lanes, and a lane in which it has ended keeps its values: what a sample
gives does not depend on the samples beside it.
"""

import itertools
import math
from collections.abc import Iterable, Sequence
from importlib import resources
from typing import Any, Final

import numpy as np
from jax import lax

from mjx_study.graph.function import ScalarFunction
from mjx_study.graph.nodes import Node, needed_for, no_type_check
from mjx_study.graph.parts import Loop, Statement, in_parts

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
MOST_TOGETHER: Final = {"cpu": 500, "gpu": 20_000}
"""Maximum number of statements in a function; compilers allocate registers in more than linear time."""


class NotWrittenError(Exception):
    """The graph has an operation or a type that C is not written for."""


def source_of(function: ScalarFunction, platform: str = "cpu") -> str:
    """Write a function of arrays as C: a handler of XLA's foreign function interface for batches of samples.

    For "gpu" the same text is the source of a kernel in CUDA and of the handler that starts it.

    The handler takes the inputs and gives the outputs with the batch as their fastest dimension; inputs may have none.

    Raises:
        NotWrittenError: an operation or a type is not covered.
    """
    writer = _Writer(function)
    functions, num_kept = in_parts(writer.statements(), writer.loads, MOST_TOGETHER[platform])
    forms_in = [(math.prod(each.shape), each.dtype, each.ndim) for each in function.types]
    forms_out = [(math.prod(each.shape), each.dtype, each.ndim) for each in function.avals]
    if platform == "gpu":
        kernel = [_text("prelude.cu"), _text("functions.c"), *functions, _text("kernel.cu")]
        parts = ["#ifdef __CUDACC_RTC__", *kernel, "#else", _text("launcher.c"), "#endif"]
        return "\n".join([_batch(forms_in, forms_out), f"#define KEPT {num_kept}", *parts, ""])
    wide = any(dtype.itemsize == 8 for dtype in writer.dtypes)
    return "\n".join(
        [
            f"#define WIDE {int(wide)}",
            f"#define INPUTS {_forms(forms_in)}",
            f"#define OUTPUTS {_forms(forms_out)}",
            f"#define BYTES {sum(size * np.dtype(dtype).itemsize for size, dtype, _ in forms_in + forms_out)}",
            f"#define KEPT {num_kept}",
            _text("prelude.c"),
            _text("functions.c"),
            *functions,
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
        return f"ALL({kind}, {value!r}{'f' if kind == 'f32' else ''})"
    return f"ALL({kind}, {'NAN' if math.isnan(value) else 'INFINITY' if value > 0 else '-INFINITY'})"


@no_type_check
class _Writer:
    """Statements that compute a function; the variable of a node has its number."""

    def __init__(self, function: ScalarFunction):
        self._function = function
        self.dtypes: set[Any] = set()
        self.loads: dict[int, str] = {}
        self._stores: dict[int, list[str]] = {}
        self._names: dict[int, int] = {}
        self._uses: set[int] = set()
        self._before: list[str] = []

    def statements(self) -> list[Statement | Loop]:
        """All statements, with every output stored as soon as it is known."""
        for place, array in enumerate(self._function.inputs):
            for at, node in enumerate(array.flat):
                self._load(node, place, at)
        constant = []
        for place, (array, aval) in enumerate(zip(self._function.outputs, self._function.avals, strict=True)):
            for at, entry in enumerate(array.flat):
                kind, value = _type(aval.dtype), "{}" if isinstance(entry, Node) else _constant(entry)
                self.dtypes.add(aval.dtype)
                store = "STORE_BOOL(" if kind == "mask" else f"STORE({kind}, "
                text = f"{store}{place}, {at}, {value});"
                if isinstance(entry, Node):
                    self._stores.setdefault(entry.number, []).append(text)
                else:
                    constant.append(Statement(text, frozenset()))
        known = [self._stored(number, number) for number in self.loads if number in self._stores]
        return [*itertools.chain(*known), *self._written(self._function.needed), *constant]

    def _load(self, node: Node, place: int, at: int) -> None:
        kind = _type(node.dtype)
        self.dtypes.add(node.dtype)
        load = f"LOAD_BOOL({place}, {at})" if kind == "mask" else f"LOAD({kind}, {place}, {at})"
        self.loads[node.number] = f"{kind} x{node.number} = {load};"
        self._names[node.number] = node.number

    def _stored(self, number: int, name: int) -> list[Statement]:
        return [Statement(each.format(f"x{name}"), frozenset({name})) for each in self._stores.get(number, ())]

    def _value(self, argument: Any) -> str:
        self.dtypes.add(argument.dtype)
        if not isinstance(argument, Node):
            return _constant(argument)
        name = self._names[argument.number]
        self._uses.add(name)
        return f"x{name}"

    def _statement(self, lines: list[str], defines: dict[int, str]) -> Statement:
        uses, self._uses = frozenset(self._uses), set()
        return Statement("\n".join(lines), uses, defines, len(lines))

    def _written(self, nodes: Iterable[Node]) -> list[Statement | Loop]:
        found: list[Statement | Loop] = []
        for node in nodes:
            if node.number in self._names:
                continue
            self._names[node.number] = node.number
            match node.operation:
                case "loop":
                    found += self._loop(node)
                case "output":
                    (loop,), (place, _) = node.arguments, node.parameters
                    self._names[node.number] = self._names[loop.parameters[0][place].number]
                case "whole":
                    raise NotWrittenError(node.parameters[0].primitive.name)
                case primitive:
                    self.dtypes.add(node.dtype)
                    kind = _type(node.dtype)
                    line = f"{kind} x{node.number} = {self._expression(primitive.name, node)};"
                    lines, self._before = [*self._before, line], []
                    found.append(self._statement(lines, {node.number: kind}))
            found += self._stored(node.number, self._names[node.number])
        return found

    def _loop(self, node: Node) -> list[Statement | Loop]:
        carried, again, after = node.parameters
        kinds = {each.number: _type(each.dtype) for each in carried}
        starts = zip(kinds.items(), node.arguments, strict=False)
        begin = self._statement([f"{kind} x{at} = {self._value(start)};" for (at, kind), start in starts], kinds)
        outside = dict(self._names) | {at: at for at in kinds}
        self._names = dict(outside)
        test = self._written(needed_for(again))
        test.append(self._statement([f"mask x{node.number} = {self._value(again[0])};"], {node.number: "mask"}))
        body = self._written(needed_for(after))
        self._uses |= {node.number, *kinds}
        lines = [
            f"{kinds[each.number]} next{each.number} = "
            f"{_select(each.dtype)}(x{node.number}, x{each.number}, {self._value(value)});"
            for each, value in zip(carried, after, strict=True)
        ]
        body.append(self._statement([*lines, *(f"x{at} = next{at};" for at in kinds)], kinds))
        self._names = outside
        return [begin, Loop(test, node.number, body)]

    def _expression(self, name: str, node: Node) -> str:
        values = [self._value(each) for each in node.arguments]
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
                self._before.append(f"{kind} {name}_{place} = {square} * {square};")
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
