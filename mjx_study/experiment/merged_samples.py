"""Batches computed in blocks of samples, whose summaries are merged pairwise in an order fixed by their indices.

Blocks are the leaves of a binary tree. Two neighbours are merged as soon as both are available, whatever else is
missing, so the result does not depend on the order in which blocks finish, and each late block leaves at most
logarithmically many summaries unmerged.
"""

from collections.abc import Callable, Collection, Mapping
from functools import reduce
from typing import Any, Final

import numpy as np

from estimators import ORACLES
from estimators.merged_samples import Moments
from mjx_study.experiment.study import Arrays
from mjx_study.experiment.tally import Tally

REFERENCE_UNIT: Final = 0
"""Work unit that computes the reference's samples; the others are blocks, seed by seed."""
Summary = dict[str, Any]
"""Summary of a block: moments of each estimator's parts by "ESTIMATOR.PART", and tallies by oracle."""


class Blocks:
    """The blocks of a cell's batches as work units, with the summaries of the finished ones.

    Attributes:
        reference: samples of the reference gradient, (pairs, params); None until they are computed.
    """

    def __init__(
        self,
        seeds: int,
        blocks: int,
        kept: Mapping[str, np.ndarray],
        merge: Callable[["Blocks"], Arrays] = lambda blocks: {},
    ):
        """Take so many blocks per seed, those of a checkpoint (see `arrays`), and what computes the cell's numbers."""
        self.seeds, self.blocks, self._merge = seeds, blocks, merge
        self.units = 1 + seeds * blocks
        self.reference = kept.get("reference")
        packed: dict[tuple[int, int, int], Arrays] = {}
        for name, array in kept.items():
            if name != "reference":
                seed, level, index, rest = name.split(".", 3)
                packed.setdefault((int(seed), int(level), int(index)), {})[rest] = array
        self._held = {node: unpack(arrays) for node, arrays in packed.items()}

    def check(self, estimators: Collection[str], oracles: Collection[str], params: int) -> None:
        """Raise ValueError unless the finished blocks are some of these, each a summary of all estimators and oracles,
        and of so many parameters."""
        done = np.zeros((self.seeds, self.blocks), int)
        first = {name: each.parts for name, each in next(iter(self._held.values()), {}).items()}
        for (seed, level, index), summary in self._held.items():
            if not (0 <= seed < self.seeds and 0 <= level < 64 and 0 <= index << level < self.blocks):
                raise ValueError(f"it has a block {seed}.{level}.{index}")
            done[seed, index << level : (index + 1) << level] += 1
            names = {name.partition(".")[0] for name in summary}
            if names != {*estimators, *oracles}:
                raise ValueError(f"block {seed}.{level}.{index} is of {', '.join(sorted(names))}")
            for each in summary.values():
                each.check(params) if isinstance(each, Moments) else each.check()
            if {name: each.parts for name, each in summary.items()} != first:
                raise ValueError("its blocks differ in their parts")
        if np.any(done > 1):
            raise ValueError("it has a block twice")
        if self.reference is not None and (self.reference.ndim != 2 or self.reference.shape[1] != params):
            raise ValueError(f"its reference has shape {self.reference.shape}")

    @property
    def missing(self) -> list[int]:
        """Unfinished units, in order."""
        done = np.zeros((self.seeds, self.blocks), bool)
        for seed, level, index in self._held:
            done[seed, index << level : (index + 1) << level] = True
        return [REFERENCE_UNIT] * (self.reference is None) + (1 + np.flatnonzero(~done)).tolist()

    def add(self, unit: int, arrays: Arrays) -> None:
        """Add what a unit found."""
        if unit == REFERENCE_UNIT:
            self.reference = arrays["reference"]
            return
        (seed, index), level, summary = divmod(unit - 1, self.blocks), 0, unpack(arrays)
        while (other := self._held.pop((seed, level, index ^ 1), None)) is not None:
            summary = _merged(other, summary) if index % 2 else _merged(summary, other)
            level, index = level + 1, index // 2
        self._held[seed, level, index] = summary

    def arrays(self) -> Arrays:
        """The checkpoint of the finished units."""
        kept = {} if self.reference is None else {"reference": self.reference}
        for (seed, level, index), summary in self._held.items():
            kept |= {f"{seed}.{level}.{index}.{name}": array for name, array in pack(summary).items()}
        return kept

    def numbers(self) -> Arrays:
        """The cell's numbers, once no unit is missing."""
        return self._merge(self)

    def whole(self, seed: int) -> Summary:
        """Summary of all blocks of a seed, which must be complete."""
        nodes = sorted((index << level, summary) for (at, level, index), summary in self._held.items() if at == seed)
        return reduce(_merged, (summary for _, summary in nodes))


def _merged(one: Summary, other: Summary) -> Summary:
    return {name: each.merged(other[name]) for name, each in one.items()}


def pack(summary: Summary) -> Arrays:
    """Flatten a summary into arrays."""
    return {
        f"{name}.{field}": np.asarray(array) for name, each in summary.items() for field, array in vars(each).items()
    }


def unpack(arrays: Mapping[str, np.ndarray]) -> Summary:
    """Invert `pack`."""
    fields: dict[str, Arrays] = {}
    for name, array in arrays.items():
        of, _, field = name.rpartition(".")
        fields.setdefault(of, {})[field] = array
    return {of: (Tally if of in ORACLES else Moments)(**each) for of, each in fields.items()}
