"""Rules for operations that read or write at indices, known ones or computed.

A computed index becomes a selection among its possible values: one case each, as `rules` describes rules.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from jax import lax

from mjx_study.graph.nodes import Node, ScalarGraph, filled

Arrays = list[np.ndarray]
FEWEST_ROWS: Final = 64
"""Number of possible values of a computed index from which a constant array is a table in memory."""


def _cases(graph: ScalarGraph, index: Sequence[Any], last: Sequence[Any]) -> Iterator[tuple[list[int], Any]]:
    """Possible values from 0 to `last` of a vector of indices, and the condition that it has them."""
    spans = [range(most + 1) if isinstance(at, Node) else (int(at),) for at, most in zip(index, last, strict=True)]
    for values in itertools.product(*spans):
        here = np.bool_(True)
        for at, value in zip(index, values, strict=True):
            if isinstance(at, Node):
                equal = graph.scalar(lax.eq_p, (at, at.dtype.type(value)), np.dtype(bool))
                here = graph.scalar(lax.and_p, (here, equal), np.dtype(bool))
        yield list(values), here


def _clipped(graph: ScalarGraph, index: Sequence[Any], last: Sequence[Any]) -> list[Any]:
    low = [graph.scalar(lax.max_p, (at, at.dtype.type(0)), at.dtype) for at in index]
    return [graph.scalar(lax.min_p, (at, at.dtype.type(most)), at.dtype) for at, most in zip(low, last, strict=True)]


def _selected(graph: ScalarGraph, here: Any, yes: np.ndarray, no: np.ndarray, aval: Any) -> np.ndarray:
    return graph.elementwise(lax.select_n_p, [filled((), [here]), no, yes], aval.update(shape=yes.shape))


def _dynamic_slice(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    array, *starts = inputs
    last = [whole - size for whole, size in zip(array.shape, aval.shape, strict=True)]
    result = array[_window([0] * array.ndim, aval.shape)]
    index = _clipped(graph, [each[()] for each in starts], last)
    if (found := _in_memory(graph, array, aval, index, last)) is not None:
        return [found]
    if (found := _looked_up(graph, _table(array), index, last, aval.shape)) is not None:
        return [found.reshape(aval.shape)]
    for first, here in _cases(graph, index, last):
        result = _selected(graph, here, array[_window(first, aval.shape)], result, aval)
    return [result]


def _in_memory(
    graph: ScalarGraph, array: np.ndarray, aval: Any, index: Sequence[Any], last: Sequence[Any]
) -> np.ndarray | None:
    """Slice of an array in memory, with one computed index; None if it is not."""
    computed = [dim for dim, at in enumerate(index) if isinstance(at, Node)]
    if not graph.arrays or len(computed) != 1:
        return None
    (dim,) = computed
    starts = [0 if at is index[dim] else int(at) for at in index]
    cases = [
        array[_window([value if at == dim else start for at, start in enumerate(starts)], aval.shape)].flat
        for value in range(last[dim] + 1)
    ]
    found = [graph.entry(index[dim], each) for each in zip(*cases, strict=True)]
    return None if any(each is None for each in found) else filled(aval.shape, found)


def _table(array: np.ndarray) -> np.ndarray | None:
    """An array as numbers; None if it is not constant, small, or of truth values."""
    if array.size < FEWEST_ROWS or any(isinstance(each, Node) or each.dtype == bool for each in array.flat):
        return None
    return np.array(array.tolist(), array.flat[0].dtype)


def _looked_up(
    graph: ScalarGraph, table: np.ndarray | None, start: Sequence[Any], last: Sequence[Any], sizes: Sequence[int]
) -> np.ndarray | None:
    """Entries of a window that starts within bounds in a table, flat; None if it has few possible places."""
    computed = [at for at in start if isinstance(at, Node)]
    cases = math.prod(most + 1 for at, most in zip(start, last, strict=True) if isinstance(at, Node))
    if table is None or not computed or cases < FEWEST_ROWS:
        return None
    kind, flat = computed[0].dtype, np.arange(table.size).reshape(table.shape)
    add = lambda one, other: graph.scalar(lax.add_p, (one, kind.type(other)), kind)  # noqa: E731
    first = kind.type(0)
    for at, size in zip(start, table.shape, strict=True):
        scaled = graph.scalar(lax.mul_p, (first, kind.type(size)), kind)
        first = graph.scalar(lax.add_p, (scaled, at if isinstance(at, Node) else kind.type(at)), kind)
    places = [add(first, offset) for offset in flat[_window([0] * flat.ndim, sizes)].flat]
    return filled((len(places),), [graph.looked_up(table, each) for each in places])


def _dynamic_update_slice(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    array, update, *starts = inputs
    last = [whole - size for whole, size in zip(array.shape, update.shape, strict=True)]
    result = array.copy()
    for first, here in _cases(graph, _clipped(graph, [each[()] for each in starts], last), last):
        window = _window(first, update.shape)
        result[window] = _selected(graph, here, update, result[window], aval)
    return [result]


def _window(first: Any, sizes: Any) -> tuple[slice, ...]:
    return tuple(slice(at, at + size) for at, size in zip(first, sizes, strict=True))


class _Windows:
    """Where a gather reads or a scatter writes in an array of a shape."""

    def __init__(self, graph: ScalarGraph, shape: Sequence[int], sizes: Sequence[int], numbers: Any, clip: bool):
        self._graph, self._sizes, self._numbers, self._clip = graph, sizes, numbers, clip
        self._flat, self._last = np.arange(math.prod(shape)).reshape(shape), np.array(shape) - sizes
        dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
        self.kept = [size for dim, size in enumerate(sizes) if dim not in dropped]

    def cases(self, indices: np.ndarray, at: tuple[int, ...]) -> Iterator[tuple[np.ndarray | None, Any]]:
        """Places of the window's entries for one vector of indices, None out of bounds, and each case's condition; both
        flat."""
        numbers = self._numbers
        index, last = list(indices[at]), [self._last[dim] for dim in numbers.start_index_map]
        index = _clipped(self._graph, index, last) if self._clip else index
        for values, here in _cases(self._graph, index, last):
            start = np.zeros(self._flat.ndim, int)
            start[list(numbers.start_index_map)] = values
            start[list(numbers.operand_batching_dims)] = [at[dim] for dim in numbers.start_indices_batching_dims]
            inside = np.all((start >= 0) & (start <= self._last))
            yield self._flat[_window(start, self._sizes)].reshape(-1) if inside else None, here

    def looked_up(self, table: np.ndarray | None, indices: np.ndarray, at: tuple[int, ...]) -> tuple[Any, Any]:
        """The window's entries for one vector of indices by `_looked_up`, and whether it is within bounds."""
        numbers, last = self._numbers, [self._last[dim] for dim in self._numbers.start_index_map]
        given = indices[at]
        kept, inside, start = _clipped(self._graph, given, last), np.bool_(True), [0] * self._flat.ndim
        for dim, batched in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
            start[dim] = at[batched]
        for dim, index, within in zip(numbers.start_index_map, given, kept, strict=True):
            start[dim] = within
            if not self._clip:
                same = self._graph.scalar(lax.eq_p, (index, within), np.dtype(bool))
                inside = self._graph.scalar(lax.and_p, (inside, same), np.dtype(bool))
        return _looked_up(self._graph, table, start, self._last.tolist(), self._sizes), inside


def _gather(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    array, indices = inputs
    numbers, fill = parameters["dimension_numbers"], parameters["fill_value"]
    if fill is None:
        fill = (
            np.nan if np.issubdtype(aval.dtype, np.inexact) else np.iinfo(aval.dtype).min if aval.dtype != bool else 1
        )
    clip = parameters["mode"] != lax.GatherScatterMode.FILL_OR_DROP  # XLA also clips what is promised to be in bounds
    windows = _Windows(graph, array.shape, parameters["slice_sizes"], numbers, clip)
    outside = filled(
        (math.prod(windows.kept),), itertools.repeat(np.asarray(fill, aval.dtype)[()], math.prod(windows.kept))
    )
    batch, pool = indices.shape[:-1], array.reshape(-1)
    found = np.empty((*batch, len(outside)), object)
    table = _table(array)
    for at in np.ndindex(*batch):
        row = outside
        entries, inside = windows.looked_up(table, indices, at)
        if entries is not None:
            found[at] = _selected(graph, inside, entries, row, aval)
            continue
        for places, here in windows.cases(indices, at):
            row = row if places is None else _selected(graph, here, pool[places], row, aval)
        found[at] = row
    found = found.reshape((*batch, *windows.kept))
    return [np.moveaxis(found, range(len(batch), found.ndim), numbers.offset_dims)]


def _scatter(combine: Any) -> Any:
    def rule(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
        array, indices, updates = inputs
        given = parameters["dimension_numbers"]
        numbers = lax.GatherDimensionNumbers(
            given.update_window_dims,
            given.inserted_window_dims,
            given.scatter_dims_to_operand_dims,
            given.operand_batching_dims,
            given.scatter_indices_batching_dims,
        )
        sizes = iter(updates.shape[dim] for dim in numbers.offset_dims)
        dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
        sizes = [1 if dim in dropped else next(sizes) for dim in range(array.ndim)]
        windows = _Windows(graph, array.shape, sizes, numbers, parameters["mode"] == lax.GatherScatterMode.CLIP)
        batch = indices.shape[:-1]
        moved = np.moveaxis(updates, numbers.offset_dims, range(len(batch), updates.ndim))
        rows = moved.reshape(*batch, math.prod(windows.kept))
        result = array.reshape(-1).copy()
        for at in np.ndindex(*batch):
            for places, here in windows.cases(indices, at):
                if places is not None:
                    old, new = result[places], rows[at]
                    if combine is not None:
                        new = graph.elementwise(combine, [old, new], aval.update(shape=new.shape))
                    result[places] = _selected(graph, here, new, old, aval)
        return [result.reshape(array.shape)]

    return rule


INDEXING: Final = {
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    "scatter": _scatter(None),
    "scatter-add": _scatter(lax.add_p),
    "scatter-max": _scatter(lax.max_p),
    "scatter-min": _scatter(lax.min_p),
    "scatter-mul": _scatter(lax.mul_p),
}
