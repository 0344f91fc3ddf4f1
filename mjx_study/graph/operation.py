"""Graphs as functions of JAX arrays, differentiated and transposed as graphs.

JAX traces and differentiates nothing inside: the derivative of such a function is another one, at every order and in
either mode, in scans, batches and checkpoints.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax

from mjx_study.graph.derivative_rule import Transpose, flat_with_rule, instantiated
from mjx_study.graph.differentiation import NotDifferentiableError
from mjx_study.graph.evaluation import written_out
from mjx_study.graph.function import ScalarFunction
from mjx_study.graph.linear_map import LinearMap, derivative
from mjx_study.graph.native import as_native, count_left, native_identity


def computed(function: ScalarFunction, inputs: Sequence[Any], transpose: Transpose | None = None) -> list[Any]:
    """Outputs of a graph.

    Args:
        function: the graph.
        inputs: its inputs.
        transpose: its transposition, if it is linear in some of its inputs.
    """

    def rule(primals: Sequence[Any], changes: Sequence[Any]) -> Any:
        moving = tuple(place for place, change in enumerate(changes) if change is not None)
        try:
            slope = derivative(function, moving)
        except NotDifferentiableError as error:  # JAX differentiates the operations on whole arrays
            count_left(f"derivative of {error}")
            return jax.jvp(program, tuple(primals), tuple(instantiated(list(primals), list(changes))))
        value = computed(function, primals, transpose)
        found = iter(applied(slope, primals, [changes[place] for place in moving]))
        return value, [next(found) if aval.dtype.kind == "f" else None for aval in function.avals]

    program = _program(function)
    return flat_with_rule(program, inputs, rule, transpose)


def applied(linear: LinearMap, point: Sequence[Any], changes: Sequence[Any]) -> list[Any]:
    """Changes of the results of a linear map at a point."""

    def transpose(fixed: Sequence[Any], adjoints: Sequence[Any]) -> list[Any]:
        found = applied(linear.transposed, fixed[: len(point)], adjoints)
        wanted = [each if known is None else None for each, known in zip(found, fixed[len(point) :], strict=True)]
        return [None] * len(point) + wanted

    return computed(linear.push, [*point, *changes], transpose)


def _program(function: ScalarFunction) -> Callable[..., list[jax.Array]]:
    """Native code where it can be built, else JAX operations."""
    key = "program", native_identity()
    if key not in function.derived:
        used, native = function.used, None
        if native_identity() is not None and used:
            native = as_native(function.derived.get("values", function).of(used), function.of(used))
        end = native or written_out(function.of(used))
        function.derived[key] = lambda *inputs: end(*(inputs[place] for place in used))
    return function.derived[key]
