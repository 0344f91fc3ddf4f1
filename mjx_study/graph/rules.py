"""Rules for operations that move, sum or select entries of scalar arrays.

Each rule is a function (graph, inputs, aval of the output, parameters) -> outputs, or None to leave the operation as it
is.
"""

import itertools
import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from jax import lax
from jax.core import ShapedArray

from mjx_study.graph.algebra import ALGEBRA
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


def _place_of_extreme(better: Any) -> Rule:
    def rule(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
        rows = np.moveaxis(inputs[0], parameters["axes"][0], -1)
        kind = rows.flat[0].dtype
        best, place = rows[..., 0], constants(np.zeros(aval.shape, aval.dtype))
        for at in range(1, rows.shape[-1]):
            here = graph.elementwise(better, [rows[..., at], best], aval.update(dtype=np.dtype(bool)))
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
        kind = {"new_dtype": aval.dtype, "weak_type": False, "sharding": None}
        moved = array.transpose([*shared, *free, *summed]).reshape(sizes)
        entries = [
            each if each.dtype == aval.dtype else graph.scalar(lax.convert_element_type_p, (each,), aval.dtype, **kind)
            for each in moved.flat
        ]
        factors.append(filled(tuple(sizes), entries))
    left, right = factors[0][:, :, None], factors[1][:, None]
    terms = ShapedArray(np.broadcast_shapes(left.shape, right.shape), aval.dtype)
    products = graph.elementwise(lax.mul_p, [left, right], terms)
    total = graph.reduced(lax.add_p, products, aval.update(shape=products.shape[:-1]))
    return [total.reshape(aval.shape)]


def _reinterpreted(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
    same = inputs[0].shape == aval.shape and aval.dtype != bool
    return [graph.elementwise(lax.bitcast_convert_type_p, inputs, aval, **parameters)] if same else None


RULES: Final[dict[str, Rule]] = {
    **ALGEBRA,
    **INDEXING,
    **dict.fromkeys(("squeeze", "reshape", "expand_dims"), lambda _, inputs, aval, __: [inputs[0].reshape(aval.shape)]),
    "argmax": _place_of_extreme(lax.gt_p),
    "argmin": _place_of_extreme(lax.lt_p),
    "bitcast_convert_type": _reinterpreted,
    "broadcast_in_dim": _broadcast,
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
    "split": lambda _, inputs, __, parameters: np.split(
        inputs[0], np.cumsum(parameters["sizes"])[:-1], parameters["axis"]
    ),
    "stack": lambda _, inputs, __, parameters: [np.stack(inputs, parameters["axis"])],
    "tile": lambda _, inputs, __, parameters: [np.tile(inputs[0], parameters["reps"])],
    "unstack": lambda _, inputs, __, parameters: list(np.moveaxis(inputs[0], parameters["axis"], 0)),
    "transpose": lambda _, inputs, __, parameters: [inputs[0].transpose(parameters["permutation"])],
}
