"""Graphs of scalar operations with constant folding and common subexpression elimination."""

import gc
import itertools
import math
from collections.abc import Callable, Container, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

_NUMPY: Final[dict[str, Callable[..., Any]]] = {
    "abs": np.abs,
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "eq": np.equal,
    "ge": np.greater_equal,
    "gt": np.greater,
    "is_finite": np.isfinite,
    "le": np.less_equal,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.invert,
    "or": np.bitwise_or,
    "sqrt": np.sqrt,
    "square": np.square,
    "sub": np.subtract,
}
_OTHERS: Final = (
    *("acos", "asin", "atan", "atan2", "ceil", "clamp", "convert_element_type", "cos", "cosh", "div", "erf", "exp"),
    *("expm1", "floor", "integer_pow", "log", "log1p", "logistic", "pow", "rem", "round", "rsqrt", "select_n"),
    *("shift_left", "shift_right_logical", "sign", "sin", "sinh", "tan", "tanh", "xor"),
)
ELEMENTWISE: Final = frozenset((*_NUMPY, *_OTHERS))
_OF_SIGNED_ZEROS: Final = frozenset({"atan2", "div", "integer_pow", "pow", "rsqrt"})
"""Operations that take 0 and -0 to numbers far apart; a quotient only below the line."""
_KEEPS_SIGNED_ZEROS: Final = frozenset({"div", "max", "min", "mul", "neg", "select_n", "sqrt"})
"""Operations whose result may be -0 because an argument is."""
_PLAIN: Final = frozenset({"add", "add_any", "and", "div", "eq", "ge", "gt", "le", "lt", "mul", "ne", "or", "sub"})
"""Operations that only constants simplify."""
_COMMUTATIVE: Final = frozenset({"add", "add_any", "and", "eq", "max", "min", "mul", "ne", "or"})


class TooLargeError(Exception):
    """The graph has too many scalars to be worth compiling."""


class SideEffectsError(Exception):
    """The function does more than compute its result."""


@contextmanager
def collection_paused() -> Generator[None]:
    """Without Python's garbage collection, which takes a third of the time that large graphs do, and finds nothing."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class Node:
    """A scalar that depends on the inputs: an operation, with nodes and NumPy scalars as arguments.

    `operation` is a JAX primitive or "input", "carry" (of a loop), "whole" (an operation on whole arrays), "loop" (the
    parameter is a `LoopBody`; the arguments are what it starts from, and what is fixed in it), "output" (an entry of
    the result of one of the last two, its only argument), "entry" (of an input at a computed index; the parameter is
    how far its entries are apart, the first of them an argument), or "table" (entry of a constant vector, the
    parameter, at a computed index). Arguments have lower numbers.
    """

    __slots__ = ("arguments", "dtype", "number", "operation", "parameters")

    def __init__(self, number: int, operation: Any, arguments: tuple[Any, ...], parameters: Any, dtype: Any):
        self.number, self.operation, self.arguments = number, operation, arguments
        self.parameters, self.dtype = parameters, dtype


@dataclass(frozen=True, eq=False)
class LoopBody:
    """What a loop computes.

    Attributes:
        carried: nodes that stand for what is passed on, in a pass; they are the first of its nodes.
        after: what is passed on to the next one.
        again: whether there is a pass, as an entry; None if there are `length`.
        length: number of passes, of a loop without `again`.
    """

    carried: Sequence[Node]
    after: Sequence[Any]
    again: Any = None
    length: int | None = None

    @cached_property
    def inside(self) -> list[Node]:
        """What changes from pass to pass, arguments first, without what is passed on."""
        passed_on = {each.number for each in self.carried}
        needed = needed_for([*self.after, self.again], range(min(passed_on, default=0)))
        changing = depending_on(needed, self.carried)
        return [each for each in needed if each.number in changing and each.number not in passed_on]

    @cached_property
    def fixed(self) -> list[Node]:
        """What passes read that does not change."""
        changing = {each.number for each in (*self.carried, *self.inside)}
        read = itertools.chain(self.after, [self.again], *(each.arguments for each in self.inside))
        found = {each.number: each for each in read if isinstance(each, Node) and each.number not in changing}
        return [found[number] for number in sorted(found)]

    @cached_property
    def together(self) -> list[list[int]]:
        """For each value that is passed on, the places of those on which it comes to depend."""
        places: dict[int, set[int]] = {each.number: {place} for place, each in enumerate(self.carried)}
        for node in self.inside:
            of = [places[each.number] for each in node.arguments if isinstance(each, Node) and each.number in places]
            places[node.number] = of[0] if all(each is of[0] for each in of) else set().union(*of)
        found = [{place} | places.get(getattr(each, "number", 0), set()) for place, each in enumerate(self.after)]
        before: list[set[int]] = []
        while found != before:
            before, found = found, [set().union(*(found[place] for place in some)) for some in found]
        return [sorted(each) for each in found]


class ScalarGraph:
    """The operations of a function, without duplicates.

    Attributes:
        size: number of nodes.
        most: maximum number of nodes, beyond which new ones raise `TooLargeError`; None for any number.
        values_only: whether calls with a derivative of their own are written out, too, which loses it.
        arrays: inputs by the numbers of their entries, if computed indices may read them in memory.
        called: number of operations that come from native code.
        slopes: derivatives of outputs of loops, which are computed once.
    """

    def __init__(self, most: int | None, values_only: bool = False):
        self.most, self.values_only, self.size = most, values_only, 0
        self.arrays: dict[int, int] = {}
        self.called = 0
        self.slopes: dict[Any, Any] = {}
        self._known: dict[Any, Node] = {}
        self._sums: set[int] = set()
        self._from_zero: dict[int, Any] = {}
        self._never_minus_zero: set[int] = set()

    def node(self, operation: Any, arguments: tuple[Any, ...], parameters: Any, dtype: Any) -> Node:
        self.size += 1
        if self.most is not None and self.size > self.most:
            raise TooLargeError
        return Node(self.size, operation, arguments, parameters, dtype)

    def fresh(self, kind: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """Create an array of nodes without arguments."""
        return filled(shape, (self.node(kind, (), None, dtype) for _ in range(math.prod(shape))))

    def outputs(self, node: Node, avals: Sequence[Any]) -> list[np.ndarray]:
        """Return the output entries of an operation on whole arrays."""
        return [
            filled(aval.shape, [self.node("output", (node,), (place, at), aval.dtype) for at in np.ndindex(aval.shape)])
            for place, aval in enumerate(avals)
        ]

    def scalar(self, primitive: Any, arguments: tuple[Any, ...], dtype: Any, **parameters: Any) -> Any:
        """Return one entry of an elementwise operation: a constant, an existing node, or a new one."""
        name = primitive.name
        if name in _OF_SIGNED_ZEROS and dtype.kind == "f":
            first, *others = arguments
            first = first if name == "div" else self._signed(first)
            arguments = first, *map(self._signed, others)
        numbers = [each.number if isinstance(each, Node) else 0 for each in arguments]
        if not any(numbers):
            return _folded(primitive, arguments, dtype, parameters)
        if name not in _PLAIN or not all(numbers):
            if (simpler := self._simpler(name, arguments, dtype)) is not None:
                return simpler
        if name in _COMMUTATIVE and numbers[0] > numbers[1]:
            arguments, numbers = arguments[::-1], numbers[::-1]
        identities = numbers if all(numbers) else map(_identity, arguments)
        key = name, *identities, dtype, str(parameters) if parameters else ""
        node = self._known.get(key)
        if node is None:
            self._known[key] = node = self.node(primitive, arguments, parameters, dtype)
            if name in ("abs", "square") or (name == "mul" and arguments[0] is arguments[1]):
                self._never_minus_zero.add(node.number)
            elif name in ("add", "add_any") and not all(map(self._may_be_minus_zero, arguments)):
                self._never_minus_zero.add(node.number)
        return node

    def _may_be_minus_zero(self, value: Any) -> bool:
        """Whether a value may be -0; squares are not, nor sums with them."""
        if isinstance(value, Node):
            return value.number not in self._never_minus_zero
        return bool(value == 0 and np.signbit(value))

    def _simpler(self, name: str, arguments: tuple[Any, ...], dtype: Any) -> Any:
        """Simplify an operation with constant or equal arguments; None if impossible."""
        match name, arguments:
            case ("add" | "add_any", (a, b)) if _is(a, 0) or _is(b, 0):
                return b if _is(a, 0) else a
            case "sub", (a, b) if _is(b, 0):
                return a
            case "sub", (a, b) if _is(a, 0):
                return self.scalar(lax.neg_p, (b,), dtype)
            case "mul", (a, b) if _is(a, 0) or _is(b, 0):
                return dtype.type(0)
            case ("mul", (a, b)) if _is(a, 1) or _is(b, 1):
                return b if _is(a, 1) else a
            case ("mul", (a, b)) if _is(a, -1) or _is(b, -1):
                return self.scalar(lax.neg_p, (b if _is(a, -1) else a,), dtype)
            case "div", (a, b) if _is(b, 1) or _is(a, 0):
                return a
            case "neg", (a,) if a.operation is lax.neg_p:
                return a.arguments[0]
            case ("max" | "min", (a, b)) if a is b:
                return a
            case ("and" | "or", (a, b)) if dtype.kind == "b" and not (isinstance(a, Node) and isinstance(b, Node)):
                constant, other = (b, a) if isinstance(a, Node) else (a, b)
                return other if bool(constant) == (name == "and") else constant
            case "select_n", (which, *cases) if not isinstance(which, Node):
                return cases[int(which)]
            case "select_n", (_, first, *others) if all(_identity(each) == _identity(first) for each in others):
                return first
            case "convert_element_type", (a,) if a.dtype == dtype:
                return a
        return None

    def _signed(self, value: Any) -> Any:
        """Return a value, 0 instead of -0 where it is a sum, also in the products that it is made of.

        Sums begin with 0, and so are never -0. Graphs leave out that 0, which only makes a difference to `1 / x`.
        """
        known, stack = self._from_zero, [value] if isinstance(value, Node) else []
        while stack:
            node = stack[-1]
            if node.number in known:
                stack.pop()
            elif node.number in self._sums:
                differs = self.scalar(lax.ne_p, (node, node), np.dtype(bool))  # never, but no compiler knows
                added = self.scalar(lax.add_p, (node, self.converted(differs, node.dtype)), node.dtype)
                known[node.number] = known[added.number] = added
            elif getattr(node.operation, "name", None) not in _KEEPS_SIGNED_ZEROS:
                known[node.number] = node
            elif left := [each for each in node.arguments if isinstance(each, Node) and each.number not in known]:
                stack += left
            else:
                arguments = tuple(known[each.number] if isinstance(each, Node) else each for each in node.arguments)
                found = node
                if any(one is not other for one, other in zip(arguments, node.arguments, strict=True)):
                    found = self.scalar(node.operation, arguments, node.dtype, **node.parameters)
                known[node.number] = found
        return known[value.number] if isinstance(value, Node) else value

    def converted(self, value: Any, dtype: Any) -> Any:
        """Return an entry as another type."""
        parameters = {"new_dtype": dtype, "weak_type": False, "sharding": None}
        return self.scalar(lax.convert_element_type_p, (value,), dtype, **parameters)

    def elementwise(self, primitive: Any, inputs: Sequence[np.ndarray], aval: Any, **parameters: Any) -> np.ndarray:
        spread = [np.broadcast_to(each, aval.shape).flat for each in inputs]
        entries = zip(*spread, strict=True)
        return filled(aval.shape, [self.scalar(primitive, each, aval.dtype, **parameters) for each in entries])

    def entry(self, index: Any, cases: Sequence[Any]) -> Any:
        """Entry of an array in memory at a computed index within it, given all its possible values.

        None if they are not in memory, at equal distances.
        """
        numbers = [each.number if isinstance(each, Node) else 0 for each in cases]
        places = {self.arrays.get(number) for number in numbers}
        if None in places or len(places) > 1 or cases[0].dtype == bool:
            return None
        apart = {after - before for before, after in itertools.pairwise(numbers)}
        return self.node("entry", (index, cases[0]), apart.pop(), cases[0].dtype) if len(apart) == 1 else None

    def looked_up(self, table: np.ndarray, index: Node) -> Node:
        """Entry of a constant vector at a computed index within it."""
        key = "table", index.number, id(table)
        if key not in self._known:
            self._known[key] = self.node("table", (index,), table.reshape(-1), table.dtype)
        return self._known[key]

    def reduced(self, primitive: Any, rows: np.ndarray, aval: Any) -> np.ndarray:
        """Combine entries along the last axis; an empty axis gives zeros."""
        if not rows.shape[-1]:
            return constants(np.zeros(aval.shape, aval.dtype))
        result = rows[..., 0]
        for at in range(1, rows.shape[-1]):
            result = self.elementwise(primitive, [result, rows[..., at]], aval)
        if primitive is lax.add_p and rows.shape[-1] > 1 and aval.dtype.kind == "f":
            computed = (each for each in result.flat if isinstance(each, Node) and each.arguments)
            self._sums.update(each.number for each in computed if self._may_be_minus_zero(each))
        return result


def constants(value: Any) -> np.ndarray:
    array = np.asarray(value)
    return filled(array.shape, [array[index] for index in np.ndindex(array.shape)])


def filled(shape: tuple[int, ...], entries: Iterable[Any]) -> np.ndarray:
    array = np.empty(math.prod(shape), object)
    for place, each in enumerate(entries):
        array[place] = each
    return array.reshape(shape)


def entries_of(arrays: Iterable[np.ndarray]) -> list[Any]:
    return [each for array in arrays for each in array.flat]


def _identity(value: Any) -> Any:
    return value.number if isinstance(value, Node) else (value.dtype.char, value.tobytes())


def _is(value: Any, number: int) -> bool:
    return not isinstance(value, Node) and bool(value == number)


def _folded(primitive: Any, arguments: tuple[Any, ...], dtype: Any, parameters: dict[str, Any]) -> Any:
    """Evaluate an operation on constants."""
    match primitive.name:
        case "select_n":
            return arguments[1 + int(arguments[0])]
        case "convert_element_type" if arguments[0].dtype.kind != "f" or dtype.kind not in "iu":
            return arguments[0].astype(dtype)
        case name if name in _NUMPY:
            with np.errstate(all="ignore"):
                return dtype.type(_NUMPY[name](*arguments))
    with jax.ensure_compile_time_eval():
        return dtype.type(np.asarray(primitive.bind(*map(jnp.asarray, arguments), **parameters)))


def needed_for(outputs: Iterable[Any], known: Container[int] = ()) -> list[Node]:
    """Return the nodes that the outputs depend on, arguments first, without `known` ones and what only these need."""
    found: dict[int, Node] = {}
    stack = [each for each in outputs if isinstance(each, Node)]
    while stack:
        node = stack.pop()
        if node.number not in found and node.number not in known:
            found[node.number] = node
            stack += [each for each in node.arguments if isinstance(each, Node)]
    return [found[number] for number in sorted(found)]


def depending_on(nodes: Iterable[Node], some: Iterable[Node]) -> set[int]:
    """Numbers of some nodes, and of those among `nodes`, arguments first, that depend on them."""
    found = {each.number for each in some}
    for node in nodes:
        if any(isinstance(each, Node) and each.number in found for each in node.arguments):
            found.add(node.number)
    return found


def depth_first(outputs: Iterable[Any], known: Container[int] = ()) -> list[Node]:
    """The nodes of `needed_for` in another order: the arguments of each right before it, the deepest one first.

    Values are then used soon after they are computed, as far as that goes: of a quadruped's step, half as many have to
    leave a processor's registers as in the order of the trace.
    """
    nodes = needed_for(outputs, known)
    arguments = {
        node.number: [each for each in node.arguments if isinstance(each, Node) and each.number not in known]
        for node in nodes
    }
    depth: dict[int, int] = {}
    for node in nodes:
        depth[node.number] = 1 + max((depth[each.number] for each in arguments[node.number]), default=0)
        arguments[node.number].sort(key=lambda each: depth[each.number])
    found: dict[int, Node] = {}
    stack = [each for each in outputs if isinstance(each, Node) and each.number not in known][::-1]
    while stack:
        left = arguments[stack[-1].number]
        if left:
            each = left.pop()
            if each.number not in found:
                stack.append(each)
        else:
            node = stack.pop()
            found[node.number] = node
    return list(found.values())
