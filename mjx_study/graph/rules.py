"""Rules for operations that move, sum or select entries of scalar arrays, for sorting, and for factorisations and
triangular systems, written out as the textbook algorithms.

Each rule is a function (graph, inputs, aval of the output, parameters) -> outputs, or None to leave the operation as it
is.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any, Final

import numpy as np
from jax import lax
from jax.core import ShapedArray

from mjx_study.graph.indexing import INDEXING
from mjx_study.graph.nodes import ScalarGraph, constants, filled

Arrays = list[np.ndarray]
Parameters = dict[str, Any]
Rule = Callable[[ScalarGraph, Arrays, Any, Parameters], Arrays | None]


def _broadcast(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    shape = [1] * len(aval.shape)
    for place, size in zip(parameters["broadcast_dimensions"], inputs[0].shape, strict=True):
        shape[place] = size
    return [np.broadcast_to(inputs[0].reshape(shape), aval.shape)]


def _slice(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    bounds = parameters["start_indices"], parameters["limit_indices"], parameters["strides"] or (1,) * len(aval.shape)
    return [inputs[0][tuple(itertools.starmap(slice, zip(*bounds, strict=True)))]]


def _pad(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
    array, filler = inputs
    if any(low < 0 or high < 0 or between for low, high, between in parameters["padding_config"]):
        return None
    padded = filled(aval.shape, itertools.repeat(filler[()], math.prod(aval.shape)))
    lows = [low for low, _, _ in parameters["padding_config"]]
    padded[tuple(slice(low, low + size) for low, size in zip(lows, array.shape, strict=True))] = array
    return [padded]


def _reduction(combine: Any) -> Rule:
    def rule(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
        (array,), axes = inputs, parameters["axes"]
        if not array.size and combine is not lax.add_p:
            return None
        sizes = [array.shape[axis] for axis in axes]
        rows = np.moveaxis(array, axes, range(-len(axes), 0)).reshape(*aval.shape, math.prod(sizes))
        return [graph.reduced(combine, rows, aval)]

    return rule


def _place_of_extreme(no_better: Any) -> Rule:
    """Place of the first NaN, or else of the first entry to which all others are no better."""

    def rule(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
        rows = np.moveaxis(inputs[0], parameters["axes"][0], -1)
        kind, truth = rows.flat[0].dtype, aval.update(dtype=np.dtype(bool))
        best, place = rows[..., 0], constants(np.zeros(aval.shape, aval.dtype))
        for at in range(1, rows.shape[-1]):
            worse = graph.elementwise(no_better, [rows[..., at], best], truth)
            here = graph.elementwise(lax.not_p, [worse], truth)
            if kind.kind == "f":
                here = graph.elementwise(lax.and_p, [here, graph.elementwise(lax.eq_p, [best, best], truth)], truth)
            best = graph.elementwise(lax.select_n_p, [here, best, rows[..., at]], aval.update(dtype=kind))
            this = constants(np.full(aval.shape, at, aval.dtype))
            place = graph.elementwise(lax.select_n_p, [here, place, this], aval)
        return [place]

    return rule


def _one_minus_square(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    """(1 + x) (1 - x), an operation of its own from JAX 0.11 on."""
    one = constants(np.ones((), aval.dtype))
    factors = [graph.elementwise(primitive, [one, inputs[0]], aval) for primitive in (lax.add_p, lax.sub_p)]
    return [graph.elementwise(lax.mul_p, factors, aval)]


def _cumsum(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    result = inputs[0].copy()
    rows = np.moveaxis(np.flip(result, parameters["axis"]) if parameters["reverse"] else result, parameters["axis"], 0)
    for before, row in itertools.pairwise(range(len(rows))):  # by index, because a reshaped view may be a copy
        kind = aval.update(shape=rows.shape[1:])
        rows[row, ...] = graph.elementwise(lax.add_p, [rows[before, ...], rows[row, ...]], kind)
    return [result]


def _dot(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    (over, batch), factors = parameters["dimension_numbers"], []
    for array, summed, shared in zip(inputs, over, batch, strict=True):
        free = [axis for axis in range(array.ndim) if axis not in (*summed, *shared)]
        sizes = [math.prod(array.shape[axis] for axis in axes) for axes in (shared, free, summed)]
        moved = array.transpose([*shared, *free, *summed]).reshape(sizes)
        factors.append(filled(tuple(sizes), [graph.converted(each, aval.dtype) for each in moved.flat]))
    left, right = factors[0][:, :, None], factors[1][:, None]
    terms = ShapedArray(np.broadcast_shapes(left.shape, right.shape), aval.dtype)
    products = graph.elementwise(lax.mul_p, [left, right], terms)
    total = graph.reduced(lax.add_p, products, aval.update(shape=products.shape[:-1]))
    return [total.reshape(aval.shape)]


def _reinterpreted(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
    same = inputs[0].shape == aval.shape and aval.dtype != bool
    return [graph.elementwise(lax.bitcast_convert_type_p, inputs, aval, **parameters)] if same else None


def _arithmetic(graph: ScalarGraph, dtype: Any) -> Callable[..., Any]:
    """Operations on scalars of one type."""
    return lambda primitive, *arguments: graph.scalar(primitive, arguments, dtype)


def _less(of: Callable[..., Any], value: Any, pairs: Iterable[tuple[Any, Any]]) -> Any:
    """Subtract the products of pairs."""
    return functools.reduce(lambda left, pair: of(lax.sub_p, left, of(lax.mul_p, *pair)), pairs, value)


def _cholesky(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    """Lower factor; NaN where the matrix is not positive definite."""
    of = _arithmetic(graph, aval.dtype)
    factors = constants(np.zeros(aval.shape, aval.dtype))
    for at in np.ndindex(*aval.shape[:-2]):
        matrix, lower = inputs[0][at], factors[at]
        for j, i in itertools.combinations_with_replacement(range(len(matrix)), 2):
            rest = _less(of, matrix[i, j], zip(lower[i, :j], lower[j, :j], strict=True))
            lower[i, j] = of(lax.sqrt_p, rest) if i == j else of(lax.div_p, rest, lower[j, j])
    return [factors]


def _triangular_solve(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    """Solve op(A) X = B, or X op(A) = B as op(A)^T X^T = B^T, by substitution."""
    of, left, unit = _arithmetic(graph, aval.dtype), parameters["left_side"], parameters["unit_diagonal"]
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
                rest = _less(of, solution[i, column], [(matrix[i, k], solution[k, column]) for k in known])
                solution[i, column] = rest if unit else of(lax.div_p, rest, matrix[i, i])
    return [solutions if left else solutions.swapaxes(-1, -2)]


def _sort(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
    """Exchange neighbours that are out of order until none is; stable, with NaN last."""
    if parameters["num_keys"] > 1:
        return None
    axis = parameters["dimension"]
    arrays = [np.moveaxis(each, axis, 0).copy() for each in inputs]
    size = len(arrays[0])
    for row in np.ndindex(*arrays[0].shape[1:]):
        for at in (at for end in range(size - 1, 0, -1) for at in range(end)):
            _exchange(graph, arrays, (at + 1, *row), (at, *row))
    return [np.moveaxis(each, 0, axis) for each in arrays]


def _top_k(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    """The k largest entries, each brought forward from the end, and their indices; the first of equal ones first."""
    axis, k = parameters["axis"], parameters["k"]
    entries = np.moveaxis(inputs[0], axis, 0).copy()
    indices = constants(np.broadcast_to(np.arange(len(entries), dtype=np.int32), entries.T.shape).T.copy())
    for row in np.ndindex(*entries.shape[1:]):
        for at in (at for place in range(k) for at in range(len(entries) - 2, place - 1, -1)):
            _exchange(graph, [entries, indices], (at + 1, *row), (at, *row), reverse=True)
    return [np.moveaxis(each[:k], 0, axis) for each in (entries, indices)]


def _exchange(graph: ScalarGraph, arrays: Arrays, after: Any, here: Any, reverse: bool = False) -> None:
    """Exchange two entries of arrays if those of the first array, the keys, are out of order."""
    ordered = [arrays[0][at] for at in (after, here)]
    swap = _precedes(graph, *(reversed(ordered) if reverse else ordered))
    for each in arrays:
        low, high = each[here], each[after]
        each[here] = graph.scalar(lax.select_n_p, (swap, low, high), low.dtype)
        each[after] = graph.scalar(lax.select_n_p, (swap, high, low), low.dtype)


def _precedes(graph: ScalarGraph, one: Any, other: Any) -> Any:
    """Whether a number comes before another; NaN is last."""
    of = _arithmetic(graph, np.dtype(bool))
    before = of(lax.lt_p, one, other)
    if one.dtype.kind == "f":
        before = of(lax.or_p, before, of(lax.and_p, of(lax.eq_p, one, one), of(lax.ne_p, other, other)))
    return before


RULES: Final[dict[str, Rule]] = {
    **INDEXING,
    **dict.fromkeys(("squeeze", "reshape", "expand_dims"), lambda _, inputs, aval, __: [inputs[0].reshape(aval.shape)]),
    "argmax": _place_of_extreme(lax.le_p),
    "argmin": _place_of_extreme(lax.ge_p),
    "bitcast_convert_type": _reinterpreted,
    "broadcast_in_dim": _broadcast,
    "cholesky": _cholesky,
    "concatenate": lambda _, inputs, __, parameters: [np.concatenate(inputs, parameters["dimension"])],
    "cumsum": _cumsum,
    "dot_general": _dot,
    "iota": lambda _, __, aval, parameters: [
        constants(np.indices(aval.shape)[parameters["dimension"]].astype(aval.dtype))
    ],
    "one_minus_square": _one_minus_square,
    "pad": _pad,
    "reduce_and": _reduction(lax.and_p),
    "reduce_max": _reduction(lax.max_p),
    "reduce_min": _reduction(lax.min_p),
    "reduce_or": _reduction(lax.or_p),
    "reduce_sum": _reduction(lax.add_p),
    "rev": lambda _, inputs, __, parameters: [np.flip(inputs[0], parameters["dimensions"])],
    "slice": _slice,
    "sort": _sort,
    "split": lambda _, inputs, __, parameters: np.split(
        inputs[0], np.cumsum(parameters["sizes"])[:-1], parameters["axis"]
    ),
    "stack": lambda _, inputs, __, parameters: [np.stack(inputs, parameters["axis"])],
    "tile": lambda _, inputs, __, parameters: [np.tile(inputs[0], parameters["reps"])],
    "top_k": _top_k,
    "triangular_solve": _triangular_solve,
    "unstack": lambda _, inputs, __, parameters: list(np.moveaxis(inputs[0], parameters["axis"], 0)),
    "transpose": lambda _, inputs, __, parameters: [inputs[0].transpose(parameters["permutation"])],
}
