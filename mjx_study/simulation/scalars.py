"""Functions of small arrays, written out entry by entry.

MJX computes with arrays of a few entries (poses, inertias, Jacobians, constraint rows), many of them 0 or 1 whatever
the state. Batched, each of its thousands of operations is a loop or a kernel of its own, with strided access and
products of tiny matrices, and constants are computed for every sample. `unrolled` evaluates a function's jaxpr entry by
entry: it folds constants, computes common subexpressions once, and drops what no output needs. What is left are
operations between scalars, which under `vmap` are contiguous arrays over the batch, and fuse.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.extend.core import Literal

MOST_SCALARS: Final = {"cpu": 12_000, "gpu": 6_000, "tpu": 6_000}
"""Largest number of scalar operations, by backend; XLA's time to compile them grows faster than their number."""

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
    *("expm1", "floor", "integer_pow", "log", "log1p", "logistic", "pow", "rem", "round", "rsqrt", "select_n", "sign"),
    *("sin", "sinh", "tan", "tanh", "xor"),
)
_ELEMENTWISE: Final = frozenset((*_NUMPY, *_OTHERS))
_COMMUTATIVE: Final = frozenset({"add", "add_any", "and", "eq", "max", "min", "mul", "ne", "or"})
_SAME: Final = frozenset({"copy", "copy_p", "name", "optimization_barrier"})
_FUNCTIONS: Final = {
    lax.add_p: lax.add,
    lax.and_p: lax.bitwise_and,
    lax.eq_p: lax.eq,
    lax.gt_p: lax.gt,
    lax.lt_p: lax.lt,
    lax.max_p: lax.max,
    lax.min_p: lax.min,
    lax.mul_p: lax.mul,
    lax.neg_p: lax.neg,
    lax.or_p: lax.bitwise_or,
    lax.select_n_p: lax.select_n,
}
"""Operations that rules add; these functions give primitives the parameters that they have in this version of JAX."""
_CALLS: Final = {"closed_call": "call_jaxpr", "jit": "jaxpr", "pjit": "jaxpr"}


class _TooLargeError(Exception):
    """More scalars than are worth their compilation."""


class _Node:
    """A scalar that depends on the inputs: an operation, with nodes and NumPy scalars as its arguments.

    `operation` is a JAX primitive or "input", "carry" (of a loop), "whole" (an operation on whole arrays), "loop", or
    "output" (an entry of what one of the last two returns, its only argument). Arguments have lower numbers.
    """

    __slots__ = ("arguments", "dtype", "number", "operation", "parameters")

    def __init__(self, number: int, operation: Any, arguments: tuple[Any, ...], parameters: Any, dtype: Any):
        self.number, self.operation, self.arguments = number, operation, arguments
        self.parameters, self.dtype = parameters, dtype


def unrolled(function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, computed entry by entry, or as it is if that takes more than `MOST_SCALARS` operations.

    Arrays among the arguments that are not traced are constants. The result is the function's up to rounding, except
    that 0 times infinity or NaN is 0 where the 0 is a constant. Forward and reverse mode differentiate it like the
    function itself.

    Args:
        function: any function that JAX can trace.
        *arguments: pytrees of arrays.

    Returns:
        The function's value.
    """
    leaves = jax.tree.leaves(arguments)
    if not any(isinstance(leaf, Tracer) for leaf in leaves):
        return function(*arguments)
    jaxpr, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    most = MOST_SCALARS[jax.default_backend()]
    avals: Any = jaxpr.out_avals
    graph, values, inputs = _Graph(2 * most), {}, []
    for leaf in leaves:
        if not isinstance(leaf, Tracer):
            inputs.append(_constants(leaf))
            continue
        inputs.append(graph.fresh("input", leaf.shape, leaf.dtype))
        values |= {node.number: leaf[index] for index, node in np.ndenumerate(inputs[-1])}
    try:
        outputs = graph.run(jaxpr.jaxpr, [_constants(each) for each in jaxpr.consts], inputs)
    except _TooLargeError:
        return function(*arguments)
    needed = _needed(_entries(outputs))
    if len(needed) > most:
        return function(*arguments)
    _emit(needed, values)
    arrays = [
        _array([values[each.number] if isinstance(each, _Node) else each for each in output.flat], aval)
        for output, aval in zip(outputs, avals, strict=True)
    ]
    return jax.tree.unflatten(jax.tree.structure(shape), arrays)


def traced_part(tree: Any) -> tuple[list[Any], Callable[[list[Any]], Any]]:
    """The leaves of a pytree that are traced, None for the others, and a function that puts them back.

    What goes through `jax.custom_jvp` is traced inside of it; this keeps constants out of it, so that they fold.
    """
    leaves, structure = jax.tree.flatten(tree)

    def whole(traced: list[Any]) -> Any:
        return structure.unflatten([leaf if each is None else each for leaf, each in zip(leaves, traced, strict=True)])

    return [leaf if isinstance(leaf, Tracer) else None for leaf in leaves], whole


class _Graph:
    """The operations of a function, each once."""

    def __init__(self, most: int):
        self._count, self._most = 0, most
        self._known: dict[Any, _Node] = {}

    def node(self, operation: Any, arguments: tuple[Any, ...], parameters: Any, dtype: Any) -> _Node:
        self._count += 1
        if self._count > self._most:
            raise _TooLargeError
        return _Node(self._count, operation, arguments, parameters, dtype)

    def fresh(self, kind: str, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """An array of nodes without arguments."""
        return _filled(shape, (self.node(kind, (), None, dtype) for _ in range(math.prod(shape))))

    def outputs(self, node: _Node, avals: Sequence[Any]) -> list[np.ndarray]:
        """The entries of what an operation on whole arrays returns."""
        return [
            _filled(
                aval.shape, [self.node("output", (node,), (place, at), aval.dtype) for at in np.ndindex(aval.shape)]
            )
            for place, aval in enumerate(avals)
        ]

    def scalar(self, primitive: Any, arguments: tuple[Any, ...], dtype: Any, **parameters: Any) -> Any:
        """One entry of an elementwise operation: a constant, a node that is there, or a new one."""
        name = primitive.name
        if not any(isinstance(each, _Node) for each in arguments):
            return _folded(primitive, arguments, dtype, parameters)
        if (simpler := self._simpler(name, arguments, dtype)) is not None:
            return simpler
        if name in _COMMUTATIVE:
            arguments = tuple(sorted(arguments, key=lambda each: each.number if isinstance(each, _Node) else 0))
        key = name, tuple(map(_identity, arguments)), dtype, str(parameters) if parameters else ""
        if key not in self._known:
            self._known[key] = self.node(primitive, arguments, parameters, dtype)
        return self._known[key]

    def _simpler(self, name: str, arguments: tuple[Any, ...], dtype: Any) -> Any:
        """A simpler form of an operation with some constant or equal arguments; None if there is none."""
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
            case ("and" | "or", (a, b)) if dtype.kind == "b" and not (isinstance(a, _Node) and isinstance(b, _Node)):
                constant, other = (b, a) if isinstance(a, _Node) else (a, b)
                return other if bool(constant) == (name == "and") else constant
            case "select_n", (which, *cases) if not isinstance(which, _Node):
                return cases[int(which)]
            case "select_n", (_, first, *others) if all(_identity(each) == _identity(first) for each in others):
                return first
            case "convert_element_type", (a,) if a.dtype == dtype:
                return a
        return None

    def elementwise(self, primitive: Any, inputs: Sequence[np.ndarray], aval: Any, **parameters: Any) -> np.ndarray:
        spread = [np.broadcast_to(each, aval.shape).flat for each in inputs]
        entries = zip(*spread, strict=True)
        return _filled(aval.shape, [self.scalar(primitive, each, aval.dtype, **parameters) for each in entries])

    def reduced(self, primitive: Any, rows: np.ndarray, aval: Any) -> np.ndarray:
        """Combine entries along the last axis; zeros of an empty one."""
        if not rows.shape[-1]:
            return _constants(np.zeros(aval.shape, aval.dtype))
        result = rows[..., 0]
        for at in range(1, rows.shape[-1]):
            result = self.elementwise(primitive, [result, rows[..., at]], aval)
        return result

    def run(self, jaxpr: Any, constants: Sequence[np.ndarray], inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The outputs of a jaxpr; arrays have entries that are nodes or NumPy scalars."""
        values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *inputs), strict=True))

        def read(atom: Any) -> np.ndarray:
            if isinstance(atom, Literal):
                kind: Any = atom.aval
                return _constants(np.asarray(atom.val, kind.dtype))
            return values[atom]

        for equation in jaxpr.eqns:
            outputs = self.equation(equation, [read(atom) for atom in equation.invars])
            values |= zip(equation.outvars, outputs, strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, inputs: list[np.ndarray]) -> Sequence[np.ndarray]:
        name, parameters = equation.primitive.name, equation.params
        avals: list[Any] = [each.aval for each in equation.invars]
        aval: Any = equation.outvars[0].aval
        if not any(math.prod(each.aval.shape) for each in equation.outvars):
            return [_filled(each.aval.shape, ()) for each in equation.outvars]
        if name in _SAME:
            return inputs
        if name in _ELEMENTWISE:
            return [self.elementwise(equation.primitive, inputs, aval, **parameters)]
        if name in _CALLS:
            inner = parameters[_CALLS[name]]
            return self.run(inner.jaxpr, [_constants(each) for each in inner.consts], inputs)
        if name in _RULES and (outputs := _RULES[name](self, inputs, aval, parameters)) is not None:
            return outputs
        if name == "while":
            return self._loop(equation, inputs)
        if not any(isinstance(each, _Node) for each in _entries(inputs)):
            with jax.ensure_compile_time_eval():
                arrays = [_array(each.flat, of) for each, of in zip(inputs, avals, strict=True)]
                return [_constants(each) for each in _whole(equation, arrays)]
        node = self.node("whole", tuple(_entries(inputs)), (equation, avals), None)
        return self.outputs(node, [each.aval for each in equation.outvars])

    def _loop(self, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
        """A while loop over scalars; what does not change in it is computed before it."""
        parameters, avals = equation.params, [each.aval for each in equation.outvars]
        first, second = parameters["cond_nconsts"], parameters["cond_nconsts"] + parameters["body_nconsts"]
        during = [self.fresh("carry", aval.shape, aval.dtype) for aval in avals]

        def inside(of: str, consts: list[np.ndarray]) -> list[Any]:
            inner = parameters[of]
            return _entries(self.run(inner.jaxpr, [_constants(each) for each in inner.consts], [*consts, *during]))

        again, after = inside("cond_jaxpr", inputs[:first]), inside("body_jaxpr", inputs[first:second])
        carried = _entries(during)
        needed, changing = _needed([*again, *after]), {each.number for each in carried}
        for each in needed:
            if any(isinstance(argument, _Node) and argument.number in changing for argument in each.arguments):
                changing.add(each.number)
        fixed = [each for each in needed if each.number not in changing]
        start = _entries(inputs[second:])
        node = self.node("loop", (*start, *fixed), (carried, again, after), None)
        flat = [ShapedArray((), each.dtype) for each in carried]
        scalars = iter([each[()] for each in self.outputs(node, flat)])
        return [_filled(aval.shape, itertools.islice(scalars, math.prod(aval.shape))) for aval in avals]


def _constants(value: Any) -> np.ndarray:
    """An array of NumPy scalars."""
    array = np.asarray(value)
    return _filled(array.shape, [array[index] for index in np.ndindex(array.shape)])


def _filled(shape: tuple[int, ...], entries: Iterable[Any]) -> np.ndarray:
    array = np.empty(math.prod(shape), object)
    for place, each in enumerate(entries):
        array[place] = each
    return array.reshape(shape)


def _entries(arrays: Iterable[np.ndarray]) -> list[Any]:
    return [each for array in arrays for each in array.flat]


def _identity(value: Any) -> Any:
    return value.number if isinstance(value, _Node) else (value.dtype.char, value.tobytes())


def _is(value: Any, number: int) -> bool:
    return not isinstance(value, _Node) and bool(value == number)


def _folded(primitive: Any, arguments: tuple[Any, ...], dtype: Any, parameters: dict[str, Any]) -> Any:
    """An operation between constants."""
    match primitive.name:
        case "select_n":
            return arguments[1 + int(arguments[0])]
        case "convert_element_type":
            return arguments[0].astype(dtype)
        case name if name in _NUMPY:
            with np.errstate(all="ignore"):
                return dtype.type(_NUMPY[name](*arguments))
    with jax.ensure_compile_time_eval():
        return dtype.type(np.asarray(primitive.bind(*map(jnp.asarray, arguments), **parameters)))


def _whole(equation: Any, arrays: Sequence[jax.Array]) -> Sequence[jax.Array]:
    """The outputs of an operation on whole arrays, with its own rule of differentiation where it has one."""
    parameters = equation.primitive.get_bind_params(equation.params)
    functions, parameters = parameters if isinstance(parameters, tuple) else ((), parameters)  # by JAX's version
    found = equation.primitive.bind(*functions, *arrays, **parameters)
    return found if equation.primitive.multiple_results else [found]


def _needed(outputs: Iterable[Any]) -> list[_Node]:
    """The nodes that outputs depend on, arguments first."""
    found: dict[int, _Node] = {}
    stack = [each for each in outputs if isinstance(each, _Node)]
    while stack:
        node = stack.pop()
        if node.number not in found:
            found[node.number] = node
            stack += [each for each in node.arguments if isinstance(each, _Node)]
    return [found[number] for number in sorted(found)]


def _array(entries: Iterable[Any], aval: Any) -> jax.Array:
    scalars = [jnp.asarray(each, aval.dtype) for each in entries]
    return jnp.stack(scalars).reshape(aval.shape) if scalars else jnp.zeros(aval.shape, aval.dtype)


def _emit(nodes: Iterable[_Node], values: dict[int, Any]) -> None:
    """Compute nodes with JAX, arguments first; `values` has some of them, and in the end all."""
    for node in nodes:
        if node.number in values:
            continue
        arguments = [values[each.number] if isinstance(each, _Node) else each for each in node.arguments]
        match node.operation:
            case "output":
                place, index = node.parameters
                found = arguments[0][place][index]
            case "whole":
                equation, avals = node.parameters
                left = iter(arguments)
                arrays = [_array(itertools.islice(left, math.prod(aval.shape)), aval) for aval in avals]
                found = _whole(equation, arrays)
            case "loop":
                found = _emit_loop(node, arguments, values)
            case primitive if node.parameters:
                found = primitive.bind(*arguments, **node.parameters)
            case primitive:
                found = _FUNCTIONS.get(primitive, primitive.bind)(*arguments)
        values[node.number] = found


def _emit_loop(node: _Node, arguments: list[Any], values: dict[int, Any]) -> Any:
    carried, again, after = node.parameters
    fixed = {each.number: values[each.number] for each in node.arguments[len(carried) :]}

    def at(carry: Sequence[Any], outputs: Sequence[Any]) -> list[Any]:
        local = fixed | {each.number: value for each, value in zip(carried, carry, strict=True)}
        _emit(_needed(outputs), local)
        return [local[each.number] if isinstance(each, _Node) else jnp.asarray(each) for each in outputs]

    start = [jnp.asarray(each) for each in arguments[: len(carried)]]
    return lax.while_loop(lambda carry: at(carry, again)[0], lambda carry: at(carry, after), start)


# Rules for primitives that move, sum or choose entries: (graph, inputs, aval of the output, parameters) -> outputs, or
# None where the operation is left as it is.

Rule = Callable[[_Graph, list[np.ndarray], Any, dict[str, Any]], list[np.ndarray] | None]


def _broadcast(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray]:
    shape = [1] * len(aval.shape)
    for place, size in zip(parameters["broadcast_dimensions"], inputs[0].shape, strict=True):
        shape[place] = size
    return [np.broadcast_to(inputs[0].reshape(shape), aval.shape)]


def _slice(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray]:
    bounds = parameters["start_indices"], parameters["limit_indices"], parameters["strides"] or (1,) * len(aval.shape)
    return [inputs[0][tuple(itertools.starmap(slice, zip(*bounds, strict=True)))]]


def _iota(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray]:
    return [_constants(np.indices(aval.shape)[parameters["dimension"]].astype(aval.dtype))]


def _pad(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray] | None:
    array, filler = inputs
    if any(low < 0 or high < 0 or between for low, high, between in parameters["padding_config"]):
        return None
    padded = np.full(aval.shape, filler[()], object)
    lows = [low for low, _, _ in parameters["padding_config"]]
    padded[tuple(slice(low, low + size) for low, size in zip(lows, array.shape, strict=True))] = array
    return [padded]


def _window(inputs: list[np.ndarray], shape: tuple[int, ...], sizes: Sequence[Any]) -> tuple[slice, ...] | None:
    """Where a dynamic slice lies, if that is known."""
    starts = [each[()] for each in inputs]
    if any(isinstance(each, _Node) for each in starts):
        return None
    first = [min(max(int(at), 0), whole - size) for at, whole, size in zip(starts, shape, sizes, strict=True)]
    return tuple(slice(at, at + size) for at, size in zip(first, sizes, strict=True))


def _dynamic_slice(
    graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]
) -> list[np.ndarray] | None:
    window = _window(inputs[1:], inputs[0].shape, parameters["slice_sizes"])
    return None if window is None else [inputs[0][window]]


def _dynamic_update_slice(
    graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]
) -> list[np.ndarray] | None:
    array, update, *starts = inputs
    if (window := _window(starts, array.shape, update.shape)) is None:
        return None
    array = array.copy()
    array[window] = update
    return [array]


def _places(
    shape: tuple[int, ...],
    indices: np.ndarray,
    sizes: Sequence[Any],
    window_dims: Sequence[Any],
    dropped: Sequence[Any],
    index_dims: Sequence[Any],
    batch_dims: tuple[Sequence[Any], Sequence[Any]],
    clip: bool,
) -> np.ndarray:
    """Flat places in an array of some shape that a gather reads or a scatter writes, -1 outside of the array.

    The arguments are those of `jax.lax.GatherDimensionNumbers`: offset_dims, collapsed_slice_dims, start_index_map and
    the two operand and indices batching dims.
    """
    batch, numbers = indices.shape[:-1], np.arange(math.prod(shape)).reshape(shape)
    kept = [size for dim, size in enumerate(sizes) if dim not in dropped and dim not in batch_dims[0]]
    found = np.empty((*batch, *kept), np.int64)
    for at in np.ndindex(*batch):
        start = np.zeros(len(shape), int)
        start[list(index_dims)] = indices[at].astype(int)
        start[list(batch_dims[0])] = [at[dim] for dim in batch_dims[1]]
        last = np.array(shape) - sizes
        start = np.clip(start, 0, last) if clip else start
        inside = np.all((start >= 0) & (start <= last))
        window = tuple(slice(low, low + size) for low, size in zip(start, sizes, strict=True))
        found[at] = numbers[window].reshape(kept) if inside else -1
    return np.moveaxis(found, range(len(batch), found.ndim), window_dims)


def _gather(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray] | None:
    """By constant indices, or by a single one that is not known: a choice between its values."""
    array, indices = inputs
    numbers, sizes = parameters["dimension_numbers"], parameters["slice_sizes"]
    unknown = {each.number: each for each in indices.flat if isinstance(each, _Node)}
    fill = parameters["fill_value"]
    if fill is None:
        fill = (
            np.nan if np.issubdtype(aval.dtype, np.inexact) else np.iinfo(aval.dtype).min if aval.dtype != bool else 1
        )
    pool = np.append(array.reshape(-1), _constants(np.asarray(fill, aval.dtype)))

    def picked(value: int) -> np.ndarray:
        known = _filled(indices.shape, (value if isinstance(each, _Node) else each for each in indices.flat))
        return pool[
            _places(
                array.shape,
                known,
                sizes,
                numbers.offset_dims,
                numbers.collapsed_slice_dims,
                numbers.start_index_map,
                (numbers.operand_batching_dims, numbers.start_indices_batching_dims),
                parameters["mode"] == lax.GatherScatterMode.CLIP,
            )
        ]

    if not unknown:
        return [picked(0)]
    if len(unknown) > 1:
        return None
    (index,) = unknown.values()
    result = picked(-1)  # as outside of the array, or clipped
    for value in range(max(array.shape, default=0)):
        here = graph.scalar(lax.eq_p, (index, index.dtype.type(value)), np.dtype(bool))
        result = graph.elementwise(lax.select_n_p, [_filled((), [here]), result, picked(value)], aval)
    return [result]


def _scatter(combine: Any) -> Rule:
    def rule(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray] | None:
        array, indices, updates = inputs
        if any(isinstance(each, _Node) for each in indices.flat):
            return None
        numbers = parameters["dimension_numbers"]
        inserted, batching = numbers.inserted_window_dims, numbers.operand_batching_dims
        windows = iter(updates.shape[dim] for dim in numbers.update_window_dims)
        sizes = [1 if dim in inserted or dim in batching else next(windows) for dim in range(array.ndim)]
        places = _places(
            array.shape,
            indices,
            sizes,
            numbers.update_window_dims,
            inserted,
            numbers.scatter_dims_to_operand_dims,
            (batching, numbers.scatter_indices_batching_dims),
            parameters["mode"] == lax.GatherScatterMode.CLIP,
        )
        result = array.reshape(-1).copy()
        for place, update in zip(places.flat, updates.flat, strict=True):
            if place >= 0:
                both = (result[place], update)
                result[place] = update if combine is None else graph.scalar(combine, both, aval.dtype)
        return [result.reshape(array.shape)]

    return rule


def _reduction(combine: Any) -> Rule:
    def rule(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray] | None:
        (array,), axes = inputs, parameters["axes"]
        if not array.size and combine is not lax.add_p:
            return None
        sizes = [array.shape[axis] for axis in axes]
        rows = np.moveaxis(array, axes, range(-len(axes), 0)).reshape(*aval.shape, math.prod(sizes))
        return [graph.reduced(combine, rows, aval)]

    return rule


def _place_of_extreme(better: Any) -> Rule:
    def rule(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray]:
        rows = np.moveaxis(inputs[0], parameters["axes"][0], -1)
        kind = rows.flat[0].dtype
        best, place = rows[..., 0], _constants(np.zeros(aval.shape, aval.dtype))
        for at in range(1, rows.shape[-1]):
            here = graph.elementwise(better, [rows[..., at], best], aval.update(dtype=np.dtype(bool)))
            best = graph.elementwise(lax.select_n_p, [here, best, rows[..., at]], aval.update(dtype=kind))
            this = _constants(np.full(aval.shape, at, aval.dtype))
            place = graph.elementwise(lax.select_n_p, [here, place, this], aval)
        return [place]

    return rule


def _cumsum(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray]:
    result = inputs[0].copy()
    rows = np.moveaxis(np.flip(result, parameters["axis"]) if parameters["reverse"] else result, parameters["axis"], 0)
    for before, row in itertools.pairwise(rows.reshape(len(rows), -1)):
        row[:] = [graph.scalar(lax.add_p, each, aval.dtype) for each in zip(before, row, strict=True)]
    return [result]


def _dot(graph: _Graph, inputs: list[np.ndarray], aval: Any, parameters: dict[str, Any]) -> list[np.ndarray]:
    (over, batch), factors = parameters["dimension_numbers"], []
    for array, summed, shared in zip(inputs, over, batch, strict=True):
        free = [axis for axis in range(array.ndim) if axis not in (*summed, *shared)]
        sizes = [math.prod(array.shape[axis] for axis in axes) for axes in (shared, free, summed)]
        kind = {"new_dtype": aval.dtype, "weak_type": False, "sharding": None}
        moved = array.transpose([*shared, *free, *summed]).reshape(sizes)
        entries = [
            each if each.dtype == aval.dtype else graph.scalar(lax.convert_element_type_p, (each,), aval.dtype, **kind)
            for each in moved.flat
        ]
        factors.append(_filled(tuple(sizes), entries))
    left, right = factors[0][:, :, None], factors[1][:, None]
    terms = ShapedArray(np.broadcast_shapes(left.shape, right.shape), aval.dtype)
    products = graph.elementwise(lax.mul_p, [left, right], terms)
    total = graph.reduced(lax.add_p, products, aval.update(shape=products.shape[:-1]))
    return [total.reshape(aval.shape)]


_RULES: Final[dict[str, Rule]] = {
    **dict.fromkeys(("squeeze", "reshape", "expand_dims"), lambda _, inputs, aval, __: [inputs[0].reshape(aval.shape)]),
    "argmax": _place_of_extreme(lax.gt_p),
    "argmin": _place_of_extreme(lax.lt_p),
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda _, inputs, __, parameters: [np.concatenate(inputs, parameters["dimension"])],
    "cumsum": _cumsum,
    "dot_general": _dot,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "iota": _iota,
    "pad": _pad,
    "reduce_and": _reduction(lax.and_p),
    "reduce_max": _reduction(lax.max_p),
    "reduce_min": _reduction(lax.min_p),
    "reduce_or": _reduction(lax.or_p),
    "reduce_sum": _reduction(lax.add_p),
    "rev": lambda _, inputs, __, parameters: [np.flip(inputs[0], parameters["dimensions"])],
    "scatter": _scatter(None),
    "scatter-add": _scatter(lax.add_p),
    "slice": _slice,
    "stack": lambda _, inputs, __, parameters: [np.stack(inputs, parameters["axis"])],
    "tile": lambda _, inputs, __, parameters: [np.tile(inputs[0], parameters["reps"])],
    "transpose": lambda _, inputs, __, parameters: [inputs[0].transpose(parameters["permutation"])],
}
