"""Capture functions of small arrays as graphs of scalars, from their jaxprs."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from mjx_study.graph.nodes import (
    ELEMENTWISE,
    LoopBody,
    Node,
    ScalarGraph,
    SideEffectsError,
    TooLargeError,
    collection_paused,
    constants,
    entries_of,
    filled,
    needed_for,
)
from mjx_study.graph.rules import RULES

MOST_KEPT: Final = 64
"""Maximum number of functions of a kind that are kept."""
MOST_FOLDED: Final = 10
"""Maximum number of entries that a function computes, in multiples of the scalar operations allowed; robots have 2 to 9
times as many entries as operations."""
MOST_WRITTEN_OUT: Final = 2_000
"""Maximum number of operations of all passes of a `scan` for which they are written out one after the other."""
MOST_INTERDEPENDENT: Final = 8
"""Maximum number of values that depend on each other in a loop in their place; its derivative takes their square."""
_SAME: Final = frozenset({"copy", "copy_p", "name", "optimization_barrier"})
_CALLS: Final = {"closed_call": "call_jaxpr", **dict.fromkeys(("checkpoint", "jit", "pjit", "remat2"), "jaxpr")}
_WITH_RULES: Final = {"custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr", "ruled": "jaxpr"}
"""Calls with a derivative of their own, which are operations on whole arrays unless only values are wanted."""


@dataclasses.dataclass(frozen=True, eq=False)
class ScalarFunction:
    """A function of arrays as a graph.

    Attributes:
        graph: the graph that its nodes belong to.
        inputs: one array of nodes per input.
        outputs: one array of nodes and NumPy scalars per output.
        avals: types of the outputs.
        structure: pytree of the outputs.
        values: the function captured for its values only, if that differs.
    """

    graph: ScalarGraph
    inputs: list[np.ndarray]
    outputs: list[np.ndarray]
    avals: Sequence[Any]
    structure: Any
    values: "ScalarFunction | None" = None

    @cached_property
    def needed(self) -> list[Node]:
        """Nodes that the outputs depend on, arguments first."""
        return needed_for(entries_of(self.outputs))

    @cached_property
    def size(self) -> int:
        """Number of operations, those of loops included."""
        found: set[int] = set()
        _count(self.needed, found)
        return len(found)

    @cached_property
    def used(self) -> list[int]:
        """Places of the inputs that the outputs depend on."""
        needed = {node.number for node in self.needed}
        return [place for place, each in enumerate(self.inputs) if any(node.number in needed for node in each.flat)]

    @property
    def types(self) -> list[ShapedArray]:
        """Types of the inputs."""
        return list(map(aval_of, self.inputs))

    def of(self, places: Sequence[int]) -> "ScalarFunction":
        """Return the function of some of its inputs, which does not depend on the others."""
        values = None if self.values is None else self.values.of(places)
        return dataclasses.replace(self, inputs=[self.inputs[place] for place in places], values=values)


def aval_of(array: np.ndarray) -> ShapedArray:
    """Type of an array of entries; that of an empty one is float."""
    return ShapedArray(array.shape, array.flat[0].dtype if array.size else np.dtype(float))


def _count(nodes: list[Node], found: set[int]) -> None:
    found |= {each.number for each in nodes}
    for each in nodes:
        if each.operation == "loop":
            _count(each.parameters.inside, found)


@dataclasses.dataclass(frozen=True)
class Passes:
    """A loop of known length whose body is a function of constants, carry and rows, and gives carry and rows."""

    num_consts: int
    num_carry: int
    length: int
    reverse: bool

    def avals(self, body: ScalarFunction) -> tuple[list[ShapedArray], list[ShapedArray]]:
        """Types of the loop's inputs and outputs, with the rows of all passes."""
        stacked = lambda aval: aval.update(shape=(self.length, *aval.shape))  # noqa: E731
        before, carried = self.num_consts + self.num_carry, self.num_carry
        inputs, outputs = body.types, list(body.avals)
        return (
            [*inputs[:before], *map(stacked, inputs[before:])],
            [*outputs[:carried], *map(stacked, outputs[carried:])],
        )


def is_input(leaf: Any) -> bool:
    """Whether a leaf of a captured function's arguments is one of its inputs; others are constants."""
    return isinstance(leaf, Tracer | jax.ShapeDtypeStruct)


@collection_paused()
def capture(function: Callable[..., Any], *arguments: Any, most: int, values_only: bool = False) -> ScalarFunction:
    """Write `function(*arguments)` out as a graph.

    Args:
        arguments: pytrees of arrays; traced ones and `jax.ShapeDtypeStruct`s become inputs, others constants.
        most: maximum number of scalar operations.
        values_only: whether to write out calls with a derivative of their own, too, which loses it.

    Raises:
        TooLargeError: it has more operations.
        SideEffectsError: it prints, for example, which a graph cannot.
    """
    jaxpr, shape = jax.make_jaxpr(function, return_shape=True)(*arguments)
    if jaxpr.effects:
        raise SideEffectsError
    if _entries(jaxpr.jaxpr) > MOST_FOLDED * most:
        raise TooLargeError
    graph, leaves = ScalarGraph(most, values_only), jax.tree.leaves(arguments)
    arrays = [graph.fresh("input", leaf.shape, leaf.dtype) if is_input(leaf) else constants(leaf) for leaf in leaves]
    outputs = run(graph, jaxpr, arrays)
    graph.most = None
    inputs = [array for array, leaf in zip(arrays, leaves, strict=True) if is_input(leaf)]
    return ScalarFunction(graph, inputs, outputs, jaxpr.out_avals, jax.tree.structure(shape))


def _entries(jaxpr: Jaxpr) -> int:
    """Number of scalars that a program computes, those of a loop's pass once."""
    total = 0
    for equation in jaxpr.eqns:
        outputs: list[Any] = [each.aval for each in equation.outvars]
        size = sum(math.prod(each.shape) for each in outputs)
        if equation.primitive.name == "dot_general":
            left: Any = equation.invars[0].aval
            (summed, _), _ = equation.params["dimension_numbers"]
            size *= math.prod(left.shape[axis] for axis in summed)
        total += sum(map(_entries, programs_in(equation))) or size
    return total


def programs_in(equation: Any) -> list[Jaxpr]:
    """Programs that an operation calls."""
    found = []
    for each in jax.tree.leaves(equation.params, is_leaf=lambda leaf: isinstance(leaf, ClosedJaxpr | Jaxpr)):
        found += [each.jaxpr] if isinstance(each, ClosedJaxpr) else [each] if isinstance(each, Jaxpr) else []
    return found


def inlined(graph: ScalarGraph, function: Callable[..., Any], *arrays: np.ndarray) -> list[np.ndarray]:
    """Add a function of floating-point arrays of nodes to a graph; its leaves."""
    return run(graph, jax.make_jaxpr(function)(*map(aval_of, arrays)), arrays)


def run(graph: ScalarGraph, closed: Any, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Evaluate a jaxpr, closed or without constants; array entries are nodes or NumPy scalars."""

    def boxed(equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
        outputs = _equation(graph, equation, inputs)
        return [each if isinstance(each, np.ndarray) else filled((), [each]) for each in outputs]  # NumPy unboxes

    return interpreted(boxed, closed, inputs, constants)


def interpreted(
    outputs_of: Callable[..., Any], closed: Any, inputs: Sequence[Any], constant: Callable[[Any], Any] = lambda it: it
) -> list[Any]:
    """Outputs of a program, from those of its operations."""
    jaxpr = getattr(closed, "jaxpr", closed)
    consts = map(constant, getattr(closed, "consts", ()))
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *inputs), strict=True))

    def read(atom: Any) -> Any:
        if isinstance(atom, Literal):
            kind: Any = atom.aval
            return constant(np.asarray(atom.val, kind.dtype))
        return values[atom]

    for equation in jaxpr.eqns:
        outputs = outputs_of(equation, [read(atom) for atom in equation.invars])
        values |= zip(equation.outvars, outputs, strict=True)
    return [read(atom) for atom in jaxpr.outvars]


def _equation(graph: ScalarGraph, equation: Any, inputs: list[np.ndarray]) -> Sequence[np.ndarray]:
    name, parameters = equation.primitive.name, equation.params
    avals: list[Any] = [each.aval for each in equation.invars]
    if not any(math.prod(each.aval.shape) for each in equation.outvars):
        return [filled(each.aval.shape, ()) for each in equation.outvars]
    aval: Any = equation.outvars[0].aval
    if name in _SAME or (graph.values_only and name == "stop_gradient"):
        return inputs
    if name in ELEMENTWISE:
        return [graph.elementwise(equation.primitive, inputs, aval, **parameters)]
    if name in _CALLS or (graph.values_only and name in _WITH_RULES):
        return run(graph, parameters[(_CALLS | _WITH_RULES)[name]], inputs)
    if name == "cond":
        return _branch(graph, equation, inputs)
    if name == "scan":
        return _scan(graph, equation, inputs)
    if name == "native" and parameters["function"].values is not None:
        return _native(graph, parameters["function"].values, inputs, parameters["batch"])
    if name in RULES and (outputs := RULES[name](graph, inputs, aval, parameters)) is not None:
        return outputs
    if name == "while":
        return _loop(graph, equation, inputs)
    keys = any(jnp.issubdtype(each.aval.dtype, jax.dtypes.extended) for each in equation.outvars)
    if not keys and not any(isinstance(each, Node) for each in entries_of(inputs)):
        with jax.ensure_compile_time_eval():
            arrays = [array_of(each.flat, of) for each, of in zip(inputs, avals, strict=True)]
            return [constants(each) for each in bind_whole(equation, arrays)]
    node = graph.node("whole", tuple(entries_of(inputs)), (equation, avals), None)
    return graph.outputs(node, [each.aval for each in equation.outvars])


def _branch(graph: ScalarGraph, equation: Any, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Compute all branches and select one, as under `vmap`."""
    index, *operands = inputs
    branches, avals = equation.params["branches"], [each.aval for each in equation.outvars]
    if not isinstance(index[()], Node):
        return run(graph, branches[min(max(int(index), 0), len(branches) - 1)], operands)
    first, *others = (run(graph, each, operands) for each in branches)
    kind = index[()].dtype
    for place, other in enumerate(others, 1):
        here = filled((), [graph.scalar(lax.ge_p, (index[()], kind.type(place)), np.dtype(bool))])
        pairs = zip(first, other, avals, strict=True)
        first = [graph.elementwise(lax.select_n_p, [here, old, new], aval) for old, new, aval in pairs]
    return first


def _scan(graph: ScalarGraph, equation: Any, inputs: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Write out all passes of a loop of known length, unless they are long and need nothing but what is carried."""
    parameters = equation.params
    consts, carry, rows = scan_inputs(equation, inputs)
    if len(carry) == len(equation.outvars) and not rows and parameters["length"] > 1:
        avals, before = [each.aval for each in equation.outvars], graph.size
        during = [graph.fresh("carry", aval.shape, aval.dtype) for aval in avals]
        after = run(graph, parameters["jaxpr"], [*consts, *during])
        body = LoopBody(entries_of(during), entries_of(after), length=parameters["length"])
        is_long = (graph.size - before) * parameters["length"] > MOST_WRITTEN_OUT
        if is_long and max(map(len, body.together), default=0) <= MOST_INTERDEPENDENT:
            return _loop_outputs(graph, entries_of(carry), body, avals)
    avals = [each.aval for each in equation.outvars[len(carry) :]]
    stacked = [np.empty(aval.shape, object) for aval in avals]
    passes = range(parameters["length"])
    for at in reversed(passes) if parameters["reverse"] else passes:
        outputs = run(graph, parameters["jaxpr"], [*consts, *carry, *(each[at, ...] for each in rows)])
        carry = outputs[: len(carry)]
        for every, one in zip(stacked, outputs[len(carry) :], strict=True):
            every[at, ...] = one
    return [*carry, *stacked]


def scan_inputs(equation: Any, inputs: Sequence[Any]) -> tuple[list[Any], list[Any], list[Any]]:
    """Constants, initial carry and rows among the inputs of a scan."""
    parameters = equation.params
    if "ft_in" in parameters:  # from JAX 0.11 on
        consts, carry, rows = parameters["ft_in"].update(inputs).unpack()
        return list(consts), list(carry), list(rows)
    first = parameters["num_consts"]
    second = first + parameters["num_carry"]
    return list(inputs[:first]), list(inputs[first:second]), list(inputs[second:])


def _native(
    graph: ScalarGraph, function: ScalarFunction, inputs: Sequence[np.ndarray], batch: tuple[int, ...]
) -> list[np.ndarray]:
    """Write out native code that is called, which is a graph already."""
    outputs = [np.empty((*batch, *aval.shape), object) for aval in function.avals]
    graph.called += function.size * math.prod(batch)
    for at in np.ndindex(*batch):
        values: dict[int, Any] = {}
        for array, nodes in zip(inputs, function.inputs, strict=True):
            entries = array[(*at, ...)] if array.ndim > nodes.ndim else array
            values |= zip((node.number for node in nodes.flat), entries.flat, strict=True)
        copy_nodes(graph, function.needed, values)
        for every, array in zip(outputs, function.outputs, strict=True):
            found = (values[each.number] if isinstance(each, Node) else each for each in array.flat)
            every[at] = filled(array.shape, found)[()]
    return outputs


def copy_nodes(graph: ScalarGraph, nodes: Iterable[Node], values: dict[int, Any]) -> None:
    """Add nodes of another graph, arguments first, where they are not in `values` yet."""

    def copies(entries: Iterable[Any], values: dict[int, Any]) -> list[Any]:
        return [values[each.number] if isinstance(each, Node) else each for each in entries]

    for node in nodes:
        if node.number in values:
            continue
        arguments, parameters = copies(node.arguments, values), node.parameters
        if node.operation == "loop":
            carried = [graph.node("carry", (), None, each.dtype) for each in parameters.carried]
            inside = values | {each.number: new for each, new in zip(parameters.carried, carried, strict=True)}
            copy_nodes(graph, parameters.inside, inside)
            after, (again,) = copies(parameters.after, inside), copies([parameters.again], inside)
            copied = loop_node(graph, arguments[: len(carried)], LoopBody(carried, after, again, parameters.length))
        elif isinstance(node.operation, str):
            copied = graph.node(node.operation, tuple(arguments), parameters, node.dtype)
        else:
            copied = graph.scalar(node.operation, tuple(arguments), node.dtype, **(parameters or {}))
        values[node.number] = copied


def _loop(graph: ScalarGraph, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
    """While loop over scalars, with loop invariants computed beforehand.

    That of a function under `vmap` has one predicate per member, whose shape begins that of every carried array: it
    runs until all members have ended, and a member that has ended keeps its values.
    """
    parameters, avals = equation.params, [each.aval for each in equation.outvars]
    first, second = parameters["cond_nconsts"], parameters["cond_nconsts"] + parameters["body_nconsts"]
    during = [graph.fresh("carry", aval.shape, aval.dtype) for aval in avals]
    (members,) = run(graph, parameters["cond_jaxpr"], [*inputs[:first], *during])
    after = run(graph, parameters["body_jaxpr"], [*inputs[first:second], *during])
    again = graph.reduced(lax.or_p, members.reshape(-1), ShapedArray((), np.dtype(bool)))
    if members.ndim:
        wide = [members.reshape(*members.shape, *[1] * (len(aval.shape) - members.ndim)) for aval in avals]
        cases = zip(wide, during, after, avals, strict=True)
        after = [graph.elementwise(lax.select_n_p, each, aval) for *each, aval in cases]
    return _loop_outputs(
        graph, entries_of(inputs[second:]), LoopBody(entries_of(during), entries_of(after), again[()]), avals
    )


def _loop_outputs(graph: ScalarGraph, start: Sequence[Any], body: LoopBody, avals: Sequence[Any]) -> list[np.ndarray]:
    node = loop_node(graph, start, body)
    flat = [ShapedArray((), each.dtype) for each in body.carried]
    scalars = iter([each[()] for each in graph.outputs(node, flat)])
    return [filled(aval.shape, itertools.islice(scalars, math.prod(aval.shape))) for aval in avals]


def loop_node(graph: ScalarGraph, start: Sequence[Any], body: LoopBody) -> Node:
    """A loop, from what it starts from."""
    return graph.node("loop", (*start, *body.fixed), body, None)


def bind_whole(equation: Any, arrays: Sequence[Any]) -> Sequence[jax.Array]:
    """Apply an operation to whole arrays, with its own differentiation rule if it has one."""
    parameters = equation.primitive.get_bind_params(equation.params)
    functions, parameters = parameters if isinstance(parameters, tuple) else ((), parameters)  # depends on JAX version
    found = equation.primitive.bind(*functions, *arrays, **parameters)
    return found if equation.primitive.multiple_results else [found]


def array_of(entries: Iterable[Any], aval: Any) -> jax.Array:
    scalars = [jnp.asarray(each, aval.dtype) for each in entries]
    return jnp.stack(scalars).reshape(aval.shape) if scalars else jnp.zeros(aval.shape, aval.dtype)
