r"""Scalar functions of a few parameters, with jumps and kinks, and their smoothing by noise.

    F(theta) = E f(theta + w),   w = sigma z, the entries of z independent with density p = exp(-psi) of variance 1

In one dimension, with jumps f(t_j+) - f(t_j-),

    grad F = E f'(theta + w) + sum_j [f(t_j+) - f(t_j-)] p((t_j - theta) / sigma) / sigma,

so a first-order estimate misses exactly the sum, the jump term: E[FoBG] = grad F - jump term.
"""

import dataclasses
import math
from typing import Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from mjx_study.reference.noise import check_density

TAIL: Final = 1e-15
"""Probability of noise outside the range of the quadrature."""
NODES: Final = np.polynomial.legendre.leggauss(64)
"""Nodes on (-1, 1) and weights of the Gauss-Legendre rule between adjacent cuts."""
CORE, PANEL, GROWTH = 8.0, 0.5, 1.25
"""Range of evenly spaced cuts [standard deviations]; their spacing; the growth ratio of the spacing beyond."""


@dataclasses.dataclass(frozen=True)
class Jump:
    """A discontinuity: its position, and f just above it minus f just below."""

    position: float
    size: float


@dataclasses.dataclass(frozen=True)
class Smoothed:
    """F at a point, its gradient, and the part of the gradient due to jumps."""

    value: float
    gradient: Float[np.ndarray, " params"]
    jump_term: Float[np.ndarray, " params"]


@runtime_checkable
class Function(Protocol):
    """A function of the parameters alone, with a hand-written gradient; leading axes are a batch."""

    @property
    def num_params(self) -> int: ...

    def value(self, x: Float[np.ndarray, "*batch params"]) -> Float[np.ndarray, "*batch"]:
        """f(x)."""
        ...

    def gradient(self, x: Float[np.ndarray, "*batch params"]) -> Float[np.ndarray, "*batch params"]:
        """Gradient of f; at a kink or a jump, that of the branch that `value` takes."""
        ...


@runtime_checkable
class ScalarFunction(Function, Protocol):
    """A function of one parameter with known jumps and kinks."""

    @property
    def period(self) -> float:
        """Period of f; infinity if it has none."""
        ...

    def jumps(self) -> tuple[Jump, ...]:
        """All jumps, or those of one period."""
        ...

    def breakpoints(self) -> tuple[float, ...]:
        """All points where f is not smooth, jumps included, or those of one period."""
        ...


@runtime_checkable
class ClosedForm(Protocol):
    """A function smoothed in closed form, without quadrature."""

    @property
    def any_noise(self) -> bool:
        """Whether the closed form holds for every density of variance sigma^2, not only for Gaussian noise."""
        ...

    def smoothed(self, theta: Float[np.ndarray, " params"], sigma: float) -> Smoothed:
        """F, grad F and the jump term."""
        ...


def smoothed(
    function: Function, theta: Float[np.ndarray, " params"], sigma: float, noise: str = "gaussian"
) -> Smoothed:
    """Return F, grad F and the jump term, in closed form if available, else by quadrature to about 1e-12.

    Quadrature integrates f p and f psi' p / sigma between the breakpoints, where f is smooth. It uses neither the
    gradient nor the jump sizes, so it can check the jump formula above.

    Args:
        function: f.
        theta: point of evaluation.
        sigma: standard deviation of the noise.
        noise: name of the noise density in `estimators.NOISES`.

    Raises:
        TypeError: the function has neither a closed form for this noise nor a list of breakpoints.
        ValueError: theta does not have num_params entries, sigma is not positive and finite, or the noise is unknown.
    """
    check_noise(sigma)
    density = check_density(noise)
    if theta.shape != (function.num_params,):
        raise ValueError(f"theta must have shape ({function.num_params},), got {theta.shape}")
    if isinstance(function, ClosedForm) and (function.any_noise or noise == "gaussian"):
        return function.smoothed(theta, sigma)
    if not isinstance(function, ScalarFunction):
        raise TypeError(
            f"{type(function).__name__} cannot be smoothed: it needs a method `smoothed`, or `period`, `jumps` and "
            "`breakpoints`"
        )
    centre, reach = float(theta[0]), density.reach(TAIL)

    def copies(point: float) -> Float[np.ndarray, " copies"]:
        return (_copies(point, function.period, centre, reach * sigma) - centre) / sigma

    breaks = [copies(point) for point in function.breakpoints()]
    z, weight = _nodes(np.concatenate([_cuts(reach), *breaks]))
    mass = weight * density.density(z) * function.value(centre + sigma * z[:, None])
    score = np.asarray(density.score(z))
    jumps = [jump.size * density.density(copies(jump.position)).sum() / sigma for jump in function.jumps()]
    return Smoothed(math.fsum(mass), np.array([math.fsum(mass * score) / sigma]), np.array([math.fsum(jumps)]))


def _cuts(reach: float) -> Float[np.ndarray, " cuts"]:
    """Panel boundaries for any function, including 0, where a density may have a kink."""
    even = np.arange(0.0, min(CORE, reach), PANEL)
    tail = np.geomspace(even[-1], reach, 1 + math.ceil(math.log(reach / even[-1], GROWTH)))
    return np.concatenate([-tail, -even, even, tail])


def _nodes(cuts: Float[np.ndarray, " cuts"]) -> tuple[Float[np.ndarray, " nodes"], Float[np.ndarray, " nodes"]]:
    """Nodes and weights of the rule between adjacent cuts."""
    edges = np.unique(cuts)
    half, (node, weight) = np.diff(edges)[:, None] / 2, NODES
    return (edges[:-1, None] + half * (1 + node)).ravel(), (half * weight).ravel()


def check_noise(sigma: float) -> None:
    """Raise ValueError unless sigma is positive and finite."""
    if not (sigma > 0 and math.isfinite(sigma)):
        raise ValueError(f"sigma must be positive and finite, in the unit of the quantity it is added to; got {sigma}")


def _copies(point: float, period: float, centre: float, reach: float) -> Float[np.ndarray, " copies"]:
    """Return the point and its periodic copies within reach."""
    if math.isinf(period):
        candidates = np.array([point])
    else:
        first, last = math.ceil((centre - reach - point) / period), math.floor((centre + reach - point) / period)
        candidates = point + period * np.arange(first, last + 1)
    return candidates[np.abs(candidates - centre) < reach]
