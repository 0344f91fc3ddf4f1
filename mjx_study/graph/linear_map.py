"""Derivatives of graphs as linear maps, each with its transpose: forward and reverse mode without a matrix."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from mjx_study.graph.differentiation import jacobian, pull, push
from mjx_study.graph.function import MOST_KEPT, ScalarFunction, aval_of, inlined
from mjx_study.graph.nodes import ScalarGraph

Solve = Callable[[Any, Any], Any]
"""Solution of a linear system with a symmetric matrix: (matrix, right-hand side) -> solution."""


@dataclass(frozen=True, eq=False)
class LinearMap:
    """A linear map at a point, and its transpose.

    Attributes:
        push: the changes of the results, from (point, changes).
        pull: makes the function of the transpose: the adjoints of what changes, from (point, adjoints of the results).
        early: whether it is used as soon as JAX traces it. Reverse mode traces a derivative only to transpose it.
    """

    push: ScalarFunction
    pull: Callable[[], ScalarFunction]
    early: bool = False

    @cached_property
    def transposed(self) -> "LinearMap":
        return LinearMap(self.pull(), lambda: self.push, early=True)


@lru_cache(MOST_KEPT)
def derivative(function: ScalarFunction, moving: tuple[int, ...]) -> LinearMap:
    """Derivative of the floating-point outputs over the inputs at the places `moving`.

    Raises:
        NotDifferentiableError: it passes a loop or an operation on whole arrays.
    """
    graph, inputs = function.graph, [function.inputs[place] for place in moving]
    outputs = [each for each, aval in zip(function.outputs, function.avals, strict=True) if aval.dtype.kind == "f"]
    changes, adjoints = _fresh(graph, inputs), _fresh(graph, outputs)
    return LinearMap(
        _function(function, changes, push(graph, outputs, inputs, changes)),
        lambda: _function(function, adjoints, pull(graph, outputs, inputs, adjoints)),
    )


@lru_cache(MOST_KEPT)
def implicit_derivative(function: ScalarFunction, moving: tuple[int, ...], solve: Solve) -> LinearMap:
    """Derivative of the results S(x, a) and of the root a of G(x, a) = 0, by the implicit function theorem:

        da = -G_a^-1 G_x dx,    dS = S_x dx + S_a da.

    Args:
        function: G and S, of x and, last, a; as many equations as unknowns, and G_a is symmetric.
        moving: places of the inputs that change, among x.
        solve: see `Solve`.

    Raises:
        NotDifferentiableError: it passes a loop or an operation on whole arrays.
    """
    graph, inputs, root = function.graph, [function.inputs[place] for place in moving], function.inputs[-1]
    gap, *results = function.outputs
    changes, adjoints = _fresh(graph, inputs), _fresh(graph, [*results, root])

    def pushed() -> list[np.ndarray]:
        change = _solved(function, solve, push(graph, [gap], inputs, changes)[0])
        return [*push(graph, results, [*inputs, root], [*changes, change]), change]

    def pulled() -> list[np.ndarray]:
        (through,) = pull(graph, results, [root], adjoints[:-1])
        of_gap = _solved(function, solve, graph.elementwise(lax.add_p, [through, adjoints[-1]], aval_of(root)))
        return pull(graph, [gap, *results], inputs, [of_gap, *adjoints[:-1]])

    return LinearMap(_function(function, changes, pushed()), lambda: _function(function, adjoints, pulled()))


@lru_cache(MOST_KEPT)
def implicit_jacobian(function: ScalarFunction, moving: tuple[int, ...], solve: Solve) -> ScalarFunction:
    """Matrix of `implicit_derivative`: rows are the entries of the results and the root, columns those that change.

    Raises:
        NotDifferentiableError: it passes a loop or an operation on whole arrays.
    """
    graph, inputs = function.graph, np.concatenate([function.inputs[place] for place in moving])
    gap, *results = function.outputs
    results = np.concatenate(results)
    response = _solved(function, solve, jacobian(graph, gap, inputs))
    through = lambda over, over_root, response: jnp.concatenate([over + over_root @ response, response])  # noqa: E731
    blocks = jacobian(graph, results, inputs), jacobian(graph, results, function.inputs[-1]), response
    return _function(function, [], inlined(graph, through, *blocks))


def _solved(function: ScalarFunction, solve: Solve, right_side: np.ndarray) -> np.ndarray:
    """-G_a^-1 times the right-hand side."""
    slope = jacobian(function.graph, function.outputs[0], function.inputs[-1])
    (solution,) = inlined(function.graph, lambda *system: -solve(*system), slope, right_side)
    return solution


def _fresh(graph: ScalarGraph, like: Sequence[np.ndarray]) -> list[np.ndarray]:
    return [graph.fresh("input", each.shape, aval_of(each).dtype) for each in like]


def _function(function: ScalarFunction, more: Sequence[np.ndarray], outputs: list[np.ndarray]) -> ScalarFunction:
    """A function of the inputs and of more inputs in the same graph."""
    return ScalarFunction(function.graph, [*function.inputs, *more], outputs, list(map(aval_of, outputs)), None)
