"""Rules for factorisations, triangular systems and sorting, written out as the textbook algorithms (see `rules`)."""

import itertools
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from jax import lax

from mjx_study.graph.nodes import ScalarGraph, constants

Arrays = list[np.ndarray]


class _Arithmetic:
    """Operations on scalars of one type."""

    def __init__(self, graph: ScalarGraph, dtype: Any):
        self._graph, self._dtype = graph, dtype

    def less(self, value: Any, pairs: Sequence[tuple[Any, Any]]) -> Any:
        """Subtract the products of pairs."""
        for pair in pairs:
            value = self.of(lax.sub_p, value, self.of(lax.mul_p, *pair))
        return value

    def of(self, primitive: Any, *arguments: Any) -> Any:
        return self._graph.scalar(primitive, arguments, self._dtype)


def _cholesky(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    """Lower factor; NaN where the matrix is not positive definite."""
    scalars = _Arithmetic(graph, aval.dtype)
    factors = constants(np.zeros(aval.shape, aval.dtype))
    for at in np.ndindex(*aval.shape[:-2]):
        matrix, lower = inputs[0][at], factors[at]
        for j, i in itertools.combinations_with_replacement(range(len(matrix)), 2):
            rest = scalars.less(matrix[i, j], list(zip(lower[i, :j], lower[j, :j], strict=True)))
            lower[i, j] = scalars.of(lax.sqrt_p, rest) if i == j else scalars.of(lax.div_p, rest, lower[j, j])
    return [factors]


def _triangular_solve(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    """Solve op(A) X = B, or X op(A) = B as op(A)^T X^T = B^T, by substitution."""
    scalars, left, unit = _Arithmetic(graph, aval.dtype), parameters["left_side"], parameters["unit_diagonal"]
    matrices, right = inputs
    turned = parameters["transpose_a"] == left
    matrices = matrices.swapaxes(-1, -2) if turned else matrices
    solutions = (right if left else right.swapaxes(-1, -2)).copy()
    rows = range(matrices.shape[-1])
    downwards = parameters["lower"] != turned
    for at in np.ndindex(*matrices.shape[:-2]):
        matrix, solution = matrices[at], solutions[at]
        for i in rows if downwards else reversed(rows):
            known = rows[:i] if downwards else rows[i + 1 :]
            for column in range(solution.shape[1]):
                rest = scalars.less(solution[i, column], [(matrix[i, k], solution[k, column]) for k in known])
                solution[i, column] = rest if unit else scalars.of(lax.div_p, rest, matrix[i, i])
    return [solutions if left else solutions.swapaxes(-1, -2)]


def _sort(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    """Exchange neighbours that are out of order until none is; stable, with NaN last."""
    axis, keys = parameters["dimension"], parameters["num_keys"]
    arrays = [np.moveaxis(each, axis, 0).copy() for each in inputs]
    size = len(arrays[0])
    for row in np.ndindex(*arrays[0].shape[1:]):
        for at in (at for end in range(size - 1, 0, -1) for at in range(end)):
            _exchange(graph, arrays, (at + 1, *row), (at, *row), keys)
    return [np.moveaxis(each, 0, axis) for each in arrays]


def _top_k(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    """The k largest entries, each brought forward from the end, and their indices; the first of equal ones first."""
    axis, k = parameters["axis"], parameters["k"]
    entries = np.moveaxis(inputs[0], axis, 0).copy()
    indices = constants(np.broadcast_to(np.arange(len(entries), dtype=np.int32), entries.T.shape).T.copy())
    for row in np.ndindex(*entries.shape[1:]):
        for at in (at for place in range(k) for at in range(len(entries) - 2, place - 1, -1)):
            _exchange(graph, [entries, indices], (at + 1, *row), (at, *row), reverse=True)
    return [np.moveaxis(each[:k], 0, axis) for each in (entries, indices)]


def _exchange(graph, arrays, after, here, keys: int = 1, reverse: bool = False) -> None:
    """Exchange two entries of arrays if the keys, the first arrays, of the second come before those of the first."""
    ordered = [[each[at] for each in arrays[:keys]] for at in (after, here)]
    swap = _precedes(graph, *(reversed(ordered) if reverse else ordered))
    for each in arrays:
        low, high = each[here], each[after]
        each[here] = graph.scalar(lax.select_n_p, (swap, low, high), low.dtype)
        each[after] = graph.scalar(lax.select_n_p, (swap, high, low), low.dtype)


def _precedes(graph: ScalarGraph, one: Sequence[Any], other: Sequence[Any]) -> Any:
    """Whether a vector of keys comes before another in lexicographic order."""
    logic = _Arithmetic(graph, np.dtype(bool))
    (a, *rest_a), (b, *rest_b) = one, other
    before = logic.of(lax.lt_p, a, b)
    if a.dtype.kind == "f":
        numbers = logic.of(lax.and_p, logic.of(lax.eq_p, a, a), logic.of(lax.ne_p, b, b))
        before = logic.of(lax.or_p, before, numbers)
    if not rest_a:
        return before
    after = _precedes(graph, other[:1], one[:1])
    later = logic.of(lax.and_p, logic.of(lax.not_p, after), _precedes(graph, rest_a, rest_b))
    return logic.of(lax.or_p, before, later)


ALGEBRA: Final = {"cholesky": _cholesky, "sort": _sort, "top_k": _top_k, "triangular_solve": _triangular_solve}
