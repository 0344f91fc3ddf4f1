"""Rules for operations that move, sum or select entries of scalar arrays.

Each rule is a function (graph, inputs, aval of the output, parameters) -> outputs, or None to leave the operation as it
is.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from jax import lax
from jax.core import ShapedArray

from mjx_study.graph.nodes import Node, ScalarGraph, constants, filled, no_type_check

Arrays = list[np.ndarray]
Parameters = dict[str, Any]
Rule = Callable[[ScalarGraph, Arrays, Any, Parameters], Arrays | None]


@no_type_check
def _broadcast(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    shape = [1] * len(aval.shape)
    for place, size in zip(parameters["broadcast_dimensions"], inputs[0].shape, strict=True):
        shape[place] = size
    return [np.broadcast_to(inputs[0].reshape(shape), aval.shape)]


@no_type_check
def _slice(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    bounds = parameters["start_indices"], parameters["limit_indices"], parameters["strides"] or (1,) * len(aval.shape)
    return [inputs[0][tuple(itertools.starmap(slice, zip(*bounds, strict=True)))]]


@no_type_check
def _pad(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
    array, filler = inputs
    if any(low < 0 or high < 0 or between for low, high, between in parameters["padding_config"]):
        return None
    padded = filled(aval.shape, itertools.repeat(filler[()], math.prod(aval.shape)))
    lows = [low for low, _, _ in parameters["padding_config"]]
    padded[tuple(slice(low, low + size) for low, size in zip(lows, array.shape, strict=True))] = array
    return [padded]


@no_type_check
def _window(inputs: list[np.ndarray], shape: tuple[int, ...], sizes: Sequence[Any]) -> tuple[slice, ...] | None:
    """Position of a dynamic slice, if known."""
    starts = [each[()] for each in inputs]
    if any(isinstance(each, Node) for each in starts):
        return None
    first = [min(max(int(at), 0), whole - size) for at, whole, size in zip(starts, shape, sizes, strict=True)]
    return tuple(slice(at, at + size) for at, size in zip(first, sizes, strict=True))


@no_type_check
def _dynamic_slice(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
    window = _window(inputs[1:], inputs[0].shape, parameters["slice_sizes"])
    return None if window is None else [inputs[0][window]]


@no_type_check
def _dynamic_update_slice(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
    array, update, *starts = inputs
    if (window := _window(starts, array.shape, update.shape)) is None:
        return None
    array = array.copy()
    array[window] = update
    return [array]


@no_type_check
def _places(
    shape: tuple[int, ...], indices: np.ndarray, sizes: Sequence[Any], numbers: lax.GatherDimensionNumbers, mode: Any
) -> np.ndarray:
    """Flat indices that a gather reads or a scatter writes in an array, -1 if out of bounds."""
    batch, flat = indices.shape[:-1], np.arange(math.prod(shape)).reshape(shape)
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    kept = [size for dim, size in enumerate(sizes) if dim not in dropped]
    found = np.empty((*batch, *kept), np.int64)
    for at in np.ndindex(*batch):
        start = np.zeros(len(shape), int)
        start[list(numbers.start_index_map)] = indices[at].astype(int)
        start[list(numbers.operand_batching_dims)] = [at[dim] for dim in numbers.start_indices_batching_dims]
        last = np.array(shape) - sizes
        start = np.clip(start, 0, last) if mode == lax.GatherScatterMode.CLIP else start
        inside = np.all((start >= 0) & (start <= last))
        window = tuple(slice(low, low + size) for low, size in zip(start, sizes, strict=True))
        found[at] = flat[window].reshape(kept) if inside else -1
    return np.moveaxis(found, range(len(batch), found.ndim), numbers.offset_dims)


@no_type_check
def _gather(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
    """Gather by constant indices, or by a single unknown one: a selection among its values."""
    array, indices = inputs
    unknown = {each.number: each for each in indices.flat if isinstance(each, Node)}
    if len(unknown) > 1:
        return None
    fill = parameters["fill_value"]
    if fill is None:
        fill = (
            np.nan if np.issubdtype(aval.dtype, np.inexact) else np.iinfo(aval.dtype).min if aval.dtype != bool else 1
        )
    pool = np.append(array.reshape(-1), constants(np.asarray(fill, aval.dtype)))

    def picked(value: int) -> np.ndarray:
        known = filled(indices.shape, (value if isinstance(each, Node) else each for each in indices.flat))
        given = parameters["slice_sizes"], parameters["dimension_numbers"], parameters["mode"]
        return pool[_places(array.shape, known, *given)]

    if not unknown:
        return [picked(0)]
    (index,) = unknown.values()
    result = picked(-1)  # out of bounds, or clipped
    for value in range(max(array.shape, default=0)):
        here = graph.scalar(lax.eq_p, (index, index.dtype.type(value)), np.dtype(bool))
        result = graph.elementwise(lax.select_n_p, [filled((), [here]), result, picked(value)], aval)
    return [result]


@no_type_check
def _scatter(combine: Any) -> Rule:
    def rule(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
        array, indices, updates = inputs
        if any(isinstance(each, Node) for each in indices.flat):
            return None
        given = parameters["dimension_numbers"]
        numbers = lax.GatherDimensionNumbers(
            given.update_window_dims,
            given.inserted_window_dims,
            given.scatter_dims_to_operand_dims,
            given.operand_batching_dims,
            given.scatter_indices_batching_dims,
        )
        windows = iter(updates.shape[dim] for dim in numbers.offset_dims)
        dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
        sizes = [1 if dim in dropped else next(windows) for dim in range(array.ndim)]
        places = _places(array.shape, indices, sizes, numbers, parameters["mode"])
        result = array.reshape(-1).copy()
        for place, update in zip(places.flat, updates.flat, strict=True):
            if place >= 0:
                both = (result[place], update)
                result[place] = update if combine is None else graph.scalar(combine, both, aval.dtype)
        return [result.reshape(array.shape)]

    return rule


@no_type_check
def _reduction(combine: Any) -> Rule:
    def rule(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays | None:
        (array,), axes = inputs, parameters["axes"]
        if not array.size and combine is not lax.add_p:
            return None
        sizes = [array.shape[axis] for axis in axes]
        rows = np.moveaxis(array, axes, range(-len(axes), 0)).reshape(*aval.shape, math.prod(sizes))
        return [graph.reduced(combine, rows, aval)]

    return rule


@no_type_check
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


@no_type_check
def _cumsum(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Parameters) -> Arrays:
    result = inputs[0].copy()
    rows = np.moveaxis(np.flip(result, parameters["axis"]) if parameters["reverse"] else result, parameters["axis"], 0)
    for before, row in itertools.pairwise(rows.reshape(len(rows), -1)):
        row[:] = [graph.scalar(lax.add_p, each, aval.dtype) for each in zip(before, row, strict=True)]
    return [result]


@no_type_check
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


RULES: Final[dict[str, Rule]] = {
    **dict.fromkeys(("squeeze", "reshape", "expand_dims"), lambda _, inputs, aval, __: [inputs[0].reshape(aval.shape)]),
    "argmax": _place_of_extreme(lax.gt_p),
    "argmin": _place_of_extreme(lax.lt_p),
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda _, inputs, __, parameters: [np.concatenate(inputs, parameters["dimension"])],
    "cumsum": _cumsum,
    "dot_general": _dot,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "iota": lambda _, __, aval, parameters: [
        constants(np.indices(aval.shape)[parameters["dimension"]].astype(aval.dtype))
    ],
    "pad": _pad,
    "reduce_and": _reduction(lax.and_p),
    "reduce_max": _reduction(lax.max_p),
    "reduce_min": _reduction(lax.min_p),
    "reduce_or": _reduction(lax.or_p),
    "reduce_sum": _reduction(lax.add_p),
    "rev": lambda _, inputs, __, parameters: [np.flip(inputs[0], parameters["dimensions"])],
    "scatter": _scatter(None),
    "scatter-add": _scatter(lax.add_p),
    "slice": _slice,
    "stack": lambda _, inputs, __, parameters: [np.stack(inputs, parameters["axis"])],
    "tile": lambda _, inputs, __, parameters: [np.tile(inputs[0], parameters["reps"])],
    "transpose": lambda _, inputs, __, parameters: [inputs[0].transpose(parameters["permutation"])],
}
