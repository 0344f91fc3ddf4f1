"""Derivatives of graphs, in forward and reverse mode.

Nodes and their derivatives share one graph, so that what both compute is computed once. Derivatives are sparse: an
entry that is always zero is no node. Each operation has JAX's derivative, at kinks, too (1/2 at the tie of a maximum,
0 where a value is clamped), with a few rules written out below that cost fewer operations.

Of a selection, only the case that it takes contributes, in reverse mode, too: JAX's reverse mode multiplies the others'
derivatives by zero, which gives NaN where one is infinite. Here the adjoint of a case counts only where the case is
taken, which is enforced where adjoints of different cases add up.

The derivatives of what a loop of known length passes on are passed on beside it, over what it starts from and what its
passes read. Loops that run until a condition holds and operations on whole arrays have none (`NotDifferentiableError`);
the derivative of a solver's loop is that of the equation that it solves, see `linear_map.implicit_derivative`.
"""

import itertools
from collections.abc import Collection, Mapping, Sequence
from functools import cache
from typing import Any, Final

import jax
import numpy as np
from jax import lax

from mjx_study.graph.function import copy_nodes, loop_node, run
from mjx_study.graph.nodes import LoopBody, Node, ScalarGraph, collection_paused, entries_of, filled, needed_for

Sparse = dict[int, Any]
"""Entries by column; others are zero."""
Conditions = tuple[tuple[Any, bool], ...]
"""Truth values and which of both they are."""
_BOOL: Final = np.dtype(bool)


class NotDifferentiableError(Exception):
    """The derivative would have to pass a loop or an operation on whole arrays."""


@collection_paused()
def push(
    graph: ScalarGraph, outputs: Sequence[np.ndarray], inputs: Sequence[np.ndarray], changes: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Changes of the outputs with those of the inputs, by forward mode; all are arrays of entries.

    Raises:
        NotDifferentiableError: it passes a loop or an operation on whole arrays.
    """
    seeds = {at.number: {0: change} for at, change in zip(entries_of(inputs), entries_of(changes), strict=True)}
    return _arrays(outputs, _pushed(graph, entries_of(outputs), seeds))


@collection_paused()
def pull(
    graph: ScalarGraph, outputs: Sequence[np.ndarray], inputs: Sequence[np.ndarray], adjoints: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Adjoints of the inputs from those of the outputs, by reverse mode; all are arrays of entries.

    Raises:
        NotDifferentiableError: it passes a loop or an operation on whole arrays.
    """
    ends = {each.number for each in entries_of(inputs)}
    needed = needed_for(entries_of(outputs), ends)
    moving = set(ends)
    for node in needed:
        if _passes(node) and any(_in(moving, each) for each in node.arguments):
            moving.add(node.number)
    known: dict[int, dict[Conditions, Any]] = {}

    def add(node: Any, adjoint: Any, where: Conditions) -> None:
        if _in(moving, node):
            _accumulate(graph, known.setdefault(node.number, {}), {where: adjoint}, node.dtype)

    for output, adjoint in zip(entries_of(outputs), entries_of(adjoints), strict=True):
        add(output, adjoint, ())
    for node in reversed(needed):
        if not (parts := known.get(node.number)):
            continue
        adjoint, where = _gathered(graph, parts, node.dtype)
        if (loop := _loop_of(node)) is not None:
            for argument, slope in _slopes(graph, loop, node, moving):
                product = graph.scalar(lax.mul_p, (adjoint, slope), node.dtype)
                add(argument, graph.converted(product, argument.dtype), where)
            continue
        _refuse(node)
        for place, argument in enumerate(node.arguments):
            if not _in(moving, argument):
                continue
            if node.operation is lax.select_n_p:
                add(argument, adjoint, (*where, _taken(graph, node.arguments[0], place - 1)))
            else:
                add(argument, _along(graph, node, place, adjoint, argument.dtype), where)

    def whole(node: Node) -> Sparse:
        return {0: _gathered(graph, {(): node.dtype.type(0)} | known.get(node.number, {}), node.dtype)[0]}

    return _arrays(inputs, [whole(each) for each in entries_of(inputs)])


def _taken(graph: ScalarGraph, which: Any, case: int) -> tuple[Any, bool]:
    """Condition under which a selection takes a case."""
    if which.dtype == _BOOL:
        return which, bool(case)
    return graph.scalar(lax.eq_p, (which, which.dtype.type(case)), _BOOL), True


def _gathered(graph: ScalarGraph, parts: dict[Conditions, Any], dtype: Any) -> tuple[Any, Conditions]:
    """Sum of the parts of an adjoint, and the conditions under which it counts: those that all parts have first, and
    that any part's hold."""
    total: dict[Conditions, Any] = {}
    left = dict(parts)
    while len(left) > 1:
        where = max(left, key=len)
        here, outer, (condition, value) = left.pop(where), where[:-1], where[-1]
        other = left.pop((*outer, (condition, not value)), None)
        if other is None:
            total[where] = here
        else:
            cases = (other, here) if value else (here, other)
            _accumulate(graph, left, {outer: graph.scalar(lax.select_n_p, (condition, *cases), dtype)}, dtype)
    total |= left
    alike = itertools.takewhile(lambda column: len(set(column)) == 1, zip(*total, strict=False))
    shared = tuple(first for first, *_ in alike)
    found: dict[Conditions, Any] = {}
    some: Any = np.bool_(False)
    for where, adjoint in total.items():
        holds: Any = np.bool_(True)
        for condition, value in where[len(shared) :]:
            condition = condition if value else graph.scalar(lax.not_p, (condition,), _BOOL)
            holds = graph.scalar(lax.and_p, (holds, condition), _BOOL)
        some = graph.scalar(lax.or_p, (some, holds), _BOOL)
        part = graph.scalar(lax.select_n_p, (holds, dtype.type(0), adjoint), dtype)
        _accumulate(graph, found, {shared: part}, dtype)
    return found.get(shared, dtype.type(0)), (*shared, (some, True)) if isinstance(some, Node) else shared


@collection_paused()
def jacobian(graph: ScalarGraph, outputs: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Matrix of the derivatives of a vector of outputs over a vector of inputs, by forward mode.

    Raises:
        NotDifferentiableError: it passes a loop or an operation on whole arrays.
    """
    seeds = {each.number: {column: each.dtype.type(1)} for column, each in enumerate(inputs)}
    rows = _pushed(graph, list(outputs), seeds)
    entries = [
        row.get(column, output.dtype.type(0))
        for row, output in zip(rows, outputs, strict=True)
        for column in range(len(inputs))
    ]
    return filled((len(outputs), len(inputs)), entries)


def _arrays(like: Sequence[np.ndarray], found: Sequence[Sparse]) -> list[np.ndarray]:
    entries = iter([each.get(0, old.dtype.type(0)) for each, old in zip(found, entries_of(like), strict=True)])
    return [filled(each.shape, itertools.islice(entries, each.size)) for each in like]


def _pushed(graph: ScalarGraph, outputs: Sequence[Any], seeds: Mapping[int, Sparse]) -> list[Sparse]:
    """Changes of the outputs, from those of the inputs by number, for several columns at once."""
    known = dict(seeds)
    for node in needed_for(outputs, seeds):
        if change := _change(graph, node, known):
            known[node.number] = change
    return [known.get(each.number, {}) if isinstance(each, Node) else {} for each in outputs]


def _change(graph: ScalarGraph, node: Node, known: Mapping[int, Sparse]) -> Sparse:
    """Change of a node from those of its arguments."""
    changes = [known.get(each.number, {}) if isinstance(each, Node) else {} for each in node.arguments]
    if not any(changes) or not _passes(node):
        return {}
    if node.operation in ("whole", "loop"):
        return next(filter(None, changes))  # its outputs refuse to pass it on, or know better
    total: Sparse = {}
    if (loop := _loop_of(node)) is not None:
        for argument, slope in _slopes(graph, loop, node, known.keys()):
            entries = {at: graph.converted(entry, node.dtype) for at, entry in known[argument.number].items()}
            terms = {at: graph.scalar(lax.mul_p, (entry, slope), node.dtype) for at, entry in entries.items()}
            _accumulate(graph, total, terms, node.dtype)
        return total
    _refuse(node)
    if node.operation is lax.select_n_p:
        which, zero = node.arguments[0], node.dtype.type(0)
        for at in sorted({at for change in changes for at in change}):
            entries = (which, *(change.get(at, zero) for change in changes[1:]))
            _accumulate(graph, total, {at: graph.scalar(lax.select_n_p, entries, node.dtype)}, node.dtype)
        return total
    for place, change in enumerate(changes):
        terms = {at: _along(graph, node, place, entry, node.dtype) for at, entry in change.items()}
        _accumulate(graph, total, terms, node.dtype)
    return total


def _loop_of(node: Node) -> Node | None:
    """The loop of known length whose output a node is."""
    loop = node.arguments[0] if node.operation == "output" else None
    return loop if loop and loop.operation == "loop" and loop.parameters.length is not None else None


def _slopes(graph: ScalarGraph, loop: Node, output: Node, moving: Collection[int]) -> list[tuple[Node, Any]]:
    """Arguments of a loop that change, and the derivatives of an output over them, which another loop passes on."""
    body, (place, _) = loop.parameters, output.parameters
    live = body.together[place]
    read = {body.after[at] for at in live}.union(*(each.arguments for each in _inside(body, live)))
    fixed = [each for each in body.fixed if each in read]
    places = *live, *itertools.repeat(None, len(fixed))
    arguments = zip((*(loop.arguments[at] for at in live), *fixed), places, strict=True)
    columns = [each for each in arguments if _in(moving, each[0]) and each[0].dtype.kind == "f"]
    key = loop.number, *live, *((argument.number, at) for argument, at in columns)
    if key not in graph.slopes:
        graph.slopes[key] = _with_slopes(graph, loop, live, columns)
    return graph.slopes[key][place]


def _inside(body: LoopBody, live: Sequence[int]) -> list[Node]:
    """What changes from pass to pass that the entries at some places need."""
    outside = {each.number for each in (*body.carried, *body.fixed)}
    return needed_for((body.after[at] for at in live), outside)


def _with_slopes(
    graph: ScalarGraph, loop: Node, live: Sequence[int], columns: Sequence[tuple[Node, int | None]]
) -> dict[int, list[tuple[Node, Any]]]:
    """Derivatives of what a loop passes on at the places `live` over `columns`, arguments that stand at a place at the
    start or are read by every pass."""
    body = loop.parameters
    carried = {at: graph.node("carry", (), None, body.carried[at].dtype) for at in live}
    values: dict[int, Any] = {each.number: each for each in body.fixed}
    values |= {body.carried[at].number: each for at, each in carried.items()}
    copy_nodes(graph, _inside(body, live), values)
    after = {at: values.get(getattr(body.after[at], "number", 0), body.after[at]) for at in live}
    rows = [at for at in live if carried[at].dtype.kind == "f"]
    slopes = {at: [graph.node("carry", (), None, carried[at].dtype) for _ in columns] for at in rows}
    ends = [carried[at] for at in rows] + [each for each, start in columns if start is None]
    next_slopes: list[Any] = []
    for at in rows:
        dtype = carried[at].dtype
        one_row, one = filled((1,), [after[at]]), filled((1,), [dtype.type(1)])
        (over,) = pull(graph, [one_row], [filled((len(ends),), ends)], [one])
        direct = iter(over[len(rows) :])
        total: Sparse = {
            column: graph.converted(next(direct), dtype) for column, (_, start) in enumerate(columns) if start is None
        }
        for row, factor in zip(rows, over, strict=False):
            through = graph.converted(factor, dtype)
            terms = {
                column: graph.scalar(lax.mul_p, (through, graph.converted(each, dtype)), dtype)
                for column, each in enumerate(slopes[row])
            }
            _accumulate(graph, total, terms, dtype)
        next_slopes += [total.get(column, dtype.type(0)) for column in range(len(columns))]
    starts = [carried[at].dtype.type(at == start) for at in rows for _, start in columns]
    entries = [*carried.values(), *itertools.chain(*slopes.values())]
    whole = LoopBody(entries, [*after.values(), *next_slopes], length=body.length)
    both = loop_node(graph, [*(loop.arguments[at] for at in live), *starts], whole)
    places = itertools.count(len(live))
    return {
        at: [(each, graph.node("output", (both,), (next(places), ()), carried[at].dtype)) for each, _ in columns]
        for at in rows
    }


def _in(numbers: Collection[int], entry: Any) -> bool:
    return isinstance(entry, Node) and entry.number in numbers


def _passes(node: Node) -> bool:
    """Whether a change of its arguments may change a node (not an integer or truth value)."""
    return node.dtype is None or node.dtype.kind == "f"


def _refuse(node: Node) -> None:
    if isinstance(node.operation, str):
        source = node.arguments[0] if node.arguments else node
        what = source.parameters[0].primitive.name if source.operation == "whole" else source.operation
        raise NotDifferentiableError(what)


def _accumulate(graph: ScalarGraph, total: dict[Any, Any], terms: dict[Any, Any], dtype: Any) -> None:
    for at, term in terms.items():
        if isinstance(term, Node) or term != 0:
            total[at] = graph.scalar(lax.add_p, (total[at], term), dtype) if at in total else term


def _along(graph: ScalarGraph, node: Node, place: int, change: Any, kind: Any) -> Any:
    """Multiply a change by the derivative of a node over an argument; `kind` is the result's type."""
    dtype, arguments = node.dtype, node.arguments

    def scalar(primitive: Any, *entries: Any) -> Any:
        return graph.scalar(primitive, entries, dtype)

    match node.operation.name:
        case "add" | "add_any":
            return change
        case "sub":
            return scalar(lax.neg_p, change) if place else change
        case "neg":
            return scalar(lax.neg_p, change)
        case "mul":
            return scalar(lax.mul_p, change, arguments[1 - place])
        case "div":
            inverse = scalar(lax.div_p, dtype.type(1), arguments[1])
            slope = scalar(lax.neg_p, scalar(lax.mul_p, node, inverse)) if place else inverse
            return scalar(lax.mul_p, change, slope)
        case "max" | "min" as name:
            compare = lax.gt_p if name == "max" else lax.lt_p
            wins = graph.scalar(compare, (arguments[place], arguments[1 - place]), _BOOL)
            ties = graph.scalar(lax.eq_p, arguments, _BOOL)
            strict = scalar(lax.select_n_p, wins, dtype.type(0), dtype.type(1))
            return scalar(lax.mul_p, change, scalar(lax.select_n_p, ties, strict, dtype.type(0.5)))
        case "convert_element_type":
            return graph.converted(change, kind)
    closed = _rule(node.operation, place, tuple(each.dtype for each in arguments), tuple(node.parameters.items()))
    (result,) = run(graph, closed, [filled((), [each]) for each in (change, *arguments)])
    return result[()]


@cache
def _rule(primitive: Any, place: int, dtypes: tuple[Any, ...], parameters: tuple[tuple[str, Any], ...]) -> Any:
    """Jaxpr of a change times JAX's derivative of an operation over an argument: of (change, arguments)."""

    def along(change: Any, *arguments: Any) -> Any:
        at = lambda x: primitive.bind(*arguments[:place], x, *arguments[place + 1 :], **dict(parameters))  # noqa: E731
        return jax.jvp(at, (arguments[place],), (change,))[1]

    return jax.make_jaxpr(along)(*(jax.ShapeDtypeStruct((), each) for each in (dtypes[place], *dtypes)))
