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
from jax.core import ShapedArray

from mjx_study.graph.function import Passes, ScalarFunction
from mjx_study.graph.nodes import (
    ELEMENTWISE,
    LoopBody,
    Node,
    collection_paused,
    depending_on,
    depth_first,
    entries_of,
)
from mjx_study.graph.parts import Loop, Statement, in_parts

COMPARISONS: Final = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
_FORMS: Final = {
    **{"add": "{0} + {1}", "add_any": "{0} + {1}", "sub": "{0} - {1}", "mul": "{0} * {1}", "square": "{0} * {0}"},
    **{"and": "{0} & {1}", "or": "{0} | {1}", "xor": "{0} ^ {1}", "neg": "-{0}", "not": "~{0}"},
    **{"rsqrt": "1 / sqrt_{kind}({0})", "logistic": "1 / (1 + exp_{kind}(-{0}))"},
    "clamp": "min_{kind}(max_{kind}({1}, {0}), {2})",
}
"""Expressions of operations; others are functions of the prelude, by type, or written by `Writer`."""
_TYPES: Final = (*("float64", "float32", "int64", "int32", "int16", "int8", "uint64", "uint32", "uint16", "uint8"),)
NAMES: Final = {np.dtype(name): f"{name[0]}{8 * np.dtype(name).itemsize}" for name in _TYPES} | {np.dtype(bool): "mask"}


MAX_ARGUMENT: Final = 4000  # maximum size of a kernel's argument [bytes]
MOST_TOGETHER: Final = {"cpu": (500, 500), "gpu": (20_000, 20_000), "gpu, long": (100, 100)}
"""Maximum numbers of lines in a function and in a loop that stays in one; compilers allocate registers in more than
linear time. Registers hold what a short function of a long kernel uses, which begins by loading all of it at once."""
SHARE: Final = "\n// The next share\n"
"""Beginning of a share of a source in C, which is compiled apart, after what precedes all shares."""
MOST_IN_SHARE: Final = 200_000  # size from which functions are divided into shares [characters]
LONG_KERNEL: Final = 40_000
"""Operations from which a kernel is separate functions that keep in memory what they pass on; a quadruped, of 28,000,
runs at twice the speed as one."""


class NotWrittenError(Exception):
    """The graph has an operation or a type that C is not written for."""


@collection_paused()
def source_of(function: ScalarFunction, platform: str = "cpu", passes: Passes | None = None) -> str:
    """Write a function of arrays as C: a handler of XLA's foreign function interface for batches of samples.

    For "gpu" the same text is the source of a kernel in CUDA and of the handler that starts it. With `passes`, the
    handler computes all passes of a loop whose body the function is.

    The handler takes the inputs and gives the outputs with the batch as their fastest dimension; inputs may have none.

    Raises:
        NotWrittenError: an operation or a type is not covered.
    """
    writer = Writer(function)
    statements, inputs, outputs = writer.written(passes)
    is_long = platform == "gpu" and function.size > LONG_KERNEL
    most = MOST_TOGETHER["gpu, long" if is_long else platform]
    functions, num_kept = in_parts(statements, writer.loads, *most)
    if platform == "gpu":
        kernel = [_text("prelude.cu"), _text("functions.c"), *writer.tables, *functions, _text("kernel.cu")]
        parts = ["#ifdef __CUDACC_RTC__", *kernel, "#else", _text("launcher.c"), "#endif"]
        return "\n".join(
            [_batch(inputs, outputs), f"#define KEPT {num_kept}", f"#define LONG {int(is_long)}", *parts, ""]
        )
    wide = any(dtype.itemsize == 8 for dtype in writer.dtypes)
    *parts, driver = functions
    return "\n".join(
        [
            f"#define WIDE {int(wide)}",
            f"#define INPUTS {_forms(inputs)}",
            f"#define OUTPUTS {_forms(outputs)}",
            f"#define BYTES {sum(aval.size * aval.dtype.itemsize for aval in (*inputs, *outputs))}",
            f"#define KEPT {num_kept}",
            f"#define OPERATIONS {max(1, function.size) * (1 if passes is None else passes.length)}L",
            _text("prelude.c"),
            _text("functions.c"),
            *writer.tables,
            *(f"{each.partition(' {')[0]};" for each in parts),
            *_shares([*parts, f"{driver}\n{_text('handler.c')}"]),
        ]
    )


def _shares(functions: Sequence[str]) -> list[str]:
    """Functions in turn, in shares of about `MOST_IN_SHARE` characters."""
    starts = itertools.accumulate(map(len, functions), initial=0)
    grouped = itertools.groupby(zip(starts, functions, strict=False), lambda each: each[0] // MOST_IN_SHARE)
    return [SHARE + "\n".join(function for _, function in group) for _, group in grouped]


def _batch(inputs: Sequence[ShapedArray], outputs: Sequence[ShapedArray]) -> str:
    """Argument of a kernel, for the kernel and for what starts it."""
    if 12 * len(inputs) + 8 * len(outputs) > MAX_ARGUMENT:
        raise NotWrittenError(f"{len(inputs)} inputs and {len(outputs)} outputs")
    return f"""\
#define THREADS 128
#define NUM_IN {len(inputs)}
#define NUM_OUT {len(outputs)}
#define RANKS_OF_INPUTS {", ".join(str(aval.ndim) for aval in inputs)}
#define RANK_OF_OUTPUT {outputs[0].ndim}
struct batch {{
  long count;
  const char *in[NUM_IN];
  char *out[NUM_OUT];
  int shared[NUM_IN];  // whether an array is the same for all samples
}};"""


def _text(name: str) -> str:
    return resources.files("mjx_study.graph").joinpath(name).read_text()


def _forms(avals: Sequence[ShapedArray]) -> str:
    """Initialisers of the handler's descriptions of arrays: entries, bytes of an entry, dimensions."""
    return ", ".join(f"{{{aval.size}, {aval.dtype.itemsize}, {aval.ndim}}}" for aval in avals)


def _type(dtype: Any) -> str:
    name = NAMES.get(np.dtype(dtype))
    if name is None:
        raise NotWrittenError(f"values of type {dtype}")
    return name


def _constant(value: Any) -> str:
    kind = _type(value.dtype)
    return f"ALL({kind}, {_literal(kind, value.item())})"


def _literal(kind: str, value: Any) -> str:
    if kind == "mask":
        return str(-int(value))
    if isinstance(value, int):
        return f"{value + 1} - 1" if value < 0 else f"{value}{'u' if kind[0] == 'u' else ''}"
    if math.isfinite(value):
        return f"{value!r}{'f' if kind == 'f32' else ''}"
    return "NAN" if math.isnan(value) else "INFINITY" if value > 0 else "-INFINITY"


class Writer:
    """Statements that compute a function; the variable of a node has its number."""

    of_masks = {"lt": ">", "le": ">=", "gt": "<", "ge": "<=", "eq": "==", "ne": "!="}
    """Comparisons of booleans; as an integer, a true one is -1."""

    def __init__(self, function: ScalarFunction):
        self._function = function
        self._order = depth_first(entries_of(function.outputs))
        self.dtypes: set[Any] = set()
        self.loads: dict[int, str] = {}
        self._stores: dict[int, list[str]] = {}
        self._names: dict[int, int] = {}
        self._places: dict[int, tuple[int, int]] = {}
        self._uses: set[int] = set()
        self._before: list[str] = []
        self.constant_vectors: dict[tuple[str, tuple[Any, ...]], str] = {}

    @property
    def tables(self) -> list[str]:
        """Definitions of the constant vectors that the statements read at computed indices."""
        return [
            f"CONSTANTS({kind}) {name}[] = {{{', '.join(_literal(kind, each) for each in entries)}}};"
            for (kind, entries), name in self.constant_vectors.items()
        ]

    def written(
        self, passes: Passes | None
    ) -> tuple[list[Statement | Loop], Sequence[ShapedArray], Sequence[ShapedArray]]:
        """All statements, and the types of the inputs and outputs of the function, or of its passes."""
        if passes is not None:
            return self._loop_of(passes), *passes.avals(self._function)
        return self._statements(), self._function.types, self._function.avals

    def _statements(self) -> list[Statement | Loop]:
        """All statements, with every output stored as soon as it is known."""
        self.loads = self._loaded(range(len(self._function.inputs)))
        constant = self._stores_of(range(len(self._function.outputs)), self._function.outputs)
        known = [self._stored(number, number) for number in self.loads]
        return [*itertools.chain(*known), *self._written(self._order), *constant]

    def _loop_of(self, passes: Passes) -> list[Statement | Loop]:
        """All statements of a loop with the function as its body; what is the same in all passes comes before it."""
        function, (first, second) = self._function, (passes.num_consts, passes.num_consts + passes.num_carry)
        carried = entries_of(function.inputs[first:second])
        after = entries_of(function.outputs[: passes.num_carry])
        self.loads = self._loaded(range(first))
        starts = self._loaded(range(first, second))
        begin = [Statement(text, frozenset(), self._kinds([at])) for at, text in starts.items()]
        changing = depending_on(function.needed, [*carried, *entries_of(function.inputs[second:])])
        fixed = self._written(each for each in self._order if each.number not in changing)
        rows = self._loaded(range(second, len(function.inputs)), each_pass=True)
        outputs = range(passes.num_carry, len(function.outputs))
        constant = self._stores_of(outputs, function.outputs[passes.num_carry :], each_pass=True)
        known = [self._stored(number, name) for number, name in self._names.items()]
        body = [*itertools.chain(*known), *self._written(self._order), *constant]
        moved = [(each.number, value) for each, value in zip(carried, after, strict=True) if each is not value]
        kinds = self._kinds(at for at, _ in moved)
        lines = [f"{kinds[at]} next{at} = {self._value(value)};" for at, value in moved]
        self._uses |= kinds.keys()
        body.append(self._statement([*lines, *(f"x{at} = next{at};" for at in kinds)], kinds))
        self._stores = {}
        self._stores_of(range(passes.num_carry), function.inputs[first:second])
        end = [self._stored(each.number, each.number) for each in carried]
        return [
            *begin,
            *fixed,
            Loop([], None, body, _head("step", passes.length, passes.reverse), rows),
            *itertools.chain(*end),
        ]

    def _kinds(self, numbers: Iterable[int]) -> dict[int, str]:
        kinds = {node.number: node.dtype for node in entries_of(self._function.inputs)}
        return {number: _type(kinds[number]) for number in numbers}

    def _loaded(self, places: Iterable[int], each_pass: bool = False) -> dict[int, str]:
        """Declarations of the entries of inputs by number; those of each pass of a loop in turn or of the only one."""
        found: dict[int, str] = {}
        for place in places:
            array = self._function.inputs[place]
            for at, node in enumerate(array.flat):
                kind = _type(node.dtype)
                self.dtypes.add(node.dtype)
                where = f"{place}, {at} + {array.size} * step" if each_pass else f"{place}, {at}"
                load = f"LOAD_BOOL({where})" if kind == "mask" else f"LOAD({kind}, {where})"
                found[node.number] = f"{kind} x{node.number} = {load};"
                self._places[node.number] = place, at
                self._names[node.number] = node.number
        return found

    def _stores_of(
        self, places: Iterable[int], arrays: Iterable[np.ndarray], each_pass: bool = False
    ) -> list[Statement]:
        """Prepare to store the entries of outputs as soon as they are known; the statements for constant ones."""
        constant = []
        for place, array in zip(places, arrays, strict=True):
            aval = self._function.avals[place]
            for at, entry in enumerate(array.flat):
                kind, value = _type(aval.dtype), "{}" if isinstance(entry, Node) else _constant(entry)
                self.dtypes.add(aval.dtype)
                store = "STORE_BOOL(" if kind == "mask" else f"STORE({kind}, "
                where = f"{place}, {at} + {array.size} * step" if each_pass else f"{place}, {at}"
                text = f"{store}{where}, {value});"
                if isinstance(entry, Node):
                    self._stores.setdefault(entry.number, []).append(text)
                else:
                    constant.append(Statement(text, frozenset()))
        return constant

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
                    self._names[node.number] = self._names[loop.parameters.carried[place].number]
                case "whole":
                    raise NotWrittenError(node.parameters[0].primitive.name)
                case operation:
                    kind = _type(node.dtype)
                    self.dtypes.add(node.dtype)
                    read = isinstance(operation, str)
                    value = self._read(kind, node) if read else self._expression(node)
                    line = f"{kind} x{node.number} = {value};"
                    lines, self._before = [*self._before, line], []
                    found.append(self._statement(lines, {node.number: kind}))
            found += self._stored(node.number, self._names[node.number])
        return found

    def _read(self, kind: str, node: Node) -> str:
        """An entry at a computed index of an input, or of a constant vector."""
        index = self._value(node.arguments[0])
        if node.operation == "entry":
            place, at = self._places[node.arguments[1].number]
            return f"ENTRY({kind}, {place}, {at} + {node.parameters} * {index})"
        known, entries = self.constant_vectors, tuple(node.parameters.tolist())
        return f"TABLE({kind}, {known.setdefault((kind, entries), f'table{len(known)}')}, {index})"

    def _loop(self, node: Node) -> list[Statement | Loop]:
        body: LoopBody = node.parameters
        carried, after, length = body.carried, body.after, body.length
        kinds = {each.number: _type(each.dtype) for each in carried}
        starts = zip(kinds.items(), node.arguments, strict=False)
        begin = self._statement([f"{kind} x{at} = {self._value(start)};" for (at, kind), start in starts], kinds)
        outside = dict(self._names) | {at: at for at in kinds}
        self._names = dict(outside)
        test: list[Statement | Loop] = []
        if length is None:
            test = self._written(depth_first([body.again], self._names))
            test.append(self._statement([f"mask x{node.number} = {self._value(body.again)};"], {node.number: "mask"}))
        inside = self._written(depth_first(after, self._names))
        values = [self._value(each) for each in after]
        if length is None:
            self._uses |= {node.number, *kinds}
            pairs = zip(carried, values, strict=True)
            values = [f"{_select(each.dtype)}(x{node.number}, x{each.number}, {value})" for each, value in pairs]
        lines = [f"{kind} next{at} = {value};" for (at, kind), value in zip(kinds.items(), values, strict=True)]
        self._uses |= kinds.keys()
        inside.append(self._statement([*lines, *(f"x{at} = next{at};" for at in kinds)], kinds))
        self._names = outside
        if length is None:
            return [begin, Loop(test, node.number, inside)]
        return [begin, Loop([], None, inside, _head(f"int pass{node.number}", length))]

    def _expression(self, node: Node) -> str:
        name = node.operation.name
        values = [self._value(each) for each in node.arguments]
        (first, *others), kind, parameters = values, _type(node.dtype), node.parameters or {}
        of = node.arguments[0].dtype
        match name:
            case _ if name in COMPARISONS:
                signs = self.of_masks if _type(of) == "mask" else COMPARISONS
                return f"MASK({first} {signs[name]} {others[0]})"
            case "max" | "min" if kind == "mask":
                return f"{first} {'|' if name == 'max' else '&'} {others[0]}"
            case "div":
                return f"{first} / {others[0]}" if node.dtype.kind == "f" else f"div_{kind}({first}, {others[0]})"
            case "abs" if node.dtype.kind in "iu":
                return first if node.dtype.kind == "u" else f"max_{kind}({first}, -{first})"
            case "shift_left" | "shift_right_logical" if not isinstance(node.arguments[1], Node) and kind[0] == "u":
                return f"{first} {'<<' if name == 'shift_left' else '>>'} {others[0]}"
            case "bitcast_convert_type" if "mask" not in (kind, _type(of)):
                return f"BITS({kind}, {first})"
            case "shift_left" | "shift_right_logical":
                raise NotWrittenError(name)
            case "integer_pow":
                return self._power(first, parameters["y"], node)
            case "pow":
                exponent = others[0] if node.arguments[1].dtype == node.dtype else f"AS({kind}, {others[0]})"
                return f"pow_{kind}({first}, {exponent})"
            case "round":
                even = parameters["rounding_method"] == lax.RoundingMethod.TO_NEAREST_EVEN
                return f"{'rint' if even else 'round'}_{kind}({first})"
            case "is_finite":
                return f"MASK(abs_{_type(of)}({first}) < INFINITY)"
            case "select_n":
                return self._selection(node.arguments[0], values, _select(node.dtype))
            case "convert_element_type":
                return _converted(first, np.dtype(of), node.dtype)
        if name not in ELEMENTWISE:
            raise NotWrittenError(name)
        return _FORMS[name].format(*values, kind=kind) if name in _FORMS else f"{name}_{kind}({', '.join(values)})"

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


def _head(counter: str, length: int, reverse: bool = False) -> str:
    at = counter.split()[-1]
    if reverse:
        return f"for ({counter} = {length - 1}; {at} >= 0; {at}--)"
    return f"for ({counter} = 0; {at} < {length}; {at}++)"


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
