"""Functions of the launch angle of a ball: over a wall, and at a pivoting bar; both have period 2 pi."""

import dataclasses
import math

import numpy as np

from mjx_study.reference.function import Jump, Points, Values


@dataclasses.dataclass(frozen=True)
class BallWall:
    """Minus the squared landing distance [m^2] of a point ball launched from the ground at x = 0; x is the angle [rad].

        range R = 2 v^2 sin cos / g,   height above the wall's foot y = d tan - g d^2 / (2 v^2 cos^2)

    Launched into the ground (sin <= 0), the ball stays at 0. Launched backwards (cos < 0 < sin), it lands at its range
    R < 0, where there is no wall. Launched forwards, it lands at R if that is short of the wall (there y < 0) or if it
    clears the top (y >= height); otherwise the inelastic impact drops it at the foot of the wall, which has no
    thickness. Where R reaches d the cost is continuous, because y = 0 there; where y = height it jumps.

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

    def value(self, x: Points) -> Values:
        return np.asarray(-(self.landing(x) ** 2))

    def gradient(self, x: Points) -> Points:
        """-2 R dR/dangle in free flight, 0 where the ball stays on the ground or drops at the wall."""
        angle = x[..., 0]
        flies = (np.sin(angle) > 0) & ~self.meets_wall(x)
        slope = 2 * self.speed**2 / self.gravity * np.cos(2 * angle)
        return np.where(flies, -2 * self.landing(x) * slope, 0.0)[..., None]

    def landing(self, x: Points) -> Values:
        free = np.where(np.sin(x[..., 0]) > 0, self._range(x[..., 0]), 0.0)
        return np.where(self.meets_wall(x), self.distance, free)

    def meets_wall(self, x: Points):
        """Whether the ball reaches the wall and does not clear its top."""
        angle = x[..., 0]
        # y < height, multiplied by cos^2 > 0.
        drop = self.gravity * self.distance**2 / (2 * self.speed**2)
        low = self.distance * np.sin(angle) * np.cos(angle) - drop < self.height * np.cos(angle) ** 2
        return (np.sin(angle) > 0) & (self._range(angle) >= self.distance) & low

    def jumps(self) -> tuple[Jump, ...]:
        """Jumps where the ball just clears the top; none if it never does."""
        signs = (-1, 1)  # the cost falls where the ball begins to clear the wall, and rises where it stops
        return tuple(
            Jump(angle, sign * (float(self._range(np.asarray(angle))) ** 2 - self.distance**2))
            for angle, sign in zip(self._clearing(), signs, strict=False)
        )

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


@dataclasses.dataclass(frozen=True)
class MomentumTransfer:
    """-L^2 while the ball hits the bar, |angle| <= edge, else 0; x is the angle [rad].

    A ball of mass m and speed v at angle theta meets the upright bar, a distance d away, at height d tan(theta). With
    restitution e and the bar's inertia I about its foot, the impulse is (1 + e) m v cos / (1 + m (d tan)^2 / I), which
    gives the bar the angular momentum, in units of m v d,

        L = (1 + e) sin(theta) / (1 + (m d^2 / I) tan(theta)^2).

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

    def value(self, x: Points) -> Values:
        angle, hit = self._wrap(x)
        sine, tangent = np.sin(angle), np.tan(angle)
        momentum = (1 + self.restitution) * sine / (1 + self.inertia_ratio * tangent**2)
        return np.where(hit, -(momentum**2), 0.0)

    def gradient(self, x: Points) -> Points:
        """-2 L dL where the bar is hit, with D = 1 + r tan^2 and dL = (1 + e) (cos D - 2 r sin tan / cos^2) / D^2."""
        angle, hit = self._wrap(x)
        sine, tangent, ratio, gain = np.sin(angle), np.tan(angle), self.inertia_ratio, 1 + self.restitution
        yielding = 1 + ratio * tangent**2
        slope = gain * (np.cos(angle) * yielding - 2 * ratio * sine * tangent * (1 + tangent**2)) / yielding**2
        return np.where(hit, -2 * gain * sine / yielding * slope, 0.0)[..., None]

    def jumps(self) -> tuple[Jump, ...]:
        size = -float(self.value(np.array([self.edge])))
        return (Jump(-self.edge, -size), Jump(self.edge, size))

    def breakpoints(self) -> tuple[float, ...]:
        return (-self.edge, self.edge)

    def _wrap(self, x):
        """The angle, replaced by 0 on a miss, and whether the bar is hit."""
        angle = x[..., 0] - self.period * np.round(x[..., 0] / self.period)
        hit = np.abs(angle) <= self.edge
        return np.where(hit, angle, 0.0), hit
