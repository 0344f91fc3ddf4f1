"""Evaluate functions of small arrays entry by entry.

MJX computes with arrays of a few entries (poses, inertias, Jacobians, constraint rows), many of which are always 0 or
1. Batched, each of its thousands of operations is a separate loop or kernel with strided access and tiny matrix
products, and constants are recomputed for every sample. `unrolled` evaluates a function's jaxpr entry by entry: it
folds constants, eliminates common subexpressions, and drops what no output needs. The remaining scalar operations
act on contiguous arrays over the batch under `vmap`, and fuse.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import numpy as np
from jax.core import Tracer

from mjx_study.graph.build import native_identity
from mjx_study.graph.evaluation import written_out
from mjx_study.graph.function import capture
from mjx_study.graph.native import as_native
from mjx_study.graph.nodes import TooLargeError, no_type_check

MOST_SCALARS: Final = {"cpu": 12_000, "gpu": 6_000, "tpu": 6_000}
"""Maximum number of scalar operations, by backend; XLA's compile time grows faster than linearly in it."""
MOST_NATIVE: Final = 200_000
"""Maximum number of scalar operations in native code."""

_WRITTEN_OUT: Final[dict[Any, Callable[..., Any]]] = {}
"""Graphs as functions, keyed by everything they depend on. JAX batches and differentiates each of
them once for all programs that use it."""
MOST_KEPT: Final = 64
"""Maximum number of functions in `_WRITTEN_OUT`."""


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
    key = _name(function), structure, tuple(map(_content, leaves)), jax.default_backend(), native_identity()
    if key not in _WRITTEN_OUT:
        while len(_WRITTEN_OUT) >= MOST_KEPT:
            del _WRITTEN_OUT[next(iter(_WRITTEN_OUT))]
        _WRITTEN_OUT[key] = _written_out(function, arguments)
    return _WRITTEN_OUT[key](*inputs)


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


def _written_out(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Callable[..., Any]:
    """Build a function of the traced leaves of the arguments: native code, JAX operations, or the function as it is."""
    leaves, structure = jax.tree.flatten(arguments)
    fixed = [None if isinstance(leaf, Tracer) else leaf for leaf in leaves]
    native, most = native_identity() is not None, MOST_SCALARS[jax.default_backend()]

    def itself(*inputs: jax.Array) -> Any:
        given = iter(inputs)
        return function(*structure.unflatten([next(given) if leaf is None else leaf for leaf in fixed]))

    try:
        captured = capture(function, *arguments, most=2 * (MOST_NATIVE if native else most))
    except TooLargeError:
        return itself
    small, used = len(captured.needed) <= most, captured.used

    def in_jax() -> Callable[..., list[jax.Array]]:
        if small:
            return written_out(captured)
        return jax.jit(lambda *inputs: jax.tree.leaves(itself(*inputs)))

    found = None
    if native and used and len(captured.needed) <= MOST_NATIVE:
        values = captured
        if any(node.operation == "whole" for node in captured.needed):
            values = capture(function, *arguments, most=2 * MOST_NATIVE, values_only=True)
        found = as_native(values, used, in_jax)
    if found is None and not small:
        return itself
    found = found or in_jax()
    return lambda *inputs: jax.tree.unflatten(captured.structure, found(*inputs))


def traced_part(tree: Any) -> tuple[list[Any], Callable[[list[Any]], Any]]:
    """Return the traced leaves of a pytree, with None for others, and a function that reassembles it.

    `jax.custom_jvp` traces its arguments; this keeps constants out of them, so that they fold.
    """
    leaves, structure = jax.tree.flatten(tree)

    def whole(traced: list[Any]) -> Any:
        return structure.unflatten([leaf if each is None else each for leaf, each in zip(leaves, traced, strict=True)])

    return [leaf if isinstance(leaf, Tracer) else None for leaf in leaves], whole
