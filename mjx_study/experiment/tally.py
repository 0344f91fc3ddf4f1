"""Diagnostics of a batch's rollouts: computing time, solver residuals and onsets of contact."""

import dataclasses
from collections.abc import Iterable
from functools import reduce
from typing import Any, Final

import numpy as np
from jaxtyping import Float

from mjx_study.runtime import precision

MOST_RESIDUAL: Final = {"float64": 1e-6, "float32": 1e-3}
"""Relative solver residual above which a sample is reported as unconverged."""


@dataclasses.dataclass(frozen=True)
class Tally:
    """Diagnostics of a batch's rollouts, or of a part of them."""

    seconds: np.ndarray  # computing time
    residual: np.ndarray  # the largest
    unconverged: np.ndarray  # number of rollouts
    onsets: Float[np.ndarray, " nine"]  # see `_met`

    @classmethod
    def of(cls, batch: Any, seconds: float, residuals: np.ndarray) -> "Tally":
        """Summarise a batch, given the residual of each of its rollouts."""
        largest = np.max(np.where(np.isfinite(residuals), residuals, np.inf), initial=0.0)
        events = getattr(batch, "events", None)
        onsets = _met(np.zeros((0, 6)) if events is None else np.asarray(events, float).reshape(-1, 6))
        return cls(np.array(seconds), np.asarray(largest), np.array(unconverged(residuals, precision())), onsets)

    @property
    def parts(self) -> int:
        """Number of parts of a sample; 1, as of the moments of one batch."""
        return 1

    def check(self) -> None:
        """Raise ValueError unless the arrays have their shapes, as those of a file may not."""
        shapes = {"seconds": (), "residual": (), "unconverged": (), "onsets": (9,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape or getattr(self, name).dtype.kind not in "fiu":
                raise ValueError(f"{name} has shape {getattr(self, name).shape}")

    def merged(self, other: "Tally") -> "Tally":
        """Combine with the tally of other rollouts."""
        return Tally(
            np.asarray(self.seconds + other.seconds),
            np.asarray(np.maximum(self.residual, other.residual)),
            np.asarray(self.unconverged + other.unconverged),
            _of_both(self.onsets, other.onsets),
        )


def together(tallies: Iterable[Tally]) -> Tally:
    return reduce(Tally.merged, tallies)


def _met(events: Float[np.ndarray, "rollouts six"]) -> Float[np.ndarray, " nine"]:
    """Number of rollouts, and of those with an onset that has a term; sums of the three counts; of the latter the sum
    of the squared strength, and mean and summed squared deviation of the first onset's step. Last, replaced points."""
    met, begun = events[events[:, 0] > 0], events[np.isfinite(events[:, 4])]  # none begins where all are missed
    first = begun[:, 4]
    mean = np.mean(first) if len(begun) else 0.0
    sums, squares = np.sum(met[:, :3], axis=0), np.sum(begun[:, 3] ** 2)
    deviations = np.sum((first - mean) ** 2)
    return np.array([len(events), len(begun), *sums, squares, mean, deviations, np.sum(events[:, 5])])


def _of_both(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    share, gap = other[1] / max(one[1] + other[1], 1.0), other[6] - one[6]
    both = one + other
    both[6], both[7] = one[6] + share * gap, both[7] + one[1] * share * gap**2
    return both


def onset_numbers(events: np.ndarray) -> np.ndarray:
    """`ONSETS` from each rollout's `OnsetCounts`."""
    return numbers_of(_met(events))


def numbers_of(onsets: np.ndarray) -> np.ndarray:
    """`ONSETS` from a tally's sums; NaN without an onset term."""
    rollouts, met, *counts, squares, _, spread, replaced = onsets
    if rollouts == 0:
        return np.full(6, np.nan)
    return np.array([*counts, *(np.sqrt(each / met) if met else np.nan for each in (squares, spread)), replaced])


def unconverged(residuals: np.ndarray, precision: str) -> int:
    """Number of residuals that are too large or nonfinite."""
    return int(np.sum(~(residuals <= MOST_RESIDUAL[precision])))
