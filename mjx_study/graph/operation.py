"""Graphs as functions of JAX arrays, differentiated and transposed as graphs.

JAX traces and differentiates nothing inside: the derivative of such a function is another one, at every order and in
either mode, in scans, batches and checkpoints.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, Final

import jax

from mjx_study.graph.derivative_rule import Transpose, flat_with_rule, instantiated
from mjx_study.graph.differentiation import NotDifferentiableError
from mjx_study.graph.evaluation import written_out
from mjx_study.graph.function import MOST_KEPT, ScalarFunction
from mjx_study.graph.linear_map import LinearMap, derivative
from mjx_study.graph.native import POSTPONED, NativeFunction, count_left, native_identity, written

MOST_DIFFERENTIATED: Final = 20_000
"""Maximum size of a linear map that is differentiated as a graph if JAX can do it, too."""
Along = Callable[[Sequence[Any], Sequence[Any]], Sequence[Any] | None]
"""From inputs and their changes, None where there is none, to the changes of the outputs; None to derive the graph."""
Plain = Callable[[Sequence[Any], Sequence[Any]], Sequence[Any]]
"""A linear map in JAX operations: (point, changes) -> changes of the results."""


def computed(
    function: ScalarFunction,
    inputs: Sequence[Any],
    transpose: Transpose | None = None,
    along: Along | None = None,
    *,
    early: bool = True,
) -> list[Any]:
    """Outputs of a graph.

    Args:
        function: the graph.
        inputs: its inputs.
        transpose: its transposition, if it is linear in some of its inputs.
        along: its derivative, if it is not to be that of the graph.
        early: whether to begin to build native code now, or when a program with it is compiled.
    """

    def rule(primals: Sequence[Any], changes: Sequence[Any]) -> Any:
        value = computed(function, primals, transpose, along, early=early)
        if along is not None and (found := along(primals, changes)) is not None:
            return value, list(found)
        moving = tuple(place for place, change in enumerate(changes) if change is not None)
        try:
            slope = derivative(function, moving)
        except NotDifferentiableError as error:  # JAX differentiates the operations on whole arrays
            count_left(f"derivative of {error}")
            whole = tuple(instantiated(list(primals), list(changes)))
            return value, jax.jvp(written_out(function), tuple(primals), whole)[1]
        found = iter(applied(slope, primals, [changes[place] for place in moving]))
        return value, [next(found) if aval.dtype.kind == "f" else None for aval in function.avals]

    program = _program(function, early, native_identity())
    return flat_with_rule(program, inputs, rule, transpose)


def applied(linear: LinearMap, point: Sequence[Any], changes: Sequence[Any], plain: Plain | None = None) -> list[Any]:
    """Changes of the results of a linear map at a point.

    Args:
        linear: the map.
        point: the point.
        changes: the changes there.
        plain: the same in JAX operations, from which derivatives of a large map over the point are taken.
    """
    size = len(point)

    def transpose(fixed: Sequence[Any], adjoints: Sequence[Any]) -> list[Any]:
        found = applied(linear.transposed, fixed[:size], adjoints, None if plain is None else turned)
        wanted = [each if known is None else None for each, known in zip(found, fixed[size:], strict=True)]
        return [None] * size + wanted

    def along(primals: Sequence[Any], moved: Sequence[Any]) -> Sequence[Any] | None:
        whole = tuple(instantiated(list(primals), list(moved)))
        if all(each is None for each in moved[:size]):
            return applied(linear, primals[:size], whole[size:], plain)
        large = plain is not None and linear.push.size > MOST_DIFFERENTIATED
        return jax.jvp(split, tuple(primals), whole)[1] if large else None

    def split(*inputs: Any) -> tuple[Any, ...]:
        assert plain is not None
        return tuple(plain(inputs[:size], inputs[size:]))

    def turned(point: Sequence[Any], adjoints: Sequence[Any]) -> Sequence[Any]:
        return jax.linear_transpose(partial(split, *point), *map(jax.typeof, changes))(tuple(adjoints))

    return computed(linear.push, [*point, *changes], transpose, along, early=linear.early)


@lru_cache(MOST_KEPT)
def _program(function: ScalarFunction, early: bool, identity: str | None) -> Callable[..., list[jax.Array]]:
    """Native code where it can be built, else JAX operations."""
    own, used, native = function.of(function.used), function.used, None
    if identity is not None and used:
        values = own.values or own
        native = NativeFunction(lambda: written(values), own.types, own.avals, lambda: written_out(own), values)
        native = native if not early or POSTPONED.get() or native.begun() else None
    end = native or written_out(own)
    return lambda *inputs: end(*(inputs[place] for place in used))
