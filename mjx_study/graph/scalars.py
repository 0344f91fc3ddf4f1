"""Evaluate functions of small arrays entry by entry.

MJX computes with arrays of a few entries (poses, inertias, Jacobians, constraint rows), many of which are always 0 or
1. Batched, each of its thousands of operations is a separate loop or kernel with strided access and tiny matrix
products, and constants are recomputed for every sample. `unrolled` evaluates a function's jaxpr entry by entry: it
folds constants, eliminates common subexpressions, and drops what no output needs. The remaining scalar operations
act on contiguous arrays over the batch under `vmap`, and fuse.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import jax
import numpy as np
from jax.core import Tracer

from mjx_study.graph.function import MOST_KEPT, ScalarFunction, capture, is_input
from mjx_study.graph.native import count_left, in_numpy, native_identity
from mjx_study.graph.nodes import SideEffectsError, TooLargeError
from mjx_study.graph.operation import computed

MOST_SCALARS: Final = {"cpu": 12_000, "gpu": 6_000, "tpu": 6_000}
"""Maximum number of scalar operations, by backend; XLA's compile time grows faster than linearly in it."""
MOST_NATIVE: Final = {"cpu": 1_000_000, "gpu": 1_000_000, "NumPy": 100_000}
"""The same of native code. On CPUs, an operation on a vector takes about a cycle at any size, and compilers take two
minutes of processor time for a million; a GPU takes a step of 240,000 at 0.6 million samples a second."""

_CAPTURED: Final[dict[Any, ScalarFunction | None]] = {}
"""Graphs, keyed by everything they depend on; None if too large."""


def unrolled(function: Callable[..., Any], *arguments: Any, otherwise: Callable[..., Any] | None = None) -> Any:
    """Evaluate `function(*arguments)` entry by entry, or `otherwise` or as is beyond `most_scalars` operations.

    Untraced arrays among the arguments are constants. The result equals the function's up to rounding, except that 0
    times infinity or NaN is 0 where the 0 is a constant. Forward and reverse mode differentiate it like the function
    itself.
    """
    inputs = [leaf for leaf in jax.tree.leaves(arguments) if isinstance(leaf, Tracer)]
    if not inputs or (captured := captured_once(function, *arguments)) is None:
        return (otherwise or function)(*arguments)
    return jax.tree.unflatten(captured.structure, computed(captured, inputs))


def captured_once(function: Callable[..., Any], *arguments: Any) -> ScalarFunction | None:
    """`capture`, once for all programs; None if it takes more than `most_scalars` operations."""
    leaves, structure = jax.tree.flatten(arguments)
    most = most_scalars()
    key = _name(function), structure, tuple(map(_content, leaves)), most
    if key not in _CAPTURED:
        while len(_CAPTURED) >= MOST_KEPT:
            del _CAPTURED[next(iter(_CAPTURED))]
        try:
            captured = capture(function, *arguments, most=2 * most)
            captured = captured if is_small(captured) else None
            if captured and any(node.operation == "whole" for node in captured.needed):
                values = capture(function, *arguments, most=2 * most, values_only=True)
                captured = dataclasses.replace(captured, values=values)
        except (TooLargeError, SideEffectsError) as error:
            captured = _left("side effects" if isinstance(error, SideEffectsError) else None)
        _CAPTURED[key] = captured
    return _CAPTURED[key]


def is_small(function: ScalarFunction) -> bool:
    """Whether a graph is worth compiling: it has at most `most_scalars` operations; counted if it is not."""
    if (len(function.needed) if native_identity() is None else function.size) <= most_scalars():
        return True
    _left()
    return False


def _left(reason: str | None = None) -> None:
    if native_identity() is not None:
        count_left(reason or f"more than {most_scalars()} operations")


def most_scalars() -> int:
    """Maximum number of scalar operations here: `MOST_NATIVE`, or `MOST_SCALARS` without native code."""
    if native_identity() is None:
        return MOST_SCALARS[jax.default_backend()]
    return MOST_NATIVE["NumPy" if in_numpy() else jax.default_backend()]


def _name(function: Any) -> Any:
    """Key shared by partials of the same function and arguments, which may be partials, too."""
    if isinstance(function, partial):
        return _name(function.func), tuple(map(_name, function.args)), tuple(sorted(function.keywords.items()))
    return function


def _content(leaf: Any) -> Any:
    """Return what a graph depends on: the type of traced leaves, the value of others."""
    if is_input(leaf):
        return leaf.shape, leaf.dtype.str
    array = np.asarray(leaf)
    return array.shape, array.dtype.str, array.tobytes()


def traced_part(tree: Any) -> tuple[list[Any], Callable[[list[Any]], Any]]:
    """Return the traced leaves of a pytree, with None for others, and a function that reassembles it.

    `jax.custom_jvp` traces its arguments; this keeps constants out of them, so that they fold.
    """
    leaves, structure = jax.tree.flatten(tree)

    def whole(traced: list[Any]) -> Any:
        return structure.unflatten([leaf if each is None else each for leaf, each in zip(leaves, traced, strict=True)])

    return [leaf if isinstance(leaf, Tracer) else None for leaf in leaves], whole
