r"""A ball shot at a pivoting bar, as a function of the launch angle.

A ball of mass m and speed v at angle theta meets the upright bar, a distance d away, at height d tan(theta). With
restitution e and the bar's inertia I about its foot, the impulse is (1 + e) m v cos / (1 + m (d tan)^2 / I), which
gives the bar the angular momentum

    L = m v d (1 + e) sin(theta) / (1 + (m d^2 / I) tan(theta)^2),   cost -L^2 in units of (m v d)^2.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from mjx_study.reference.function import Jump


@dataclasses.dataclass(frozen=True)
class MomentumTransfer:
    """-L^2 while the ball hits the bar, |angle| <= edge, else 0; x is the angle [rad], with period 2 pi.

    Attributes:
        edge: largest angle at which the bar is hit [rad].
        restitution: e; 0 is inelastic.
        inertia_ratio: m d^2 / I of the bar; 0 for an infinitely heavy one.

    Reference: Suh et al. 2022, "Momentum transfer": -sin^2 up to 45 degrees.
    """

    edge: float = math.pi / 4
    restitution: float = 0.0
    inertia_ratio: float = 0.0
    num_params: int = 1
    period: float = 2 * math.pi

    def __post_init__(self) -> None:
        if not 0 < self.edge < math.pi / 2:
            raise ValueError(f"edge must be an angle between 0 and pi/2, got {self.edge}")
        if not 0 <= self.restitution <= 1:
            raise ValueError(f"restitution must be from 0 to 1, got {self.restitution}")
        if not (self.inertia_ratio >= 0 and math.isfinite(self.inertia_ratio)):
            raise ValueError(f"inertia_ratio must not be negative, got {self.inertia_ratio}")

    def value(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch"]:
        """-L^2 where the bar is hit."""
        angle, hit = self._wrap(x)
        sine, tangent = np.sin(angle), np.tan(angle)
        momentum = (1 + self.restitution) * sine / (1 + self.inertia_ratio * tangent**2)
        return np.where(hit, -(momentum**2), 0.0)

    def gradient(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch 1"]:
        """-2 L dL where the bar is hit, with D = 1 + r tan^2 and dL = (1 + e) (cos D - 2 r sin tan / cos^2) / D^2."""
        angle, hit = self._wrap(x)
        sine, tangent, ratio, gain = np.sin(angle), np.tan(angle), self.inertia_ratio, 1 + self.restitution
        yielding = 1 + ratio * tangent**2
        slope = gain * (np.cos(angle) * yielding - 2 * ratio * sine * tangent * (1 + tangent**2)) / yielding**2
        return np.where(hit, -2 * gain * sine / yielding * slope, 0.0)[..., None]

    def jumps(self) -> tuple[Jump, ...]:
        """Jumps at both edges of the bar."""
        size = -float(self.value(np.array([self.edge])))
        return (Jump(-self.edge, -size), Jump(self.edge, size))

    def breakpoints(self) -> tuple[float, ...]:
        """The edges."""
        return (-self.edge, self.edge)

    def _wrap(self, x):
        """The angle, replaced by 0 on a miss, and whether the bar is hit."""
        angle = x[..., 0] - self.period * np.round(x[..., 0] / self.period)
        hit = np.abs(angle) <= self.edge
        return np.where(hit, angle, 0.0), hit
