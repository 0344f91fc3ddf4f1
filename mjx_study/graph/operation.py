"""Graphs as functions of JAX arrays, differentiated and transposed as graphs.

JAX traces and differentiates nothing inside: the derivative of such a function is another one, at every order and in
either mode, in scans, batches and checkpoints.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import jax

from mjx_study.graph.derivative_rule import Transpose, flat_with_rule, instantiated
from mjx_study.graph.differentiation import NotDifferentiableError
from mjx_study.graph.evaluation import written_out
from mjx_study.graph.function import ScalarFunction
from mjx_study.graph.linear_map import LinearMap, derivative
from mjx_study.graph.native import as_native, count_left, native_identity

MOST_DIFFERENTIATED: Final = 20_000
"""Maximum size of a linear map that is differentiated as a graph if JAX can do it, too."""
Plain = Callable[[Sequence[Any], Sequence[Any]], Sequence[Any]]
"""A linear map in JAX operations: (point, changes) -> changes of the results."""


def computed(
    function: ScalarFunction,
    inputs: Sequence[Any],
    transpose: Transpose | None = None,
    *,
    early: bool = True,
    plain: Callable[..., Sequence[Any]] | None = None,
) -> list[Any]:
    """Outputs of a graph.

    Args:
        function: the graph.
        inputs: its inputs.
        transpose: its transposition, if it is linear in some of its inputs.
        early: whether to begin to build native code now, or when a program with it is compiled.
        plain: the same in JAX operations, to differentiate a function larger than `MOST_DIFFERENTIATED`.
    """

    def value(primals: Sequence[Any]) -> list[Any]:
        return computed(function, primals, transpose, early=early, plain=plain)

    def by_jax(program: Callable[..., Any], primals: Sequence[Any], changes: Sequence[Any]) -> Any:
        return jax.jvp(program, tuple(primals), tuple(instantiated(list(primals), list(changes))))

    def rule(primals: Sequence[Any], changes: Sequence[Any]) -> Any:
        if plain is not None and function.size > MOST_DIFFERENTIATED:
            return value(primals), list(by_jax(plain, primals, changes)[1])
        moving = tuple(place for place, change in enumerate(changes) if change is not None)
        try:
            slope = derivative(function, moving)
        except NotDifferentiableError as error:  # JAX differentiates the operations on whole arrays
            count_left(f"derivative of {error}")
            return by_jax(program, primals, changes)
        found = iter(applied(slope, primals, [changes[place] for place in moving]))
        return value(primals), [next(found) if aval.dtype.kind == "f" else None for aval in function.avals]

    program = _program(function, early)
    return flat_with_rule(program, inputs, rule, transpose)


def applied(linear: LinearMap, point: Sequence[Any], changes: Sequence[Any], plain: Plain | None = None) -> list[Any]:
    """Changes of the results of a linear map at a point.

    Args:
        linear: the map.
        point: the point.
        changes: the changes there.
        plain: the same in JAX operations, from which derivatives of large maps are taken.
    """

    def transpose(fixed: Sequence[Any], adjoints: Sequence[Any]) -> list[Any]:
        found = applied(linear.transposed, fixed[: len(point)], adjoints, None if plain is None else turned)
        wanted = [each if known is None else None for each, known in zip(found, fixed[len(point) :], strict=True)]
        return [None] * len(point) + wanted

    def turned(point: Sequence[Any], adjoints: Sequence[Any]) -> Sequence[Any]:
        along = partial(split, *point)
        return jax.linear_transpose(along, *map(jax.typeof, changes))(tuple(adjoints))

    def split(*inputs: Any) -> tuple[Any, ...]:
        assert plain is not None
        return tuple(plain(inputs[: len(point)], inputs[len(point) :]))

    also = None if plain is None else split
    return computed(linear.push, [*point, *changes], transpose, early=linear.early, plain=also)


def _program(function: ScalarFunction, early: bool) -> Callable[..., list[jax.Array]]:
    """Native code where it can be built, else JAX operations."""
    key = "program", native_identity()
    if key not in function.derived:
        used, native = function.used, None
        if native_identity() is not None and used:
            native = as_native(function.derived.get("values", function).of(used), function.of(used), early=early)
        end = native or written_out(function.of(used))
        function.derived[key] = lambda *inputs: end(*(inputs[place] for place in used))
    return function.derived[key]
