"""Rules for operations that read or write at indices, known ones or computed.

A computed index becomes a selection among its possible values: one case each, as `rules` describes rules.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from jax import lax

from mjx_study.graph.nodes import Node, ScalarGraph, constants, filled

Arrays = list[np.ndarray]
FEWEST_ROWS: Final = 64
"""Number of possible values of a computed index from which a constant array is a table in memory."""


def _selected(graph: ScalarGraph, here: Any, yes: np.ndarray, no: np.ndarray, aval: Any) -> np.ndarray:
    return graph.elementwise(lax.select_n_p, [filled((), [here]), no, yes], aval.update(shape=yes.shape))


def _table(array: np.ndarray) -> np.ndarray | None:
    """An array as numbers; None if it is not constant, small, or of truth values."""
    if array.size < FEWEST_ROWS or any(isinstance(each, Node) or each.dtype == bool for each in array.flat):
        return None
    return np.array(array.tolist(), array.flat[0].dtype)


def _window(first: Any, sizes: Any) -> tuple[slice, ...]:
    return tuple(slice(at, at + size) for at, size in zip(first, sizes, strict=True))


class _Windows:
    """Where a gather reads or a scatter writes in an array of a shape, for vectors of `indices` at places `at`."""

    def __init__(
        self, graph: ScalarGraph, shape: Sequence[int], sizes: Sequence[int], numbers: Any, indices: Any, clip: bool
    ):
        if indices.size and indices.flat[0].dtype.itemsize < 4:  # places are computed in the indices' type
            indices = filled(indices.shape, [graph.converted(each, np.dtype(np.int32)) for each in indices.flat])
        self._graph, self._sizes, self._numbers, self._indices, self._clip = graph, sizes, numbers, indices, clip
        self._flat = np.arange(math.prod(shape)).reshape(shape)
        self._last = [whole - size for whole, size in zip(shape, sizes, strict=True)]
        self._most = [self._last[dim] for dim in numbers.start_index_map]
        dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
        self.kept = [size for dim, size in enumerate(sizes) if dim not in dropped]

    def index(self, at: tuple[int, ...]) -> list[Any]:
        """A vector of indices, within bounds if it is to be clipped."""
        return self._clipped(at) if self._clip else list(self._indices[at])

    def cases(self, at: tuple[int, ...]) -> Iterator[tuple[tuple[int, ...], np.ndarray]]:
        """Possible values of a vector of indices, and the places of the window's entries, flat; none out of bounds."""
        index = zip(self.index(at), self._most, strict=True)
        for values in itertools.product(*(range(most + 1) if isinstance(i, Node) else (int(i),) for i, most in index)):
            start = self._start(values, at)
            if all(0 <= first <= last for first, last in zip(start, self._last, strict=True)):
                yield values, self._flat[_window(start, self._sizes)].reshape(-1)

    def selected(self, at: tuple[int, ...], values: Sequence[int], yes: np.ndarray, no: np.ndarray, aval: Any) -> Any:
        """Entries `yes` where a vector of indices has these values, else `no`."""
        here = np.bool_(True)
        for index, value in zip(self.index(at), values, strict=True):
            if isinstance(index, Node):
                equal = self._graph.scalar(lax.eq_p, (index, index.dtype.type(value)), np.dtype(bool))
                here = self._graph.scalar(lax.and_p, (here, equal), np.dtype(bool))
        return _selected(self._graph, here, yes, no, aval)

    def in_memory(self, at: tuple[int, ...], pool: np.ndarray) -> np.ndarray | None:
        """The window's entries of an array in memory, with one computed index within bounds; None if it is not."""
        computed = [each for each in self.index(at) if isinstance(each, Node)]
        if not (self._graph.arrays and self._clip and len(computed) == 1):
            return None
        cases = np.array([places for _, places in self.cases(at)])
        found = [self._graph.entry(computed[0], each) for each in pool[cases].T]
        return None if any(each is None for each in found) else filled((len(found),), found)

    def looked_up(self, at: tuple[int, ...], table: np.ndarray | None, outside: Any, aval: Any) -> np.ndarray | None:
        """The window's entries of a table, `outside` out of bounds; None if few places are possible."""
        graph, given, within = self._graph, self._indices[at], self._clipped(at)
        computed = [
            (each.dtype, most + 1) for each, most in zip(given, self._most, strict=True) if isinstance(each, Node)
        ]
        if table is None or math.prod(count for _, count in computed) < FEWEST_ROWS:
            return None
        kind, inside = computed[0][0], np.bool_(True)
        first = kind.type(0)
        for each, size in zip(self._start(within, at), table.shape, strict=True):
            scaled = graph.scalar(lax.mul_p, (first, kind.type(size)), kind)
            first = graph.scalar(lax.add_p, (scaled, each if isinstance(each, Node) else kind.type(each)), kind)
        offsets = self._flat[_window([0] * self._flat.ndim, self._sizes)].flat
        places = [graph.scalar(lax.add_p, (first, kind.type(each)), kind) for each in offsets]
        entries = filled((len(places),), [graph.looked_up(table, each) for each in places])
        for each, kept in () if self._clip else zip(given, within, strict=True):
            same = graph.scalar(lax.eq_p, (each, kept), np.dtype(bool))
            inside = graph.scalar(lax.and_p, (inside, same), np.dtype(bool))
        return _selected(graph, inside, entries, outside, aval)

    def _clipped(self, at: tuple[int, ...]) -> list[Any]:
        found = []
        for index, most in zip(self._indices[at], self._most, strict=True):
            low = self._graph.scalar(lax.max_p, (index, index.dtype.type(0)), index.dtype)
            found.append(self._graph.scalar(lax.min_p, (low, index.dtype.type(most)), index.dtype))
        return found

    def _start(self, index: Sequence[Any], at: tuple[int, ...]) -> list[Any]:
        """First entry of a window along each dimension."""
        numbers, start = self._numbers, [0] * self._flat.ndim
        for dim, first in zip(numbers.start_index_map, index, strict=True):
            start[dim] = first
        for dim, batched in zip(numbers.operand_batching_dims, numbers.start_indices_batching_dims, strict=True):
            start[dim] = at[batched]
        return start


def _gather(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    array, indices = inputs
    numbers, fill = parameters["dimension_numbers"], parameters["fill_value"]
    if fill is None:
        inexact = np.issubdtype(aval.dtype, np.inexact)
        fill = np.nan if inexact else np.iinfo(aval.dtype).min if aval.dtype != bool else 1
    clip = parameters["mode"] != lax.GatherScatterMode.FILL_OR_DROP  # XLA also clips what is promised to be in bounds
    windows = _Windows(graph, array.shape, parameters["slice_sizes"], numbers, indices, clip)
    outside = constants(np.full(math.prod(windows.kept), fill, aval.dtype))
    batch, pool, table = indices.shape[:-1], array.reshape(-1), _table(array)
    found = np.empty((*batch, len(outside)), object)
    for at in np.ndindex(*batch):
        row = windows.looked_up(at, table, outside, aval)
        row = windows.in_memory(at, pool) if row is None else row
        if row is None:
            row = outside
            for number, (values, places) in enumerate(windows.cases(at)):
                first = clip and not number  # what is clipped has one of the values
                row = pool[places] if first else windows.selected(at, values, pool[places], row, aval)
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
        clip = parameters["mode"] == lax.GatherScatterMode.CLIP
        windows = _Windows(graph, array.shape, sizes, numbers, indices, clip)
        batch = indices.shape[:-1]
        moved = np.moveaxis(updates, numbers.offset_dims, range(len(batch), updates.ndim))
        rows = moved.reshape(*batch, math.prod(windows.kept))
        result = array.reshape(-1).copy()
        for at in np.ndindex(*batch):
            for values, places in windows.cases(at):
                old, new = result[places], rows[at]
                if combine is not None:
                    new = graph.elementwise(combine, [old, new], aval.update(shape=new.shape))
                result[places] = windows.selected(at, values, new, old, aval)
        return [result.reshape(array.shape)]

    return rule


def _dynamic_slice(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    array, *starts = inputs
    axes = tuple(range(array.ndim))
    as_gather = {
        "dimension_numbers": lax.GatherDimensionNumbers(axes, (), axes),
        "slice_sizes": aval.shape,
        "mode": lax.GatherScatterMode.CLIP,
        "fill_value": None,
    }
    return _gather(graph, [array, np.stack(starts)], aval, as_gather)


def _dynamic_update_slice(graph: ScalarGraph, inputs: Arrays, aval: Any, parameters: Any) -> Arrays:
    array, update, *starts = inputs
    axes = tuple(range(array.ndim))
    numbers = lax.ScatterDimensionNumbers(axes, (), axes)
    as_scatter = {"dimension_numbers": numbers, "mode": lax.GatherScatterMode.CLIP}
    return _scatter(None)(graph, [array, np.stack(starts), update], aval, as_scatter)


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
