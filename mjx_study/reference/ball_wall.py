r"""A ball thrown over a wall, as a function of the launch angle.

    range R = 2 v^2 sin cos / g,   height above the wall's foot y = d tan - g d^2 / (2 v^2 cos^2),   cost -x^2

where the ball lands at x = R, or at x = d if it meets the wall: R >= d and y < height.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Float

from mjx_study.reference.function import Jump


@dataclasses.dataclass(frozen=True)
class BallWall:
    """Minus the squared landing distance [m^2] of a point ball launched from the ground at x = 0; x is the angle [rad].

    Defined for every angle, with period 2 pi. Launched into the ground (sin <= 0), the ball stays at 0. Launched
    backwards (cos < 0 < sin), it lands at its range R < 0, where there is no wall. Launched forwards, it lands at R if
    that is short of the wall (there y < 0) or if it clears the top (y >= height); otherwise the inelastic impact drops
    it at the foot of the wall. The wall has no thickness, so a ball that clears it cannot hit it later.

    Where R reaches d the cost is continuous, because y = 0 there; where y = height it jumps.

    Attributes:
        speed: launch speed v [m/s].
        distance: distance d of the wall [m].
        height: height of the wall [m].
        gravity: g [m/s^2].

    Reference: Suh et al. 2022, "Ball with wall", with its published example's numbers.
    """

    speed: float = 1.0
    distance: float = 0.06
    height: float = 0.02
    gravity: float = 9.81
    num_params: int = 1
    period: float = 2 * math.pi

    def __post_init__(self) -> None:
        for name in ("speed", "distance", "height", "gravity"):
            size = getattr(self, name)
            if not (size > 0 and math.isfinite(size)):
                raise ValueError(f"{name} must be positive and finite, got {size}")

    def value(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch"]:
        """-(landing distance)^2 [m^2]."""
        return np.asarray(-(self.landing(x) ** 2))

    def gradient(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch 1"]:
        """-2 R dR/dangle in free flight, 0 where the ball stays on the ground or drops at the wall."""
        angle = x[..., 0]
        flies = (np.sin(angle) > 0) & ~self.meets_wall(x)
        slope = 2 * self.speed**2 / self.gravity * np.cos(2 * angle)
        return np.where(flies, -2 * self.landing(x) * slope, 0.0)[..., None]

    def landing(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch"]:
        free = np.where(np.sin(x[..., 0]) > 0, self._range(x[..., 0]), 0.0)
        return np.where(self.meets_wall(x), self.distance, free)

    def meets_wall(self, x: Float[np.ndarray, "*batch 1"]):
        """Whether the ball reaches the wall and does not clear its top."""
        angle = x[..., 0]
        # y < height, multiplied by cos^2 > 0.
        drop = self.gravity * self.distance**2 / (2 * self.speed**2)
        low = self.distance * np.sin(angle) * np.cos(angle) - drop < self.height * np.cos(angle) ** 2
        return (np.sin(angle) > 0) & (self._range(angle) >= self.distance) & low

    def jumps(self) -> tuple[Jump, ...]:
        """Jumps where the ball just clears the top; none if it never does."""
        gains = [float(self._range(np.asarray(angle))) ** 2 - self.distance**2 for angle in self._clearing()]
        signs = (-1, 1)[: len(gains)]  # the cost falls where the ball begins to clear the wall, rises where it stops
        return tuple(Jump(angle, sign * gain) for angle, sign, gain in zip(self._clearing(), signs, gains, strict=True))

    def breakpoints(self) -> tuple[float, ...]:
        """The jumps, the angles that just reach the wall, and those at which the ball lifts off."""
        reaching = self.gravity * self.distance / self.speed**2
        kinks = (math.asin(reaching) / 2, math.pi / 2 - math.asin(reaching) / 2) if reaching < 1 else ()
        return tuple(sorted((0.0, math.pi, *kinks, *self._clearing())))

    def _range(self, angle: np.ndarray) -> np.ndarray:
        return np.asarray(self.speed**2 / self.gravity * np.sin(2 * angle))

    def _clearing(self) -> tuple[float, ...]:
        """Angles with y = height: with t = tan and k = g d^2 / (2 v^2), k t^2 - d t + k + height = 0."""
        drop = self.gravity * self.distance**2 / (2 * self.speed**2)
        discriminant = self.distance**2 - 4 * drop * (drop + self.height)
        if discriminant <= 0:
            return ()
        # The root whose sum does not cancel; the other from their product.
        larger = (self.distance + math.sqrt(discriminant)) / (2 * drop)
        return (math.atan((drop + self.height) / (drop * larger)), math.atan(larger))
