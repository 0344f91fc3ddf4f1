r"""Functions of a few parameters, with jumps and kinks, and their smoothing by noise.

    F(theta) = E f(theta + w),   w = sigma z, the entries of z independent with density p = exp(-psi) of variance 1

In one dimension, with jumps f(t_j+) - f(t_j-),

    grad F = E f'(theta + w) + sum_j [f(t_j+) - f(t_j-)] p((t_j - theta) / sigma) / sigma,

so a first-order estimate misses exactly the sum, the jump term: E[FoBG] = grad F - jump term.
"""

import dataclasses
import math
from typing import Final, Protocol, runtime_checkable

import numpy as np
import scipy
from jaxtyping import Float

from estimators import NOISES
from estimators.noise import check_density, check_sigma

Values = Float[np.ndarray, "*batch"]
Points = Float[np.ndarray, "*batch params"]
Theta = Float[np.ndarray, " params"]

TAIL_PROBABILITY: Final = 1e-15  # probability of noise outside the range of the quadrature
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
    gradient: Theta
    jump_term: Theta


@runtime_checkable
class Function(Protocol):
    """A function of the parameters alone, with a hand-written gradient; leading axes are a batch.

    At a kink or a jump, the gradient is that of the branch that the value takes.
    """

    @property
    def num_params(self) -> int: ...
    def value(self, x: Points) -> Values: ...
    def gradient(self, x: Points) -> Points: ...


@runtime_checkable
class ScalarFunction(Function, Protocol):
    """A function of one parameter with known jumps and kinks: all, or those of one period.

    The period is infinite if there is none. Breakpoints are all points where f is not smooth, jumps included.
    """

    @property
    def period(self) -> float: ...
    def jumps(self) -> tuple[Jump, ...]: ...
    def breakpoints(self) -> tuple[float, ...]: ...


@runtime_checkable
class ClosedForm(Protocol):
    """A function smoothed by Gaussian noise in closed form, without quadrature."""

    def smoothed(self, theta: Theta, sigma: float) -> Smoothed: ...


def smoothed(function: Function, theta: Theta, sigma: float, noise: str = "gaussian") -> Smoothed:
    """Return F, grad F and the jump term, in closed form if available, else by quadrature to about 1e-12.

    Quadrature integrates f p and f psi' p / sigma between the breakpoints, where f is smooth. It uses neither the
    gradient nor the jump sizes, so it can check the jump formula above.

    Args:
        sigma: standard deviation of the noise.
        noise: name of the noise density in `estimators.NOISES`.

    Raises:
        TypeError: the function has neither a closed form for this noise nor a list of breakpoints.
        ValueError: theta does not have num_params entries, sigma is not positive and finite, or the noise is unknown.
    """
    check_sigma(sigma)
    density = check_density(noise)
    if theta.shape != (function.num_params,):
        raise ValueError(f"theta must have shape ({function.num_params},), got {theta.shape}")
    if isinstance(function, ClosedForm) and noise == "gaussian":
        return function.smoothed(theta, sigma)
    if not isinstance(function, ScalarFunction):
        raise TypeError(
            f"{type(function).__name__} cannot be smoothed: it needs a method `smoothed`, or `period`, `jumps` and "
            "`breakpoints`"
        )
    centre, reach = float(theta[0]), density.reach(TAIL_PROBABILITY)

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


def _copies(point: float, period: float, centre: float, reach: float) -> Float[np.ndarray, " copies"]:
    """Return the point and its periodic copies within reach."""
    if math.isinf(period):
        candidates = np.array([point])
    else:
        first, last = math.ceil((centre - reach - point) / period), math.floor((centre + reach - point) / period)
        candidates = point + period * np.arange(first, last + 1)
    return candidates[np.abs(candidates - centre) < reach]


@dataclasses.dataclass(frozen=True)
class Heaviside:
    """1 where x >= 0, else 0."""

    num_params: int = 1
    period: float = math.inf

    def value(self, x: Points) -> Values:
        return np.asarray(x[..., 0] >= 0, float)

    def gradient(self, x: Points) -> Points:
        return np.zeros(x.shape)

    def jumps(self) -> tuple[Jump, ...]:
        return (Jump(0.0, 1.0),)

    def breakpoints(self) -> tuple[float, ...]:
        return (0.0,)

    def smoothed(self, theta: Theta, sigma: float) -> Smoothed:
        """With Phi, phi the normal distribution: F = Phi(theta / sigma), and its gradient is all jump term."""
        gradient = np.array([NOISES["gaussian"].density(theta[0] / sigma) / sigma])
        return Smoothed(float(scipy.special.ndtr(theta[0] / sigma)), gradient, gradient)


@dataclasses.dataclass(frozen=True)
class RelaxedHeaviside:
    """clip(x / width + 1/2, 0, 1), continuous: the ramp of Coulomb friction.

    Attributes:
        width: nu, the slip tolerance; in the unit of x.

    Reference: Suh et al. 2022, Coulomb friction example, whose slope 2 t / nu does not meet the step at +-nu / 2.
    """

    width: float
    num_params: int = 1
    period: float = math.inf

    def __post_init__(self) -> None:
        if not (self.width > 0 and math.isfinite(self.width)):
            raise ValueError(f"width must be positive and finite, got {self.width}")

    def value(self, x: Points) -> Values:
        return np.asarray(np.clip(x[..., 0] / self.width + 0.5, 0.0, 1.0))

    def gradient(self, x: Points) -> Points:
        return np.where(np.abs(x) < self.width / 2, 1 / self.width, 0.0)

    def jumps(self) -> tuple[Jump, ...]:
        return ()

    def breakpoints(self) -> tuple[float, ...]:
        return (-self.width / 2, self.width / 2)

    def smoothed(self, theta: Theta, sigma: float) -> Smoothed:
        r"""F and grad F by differences over the ramp, with rounding errors of about 1e-16 / nu.

            F = (G(theta + nu/2) - G(theta - nu/2)) / nu,   grad F = (Phi(. + nu/2) - Phi(. - nu/2)) / nu

        with G(a) = E max(a + w, 0) = a Phi(a / sigma) + sigma phi(a / sigma).
        """
        ends = theta + np.array([self.width / 2, -self.width / 2])
        density = NOISES["gaussian"].density
        upper, lower = (end * scipy.special.ndtr(end / sigma) + sigma * density(end / sigma) for end in ends)
        slope = (scipy.special.ndtr(ends[0] / sigma) - scipy.special.ndtr(ends[1] / sigma)) / self.width
        return Smoothed(float((upper - lower) / self.width), np.array([slope]), np.zeros(1))
