"""A quadratic function, the benchmark on which every unbiased estimator must agree."""

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_study.reference.function import Smoothed


@dataclasses.dataclass(frozen=True, eq=False)
class Quadratic:
    """x^T A x / 2 + b^T x + c.

    Attributes:
        matrix: A, (params, params), symmetric.
        linear: b.
        offset: c.
    """

    matrix: Float[np.ndarray, "..."]
    linear: Float[np.ndarray, " params"]
    offset: float = 0.0
    any_noise: bool = dataclasses.field(default=True, init=False)

    def __post_init__(self) -> None:
        size = len(self.linear)
        if self.matrix.shape != (size, size) or not np.array_equal(self.matrix, self.matrix.T):
            raise ValueError(f"matrix must be symmetric of shape ({size}, {size}), to match linear; got {self.matrix}")

    @property
    def num_params(self) -> int:
        return len(self.linear)

    def value(self, x: Float[np.ndarray, "*batch params"]) -> Float[np.ndarray, "*batch"]:
        return np.asarray(np.einsum("...i,ij,...j->...", x, self.matrix, x) / 2 + x @ self.linear + self.offset)

    def gradient(self, x: Float[np.ndarray, "*batch params"]) -> Float[np.ndarray, "*batch params"]:
        return x @ self.matrix + self.linear

    def smoothed(self, theta: Float[np.ndarray, " params"], sigma: float) -> Smoothed:
        """F = f + sigma^2 tr A / 2, grad F = grad f."""
        value = float(self.value(theta)) + sigma**2 * np.trace(self.matrix) / 2
        return Smoothed(float(value), self.gradient(theta), np.zeros(self.num_params))
