"""One table of the scalar functions, each at a generic point with a generic noise level."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from mjx_study.reference import (
    BallWall,
    Heaviside,
    MomentumTransfer,
    RelaxedHeaviside,
    Smoothed,
)


@dataclasses.dataclass(frozen=True, eq=False)
class Quadratic:
    """x^T A x / 2 + b^T x, with its smoothing by noise of any density in closed form."""

    matrix: np.ndarray
    linear: np.ndarray

    @property
    def num_params(self) -> int:
        return len(self.linear)

    def value(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(np.einsum("...i,ij,...j->...", x, self.matrix, x) / 2 + x @ self.linear)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        return x @ self.matrix + self.linear

    def smoothed(self, theta: np.ndarray, sigma: float) -> Smoothed:
        value = float(self.value(theta) + sigma**2 * np.trace(self.matrix) / 2)
        return Smoothed(value, self.gradient(theta), np.zeros(self.num_params))


class Square:
    """x^2 as a scalar function."""

    num_params, period = 1, np.inf

    def value(self, x: np.ndarray) -> np.ndarray:
        return x[..., 0] ** 2

    def gradient(self, x: np.ndarray) -> np.ndarray:
        return 2 * x

    def jumps(self) -> tuple[()]:
        return ()

    def breakpoints(self) -> tuple[()]:
        return ()


class FunctionCase(NamedTuple):
    """A function, scalar but for the quadratic, theta and sigma."""

    function: Any
    theta: np.ndarray
    sigma: float


FUNCTIONS = {
    "heaviside": FunctionCase(Heaviside(), np.array([0.3]), 0.6),
    "relaxed_heaviside": FunctionCase(RelaxedHeaviside(0.2), np.array([0.3]), 0.6),
    "ball_wall": FunctionCase(BallWall(), np.array([0.65]), 0.1),
    "ball_wall, far": FunctionCase(BallWall(distance=0.2), np.array([0.65]), 0.1),
    "ball_wall, high": FunctionCase(BallWall(height=0.05), np.array([0.4]), 0.1),
    "momentum_transfer": FunctionCase(MomentumTransfer(), np.array([0.75]), 0.1),
    "momentum_transfer, heavy ball": FunctionCase(
        MomentumTransfer(edge=1.0, restitution=0.6, inertia_ratio=0.3), np.array([-0.9]), 0.2
    ),
}
QUADRATIC = FunctionCase(
    Quadratic(np.array([[1.0, 0.4, 0.0], [0.4, -0.5, 0.3], [0.0, 0.3, 0.8]]), np.array([0.3, -1.0, 0.5])),
    np.array([1.5, -2.0, 1.0]),
    0.7,
)
JUMPING = ("heaviside", "ball_wall", "momentum_transfer", "momentum_transfer, heavy ball")
