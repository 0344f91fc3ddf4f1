"""Evaluate functions of small arrays entry by entry.

MJX computes with arrays of a few entries (poses, inertias, Jacobians, constraint rows), many of which are always 0 or
1. Batched, each of its thousands of operations is a separate loop or kernel with strided access and tiny matrix
products, and constants are recomputed for every sample. `unrolled` evaluates a function's jaxpr entry by entry: it
folds constants, eliminates common subexpressions, and drops what no output needs. The remaining scalar operations
act on contiguous arrays over the batch under `vmap`, and fuse.
"""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.extend.core import Literal, jaxpr_as_fun

from mjx_study.graph.nodes import (
    ELEMENTWISE,
    Node,
    ScalarGraph,
    TooLargeError,
    constants,
    entries_of,
    filled,
    needed_for,
    no_type_check,
)
from mjx_study.graph.rules import RULES

MOST_SCALARS: Final = {"cpu": 12_000, "gpu": 6_000, "tpu": 6_000}
"""Maximum number of scalar operations, by backend; XLA's compile time grows faster than linearly in it."""

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
"""Functions for operations that rules add; they supply the primitive parameters of the installed JAX version."""
_WRITTEN_OUT: Final[dict[Any, Callable[..., Any] | None]] = {}
"""Graphs as functions, keyed by everything they depend on; None if too large. JAX batches and differentiates each of
them once for all programs that use it."""
MOST_KEPT: Final = 64
"""Maximum number of functions in `_WRITTEN_OUT`."""
_CALLS: Final = {"closed_call": "call_jaxpr", "jit": "jaxpr", "pjit": "jaxpr"}


def unrolled(function: Callable[..., Any], *arguments: Any) -> Any:
    """Evaluate `function(*arguments)` entry by entry, or as is if that takes more than `MOST_SCALARS` operations.

    Untraced arrays among the arguments are constants. The result equals the function's up to rounding, except that 0
    times infinity or NaN is 0 where the 0 is a constant. Forward and reverse mode differentiate it like the function
    itself.
    """
    leaves, structure = jax.tree.flatten(arguments)
    inputs = [leaf for leaf in leaves if isinstance(leaf, Tracer)]
    if not inputs:
        return function(*arguments)
    most = MOST_SCALARS[jax.default_backend()]
    key = _name(function), structure, tuple(map(_content, leaves)), most
    if key not in _WRITTEN_OUT:
        while len(_WRITTEN_OUT) >= MOST_KEPT:
            del _WRITTEN_OUT[next(iter(_WRITTEN_OUT))]
        _WRITTEN_OUT[key] = _written_out(function, arguments, leaves, most)
    program = _WRITTEN_OUT[key]
    return function(*arguments) if program is None else program(*inputs)


def _name(function: Callable[..., Any]) -> Any:
    """Key shared by partials of the same function and arguments."""
    if isinstance(function, partial):
        return function.func, function.args, tuple(sorted(function.keywords.items()))
    return function


@no_type_check
def _content(leaf: Any) -> Any:
    """Return what a graph depends on: the type of traced leaves, the value of others."""
    if isinstance(leaf, Tracer):
        return jax.typeof(leaf)
    array = np.asarray(leaf)
    return array.shape, array.dtype.str, array.tobytes()


def _written_out(
    function: Callable[..., Any], arguments: tuple[Any, ...], leaves: Sequence[Any], most: int
) -> Callable[..., Any] | None:
    """Build a function of the traced leaves of the arguments; None if it takes too many operations."""
    jaxpr, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    graph = ScalarGraph(2 * most)
    traced = [isinstance(leaf, Tracer) for leaf in leaves]
    inputs = [
        graph.fresh("input", leaf.shape, leaf.dtype) if free else constants(leaf)
        for leaf, free in zip(leaves, traced, strict=True)
    ]
    try:
        outputs = _run(graph, jaxpr.jaxpr, [constants(each) for each in jaxpr.consts], inputs)
    except TooLargeError:
        return None
    needed = needed_for(entries_of(outputs))
    if len(needed) > most:
        return None
    nodes = [nodes for nodes, free in zip(inputs, traced, strict=True) if free]

    def program(*free: jax.Array) -> list[jax.Array]:
        values: dict[int, Any] = {}
        for array, of in zip(free, nodes, strict=True):
            values |= {node.number: array[index] for index, node in np.ndenumerate(of)}
        _emit(needed, values)
        return [
            _array([values[each.number] if isinstance(each, Node) else each for each in output.flat], aval)
            for output, aval in zip(outputs, jaxpr.out_avals, strict=True)
        ]

    called = jax.jit(jaxpr_as_fun(jax.make_jaxpr(program)(*(leaf for leaf in leaves if isinstance(leaf, Tracer)))))
    return lambda *free: jax.tree.unflatten(jax.tree.structure(shape), called(*free))


def traced_part(tree: Any) -> tuple[list[Any], Callable[[list[Any]], Any]]:
    """Return the traced leaves of a pytree, with None for others, and a function that reassembles it.

    `jax.custom_jvp` traces its arguments; this keeps constants out of them, so that they fold.
    """
    leaves, structure = jax.tree.flatten(tree)

    def whole(traced: list[Any]) -> Any:
        return structure.unflatten([leaf if each is None else each for leaf, each in zip(leaves, traced, strict=True)])

    return [leaf if isinstance(leaf, Tracer) else None for leaf in leaves], whole


@no_type_check
def _run(
    graph: ScalarGraph, jaxpr: Any, closed: Sequence[np.ndarray], inputs: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Evaluate a jaxpr; array entries are nodes or NumPy scalars."""
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*closed, *inputs), strict=True))

    def read(atom: Any) -> np.ndarray:
        if isinstance(atom, Literal):
            kind: Any = atom.aval
            return constants(np.asarray(atom.val, kind.dtype))
        return values[atom]

    for equation in jaxpr.eqns:
        outputs = _equation(graph, equation, [read(atom) for atom in equation.invars])
        values |= zip(equation.outvars, outputs, strict=True)
    return [read(atom) for atom in jaxpr.outvars]


@no_type_check
def _equation(graph: ScalarGraph, equation: Any, inputs: list[np.ndarray]) -> Sequence[np.ndarray]:
    name, parameters = equation.primitive.name, equation.params
    avals: list[Any] = [each.aval for each in equation.invars]
    aval: Any = equation.outvars[0].aval
    if not any(math.prod(each.aval.shape) for each in equation.outvars):
        return [filled(each.aval.shape, ()) for each in equation.outvars]
    if name in _SAME:
        return inputs
    if name in ELEMENTWISE:
        return [graph.elementwise(equation.primitive, inputs, aval, **parameters)]
    if name in _CALLS:
        inner = parameters[_CALLS[name]]
        return _run(graph, inner.jaxpr, [constants(each) for each in inner.consts], inputs)
    if name in RULES and (outputs := RULES[name](graph, inputs, aval, parameters)) is not None:
        return outputs
    if name == "while":
        return _loop(graph, equation, inputs)
    if not any(isinstance(each, Node) for each in entries_of(inputs)):
        with jax.ensure_compile_time_eval():
            arrays = [_array(each.flat, of) for each, of in zip(inputs, avals, strict=True)]
            return [constants(each) for each in _whole(equation, arrays)]
    node = graph.node("whole", tuple(entries_of(inputs)), (equation, avals), None)
    return graph.outputs(node, [each.aval for each in equation.outvars])


def _loop(graph: ScalarGraph, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """While loop over scalars, with loop invariants computed beforehand."""
    parameters, avals = equation.params, [each.aval for each in equation.outvars]
    first, second = parameters["cond_nconsts"], parameters["cond_nconsts"] + parameters["body_nconsts"]
    during = [graph.fresh("carry", aval.shape, aval.dtype) for aval in avals]

    def inside(of: str, consts: list[np.ndarray]) -> list[Any]:
        inner = parameters[of]
        return entries_of(_run(graph, inner.jaxpr, [constants(each) for each in inner.consts], [*consts, *during]))

    again, after = inside("cond_jaxpr", inputs[:first]), inside("body_jaxpr", inputs[first:second])
    carried = entries_of(during)
    needed, changing = needed_for([*again, *after]), {each.number for each in carried}
    for each in needed:
        if any(isinstance(argument, Node) and argument.number in changing for argument in each.arguments):
            changing.add(each.number)
    fixed = [each for each in needed if each.number not in changing]
    start = entries_of(inputs[second:])
    node = graph.node("loop", (*start, *fixed), (carried, again, after), None)
    flat = [ShapedArray((), each.dtype) for each in carried]
    scalars = iter([each[()] for each in graph.outputs(node, flat)])
    return [filled(aval.shape, itertools.islice(scalars, math.prod(aval.shape))) for aval in avals]


def _whole(equation: Any, arrays: Sequence[jax.Array]) -> Sequence[jax.Array]:
    """Apply an operation to whole arrays, with its own differentiation rule if it has one."""
    parameters = equation.primitive.get_bind_params(equation.params)
    functions, parameters = parameters if isinstance(parameters, tuple) else ((), parameters)  # depends on JAX version
    found = equation.primitive.bind(*functions, *arrays, **parameters)
    return found if equation.primitive.multiple_results else [found]


@no_type_check
def _array(entries: Iterable[Any], aval: Any) -> jax.Array:
    scalars = [jnp.asarray(each, aval.dtype) for each in entries]
    return jnp.stack(scalars).reshape(aval.shape) if scalars else jnp.zeros(aval.shape, aval.dtype)


@no_type_check
def _emit(nodes: Iterable[Node], values: dict[int, Any]) -> None:
    """Compute nodes with JAX, arguments first, and add them to `values`."""
    for node in nodes:
        if node.number in values:
            continue
        arguments = [values[each.number] if isinstance(each, Node) else each for each in node.arguments]
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


def _emit_loop(node: Node, arguments: list[Any], values: dict[int, Any]) -> Any:
    carried, again, after = node.parameters
    fixed = {each.number: values[each.number] for each in node.arguments[len(carried) :]}

    def at(carry: Sequence[Any], outputs: Sequence[Any]) -> list[Any]:
        local = fixed | {each.number: value for each, value in zip(carried, carry, strict=True)}
        _emit(needed_for(outputs), local)
        return [local[each.number] if isinstance(each, Node) else jnp.asarray(each) for each in outputs]

    start = [jnp.asarray(each) for each in arguments[: len(carried)]]
    return lax.while_loop(lambda carry: at(carry, again)[0], lambda carry: at(carry, after), start)
