r"""Scalar functions of a few parameters with jumps and kinks, and what Gaussian noise makes of them.

    F(theta) = E f(theta + w),   w ~ N(0, sigma^2 I)

In one dimension, with jumps f(t_j+) - f(t_j-) and the standard normal density phi,

    grad F = E f'(theta + w) + sum_j [f(t_j+) - f(t_j-)] phi((t_j - theta) / sigma) / sigma,

so the sum, the jump term, is exactly what a first-order estimate misses: E[FoBG] = grad F - jump term.
"""

import dataclasses
import math
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from scipy.integrate import quad_vec

TAIL: Final = 12.0
"""Standard deviations that quadrature covers on either side; the density beyond is below 1e-31."""


@dataclasses.dataclass(frozen=True)
class Jump:
    """A discontinuity: where, and f just above it minus f just below."""

    position: float
    size: float


@dataclasses.dataclass(frozen=True)
class Smoothed:
    """F at a point, its gradient, and the part of the gradient that is due to jumps."""

    value: float
    gradient: Float[np.ndarray, " params"]
    jump_term: Float[np.ndarray, " params"]


@runtime_checkable
class Function(Protocol):
    """A function of the parameters alone, with its gradient by hand; leading axes are a batch."""

    @property
    def num_params(self) -> int:
        """Number of parameters."""
        ...

    def value(self, x: Float[np.ndarray, "*batch params"]) -> Float[np.ndarray, "*batch"]:
        """f(x)."""
        ...

    def gradient(self, x: Float[np.ndarray, "*batch params"]) -> Float[np.ndarray, "*batch params"]:
        """Gradient of f; on a kink or a jump, of the branch that `value` takes."""
        ...


@runtime_checkable
class ScalarFunction(Function, Protocol):
    """A function of one parameter that knows its jumps and kinks."""

    @property
    def period(self) -> float:
        """Period of f; infinity where it has none."""
        ...

    def jumps(self) -> tuple[Jump, ...]:
        """All jumps, or those of one period."""
        ...

    def breakpoints(self) -> tuple[float, ...]:
        """Where f is not smooth, jumps included; all such points, or those of one period."""
        ...


@runtime_checkable
class ClosedForm(Protocol):
    """A function whose smoothing needs no quadrature."""

    def smoothed(self, theta: Float[np.ndarray, " params"], sigma: float) -> Smoothed:
        """F, grad F and the jump term."""
        ...


def smoothed(function: Function, theta: Float[np.ndarray, " params"], sigma: float) -> Smoothed:
    """F, grad F and the jump term: in closed form where there is one, else by adaptive quadrature to about 1e-12.

    Quadrature integrates f phi and f z phi / sigma between the breakpoints. It uses neither the gradient nor the jumps'
    sizes, so that the jump formula above can be checked with it.

    Raises:
        TypeError: the function has neither a closed form nor a list of breakpoints.
        ValueError: theta does not have num_params entries, or sigma is not positive and finite.
    """
    check_noise(sigma)
    if theta.shape != (function.num_params,):
        raise ValueError(f"theta must have shape ({function.num_params},), got {theta.shape}")
    if isinstance(function, ClosedForm):
        return function.smoothed(theta, sigma)
    if not isinstance(function, ScalarFunction):
        raise TypeError(
            f"{type(function).__name__} cannot be smoothed: it needs a method `smoothed`, or `period`, `jumps` and "
            "`breakpoints`"
        )
    centre = float(theta[0])
    breaks = [break_ for point in function.breakpoints() for break_ in _copies(point, function.period, centre, sigma)]
    # Cuts at multiples of sigma also keep the first look at the integrand from missing its peak.
    cuts = sorted({(point - centre) / sigma for point in breaks} | set(np.arange(-8.0, 9.0, 2.0)))

    def integrand(z: float) -> np.ndarray:
        weight = function.value(np.array([centre + sigma * z])) * normal_density(z)
        return np.array([weight, weight * z])

    integrals, _ = quad_vec(integrand, -TAIL, TAIL, epsabs=0.0, epsrel=1e-13, points=cuts)
    jumps = [
        jump.size * normal_density((position - centre) / sigma) / sigma
        for jump in function.jumps()
        for position in _copies(jump.position, function.period, centre, sigma)
    ]
    return Smoothed(float(integrals[0]), integrals[1:] / sigma, np.array([math.fsum(jumps)]))


def normal_density(z: float) -> float:
    """Density of the standard normal distribution."""
    return math.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)


def check_noise(sigma: float) -> None:
    """Raises ValueError unless sigma is positive and finite."""
    if not (sigma > 0 and math.isfinite(sigma)):
        raise ValueError(f"sigma must be positive and finite, in the unit of what it is added to; got {sigma}")


def _copies(point: float, period: float, centre: float, sigma: float) -> list[float]:
    """The point and its repetitions within reach of the noise."""
    if math.isinf(period):
        candidates = [point]
    else:
        first = math.ceil((centre - TAIL * sigma - point) / period)
        last = math.floor((centre + TAIL * sigma - point) / period)
        candidates = [point + period * number for number in range(first, last + 1)]
    return [candidate for candidate in candidates if abs(candidate - centre) < TAIL * sigma]
