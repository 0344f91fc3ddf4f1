r"""The step function and its relaxation, the ramp of Coulomb friction, smoothed in closed form by Gaussian noise.

With Phi, phi the standard normal distribution and density,

    step:  F = Phi(theta / sigma),   grad F = phi(theta / sigma) / sigma, all of it jump term;
    ramp:  F = (G(theta + nu/2) - G(theta - nu/2)) / nu,   grad F = (Phi(. + nu/2) - Phi(. - nu/2)) / nu,

where G(a) = E max(a + w, 0) = a Phi(a / sigma) + sigma phi(a / sigma).
"""

import dataclasses
import math

import numpy as np
import scipy
from jaxtyping import Float

from estimators import NOISES
from mjx_study.reference.function import Jump, Smoothed


@dataclasses.dataclass(frozen=True)
class Heaviside:
    """1 where x >= 0, else 0."""

    num_params: int = 1
    period: float = math.inf
    any_noise: bool = dataclasses.field(default=False, init=False)

    def value(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch"]:
        return np.asarray(x[..., 0] >= 0, float)

    def gradient(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch 1"]:
        return np.zeros(x.shape)

    def jumps(self) -> tuple[Jump, ...]:
        """One jump, of size 1 at 0."""
        return (Jump(0.0, 1.0),)

    def breakpoints(self) -> tuple[float, ...]:
        return (0.0,)

    def smoothed(self, theta: Float[np.ndarray, " 1"], sigma: float) -> Smoothed:
        """F = Phi(theta / sigma); the gradient is all jump term."""
        gradient = np.array([NOISES["gaussian"].density(theta[0] / sigma) / sigma])
        return Smoothed(float(scipy.special.ndtr(theta[0] / sigma)), gradient, gradient)


@dataclasses.dataclass(frozen=True)
class RelaxedHeaviside:
    """clip(x / width + 1/2, 0, 1), continuous.

    Attributes:
        width: nu, the slip tolerance; in the unit of x.

    Reference: Suh et al. 2022, Coulomb friction example, whose slope 2 t / nu does not meet the step at +-nu / 2.
    """

    width: float
    num_params: int = 1
    period: float = math.inf
    any_noise: bool = dataclasses.field(default=False, init=False)

    def __post_init__(self) -> None:
        if not (self.width > 0 and math.isfinite(self.width)):
            raise ValueError(f"width must be positive and finite, got {self.width}")

    def value(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch"]:
        """clip(x / nu + 1/2, 0, 1)."""
        return np.asarray(np.clip(x[..., 0] / self.width + 0.5, 0.0, 1.0))

    def gradient(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch 1"]:
        """1 / nu on the ramp, else 0."""
        return np.where(np.abs(x) < self.width / 2, 1 / self.width, 0.0)

    def jumps(self) -> tuple[Jump, ...]:
        return ()

    def breakpoints(self) -> tuple[float, ...]:
        """The ends of the ramp."""
        return (-self.width / 2, self.width / 2)

    def smoothed(self, theta: Float[np.ndarray, " 1"], sigma: float) -> Smoothed:
        """F and grad F by differences over the ramp, with rounding errors of about 1e-16 / nu."""
        ends = theta + np.array([self.width / 2, -self.width / 2])
        density = NOISES["gaussian"].density
        upper, lower = (end * scipy.special.ndtr(end / sigma) + sigma * density(end / sigma) for end in ends)
        slope = (scipy.special.ndtr(ends[0] / sigma) - scipy.special.ndtr(ends[1] / sigma)) / self.width
        return Smoothed(float((upper - lower) / self.width), np.array([slope]), np.zeros(1))
