"""Scenes of the study in numbers, with NumPy alone: every adapter builds them in its engine's own way.

The cost of a rollout is linear . p + quadratic . (p - target)^2 of the positions p of the bodies' centers at its end.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

GRAVITY: Final = 9.81
RADIUS: Final = 0.1  # radius of spheres, and half edge of boxes [m]
LENGTH, LIMIT, PIVOT = 0.5, 0.5, 2.0
"""The pendulum's length [m], the angle of its limit from below [rad], the height of its hinge [m]."""


@dataclasses.dataclass(frozen=True)
class Body:
    """A body of 1 kg at the start: a `sphere`, a `box`, or the point at the end of a massless `pendulum`.

    Attributes:
        position: of its center [m].
        velocity: [m/s].
        tilt: angle about y [rad]; of the pendulum, from below.
        spin: angular velocity about y [rad/s], of the pendulum only.
    """

    shape: str
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt: float = 0.0
    spin: float = 0.0


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is simulated, and what is asked.

    Attributes:
        bodies: their state at the start, where the parameter's number is replaced.
        parameter: what of the first body the parameter sets: `z`, `vx` or `spin`.
        center, sigma: mean and standard deviation of the parameter [m, m/s, rad/s].
        horizon: [s].
        linear, quadratic, target: coefficients of the cost, per body and axis; zeros if empty.
        gravity: [m/s^2], downwards.
        floor: whether there is a plane z = 0.
        wall: x at which a plane faces the bodies, if any [m].
        friction: Coulomb's coefficient.
        restitution: where the engine has a coefficient or damping for it; 0 leaves the engine's default.
        exact: the cost by the parameter in the limit of rigid contact, which bounces by `restitution`, if known. It
            knows no compliance, so that an engine's cost differs from it by more than rounding.
    """

    bodies: tuple[Body, ...]
    parameter: str
    center: float
    sigma: float
    horizon: float
    linear: tuple[tuple[float, float, float], ...]
    quadratic: tuple[tuple[float, float, float], ...] = ()
    target: tuple[tuple[float, float, float], ...] = ()
    gravity: float = GRAVITY
    floor: bool = True
    wall: float | None = None
    friction: float = 0.5
    restitution: float = 0.0
    exact: Callable[[np.ndarray], np.ndarray] | None = None

    def steps(self, timestep: float) -> int:
        """Number of steps of a rollout."""
        return round(self.horizon / timestep)

    def coefficients(self) -> np.ndarray:
        """Linear and quadratic coefficients and targets, each [bodies, 3]."""
        zeros = tuple((0.0, 0.0, 0.0) for _ in self.bodies)
        return np.array([self.linear, self.quadratic or zeros, self.target or zeros])

    def cost(self, positions):
        """Cost of positions [bodies, 3] at the end, of any array type; or of nested lists of scalars of any kind."""
        linear, quadratic, target = self.coefficients()
        if isinstance(positions, list):
            return sum(
                a * p + b * (p - c) * (p - c)
                for row, *others in zip(positions, linear.tolist(), quadratic.tolist(), target.tolist(), strict=True)
                for p, a, b, c in zip(row, *others, strict=True)
            )
        return (linear * positions + quadratic * (positions - target) ** 2).sum()

    def cost_gradient(self, positions: np.ndarray) -> np.ndarray:
        """Derivative of the cost by the positions, [bodies, 3]."""
        linear, quadratic, target = self.coefficients()
        return linear + 2 * quadratic * (positions - target)

    def start(self, theta: float) -> tuple[Body, ...]:
        """Bodies with the parameter's value in its place."""
        first = self.bodies[0]
        if self.parameter == "z":
            first = dataclasses.replace(first, position=(*first.position[:2], theta))
        elif self.parameter == "vx":
            first = dataclasses.replace(first, velocity=(theta, *first.velocity[1:]))
        else:
            first = dataclasses.replace(first, spin=theta)
        return (first, *self.bodies[1:])


class Rollout(NamedTuple):
    """What an engine says of many parameters.

    Attributes:
        values: cost, [points].
        derivatives: of the cost by the parameter, [points]; NaN where the engine has none.
        positions: of the bodies' centers at the end, [points, bodies, 3].
    """

    values: np.ndarray
    derivatives: np.ndarray
    positions: np.ndarray


Simulate = Callable[[np.ndarray], Rollout]
"""Rollouts at many parameters; in float64 if the engine can."""


class CannotError(Exception):
    """An engine cannot simulate a scene, or not differentiate it, for the reason given."""


def rigid_fall(height: np.ndarray, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """Return when a body that falls through a height [m] lands [s], and how fast [m/s]."""
    last = np.sqrt(speed**2 + 2 * GRAVITY * height)
    return (last - speed) / GRAVITY, last


def rigid_bounce(z: np.ndarray) -> np.ndarray:
    """Height of `bounce` at its end [m]."""
    touch, speed = rigid_fall(z - RADIUS, 1.0)
    left = 0.3 - touch
    return RADIUS + 0.5 * speed * left - GRAVITY * left**2 / 2


def rigid_slide(speed: np.ndarray) -> np.ndarray:
    """Way of `slide` until friction has stopped it [m]."""
    return speed**2 / (2 * 0.5 * GRAVITY)


def rigid_wall(speed: np.ndarray) -> np.ndarray:
    """End of `wall`, 0.3 m from the wall at its start and thrown back at half its speed [m]."""
    return np.where(speed * 0.5 < 0.3, 0.5 * speed, 0.3 - 0.5 * (0.5 * speed - 0.3))


def rigid_push(speed: np.ndarray) -> np.ndarray:
    """End of the second sphere of `push`, which takes half the speed [m]."""
    return 0.4 + np.maximum(0.5 * speed - 0.2, 0) / 2


def rigid_landing(z: np.ndarray) -> np.ndarray:
    """Cost of `box_flat`: friction takes half the speed of landing from 1 m/s at once, then brakes what is left."""
    touch, speed = rigid_fall(z - RADIUS, 1.0)
    return touch + np.maximum(1 - 0.5 * speed, 0) ** 2 / (2 * 0.5 * GRAVITY) + RADIUS


LANDED: Final = ((0.0, 0.0, 100.0),)
AT_REST: Final = ((0.0, 0.0, RADIUS),)
ALONG, UP, BOTH = ((1.0, 0.0, 0.0),), ((0.0, 0.0, 1.0),), ((1.0, 0.0, 1.0),)  # linear costs of one body
FLYING: Final[dict[str, Any]] = {"gravity": 0, "floor": False}
EDGE: Final = math.pi / 6
BALLS: Final = (Body("sphere", (0, 0, 1), (1, 0, 0)), Body("sphere", (0.4, 0, 1)))
BALL, FALLING = Body("sphere", (0, 0, 0.15), (1, 0, -1)), Body("sphere", (0, 0, 0.3), (0, 0, -1))
SLIDING, LANDING = Body("box", (0, 0, RADIUS), (1, 0, 0)), Body("box", (0, 0, 0.15), (1, 0, -1))
TILTED, SWINGING = Body("box", (0, 0, 0.2), (0.5, 0, -1), EDGE), Body("pendulum", tilt=-0.5, spin=3.0)
SCENES: Final = {
    "toss": Scene((BALL,), "z", 0.15, 0.01, 0.4, BOTH, LANDED, AT_REST, friction=1.0),
    "bounce": Scene((FALLING,), "z", 0.3, 0.04, 0.3, UP, restitution=0.5, exact=rigid_bounce),
    "slide": Scene((SLIDING,), "vx", 1.0, 0.1, 0.5, ALONG, exact=rigid_slide),
    "wall": Scene(BALLS[:1], "vx", 1.0, 0.1, 0.5, ALONG, wall=0.4, restitution=0.5, exact=rigid_wall, **FLYING),
    "push": Scene(BALLS, "vx", 1.0, 0.1, 0.5, ((0, 0, 0), *ALONG), exact=rigid_push, **FLYING),
    "box_flat": Scene((LANDING,), "z", 0.15, 0.015, 0.4, BOTH, LANDED, AT_REST, exact=rigid_landing),
    "box_edge": Scene((TILTED,), "z", 0.2, 0.015, 0.4, BOTH, LANDED, AT_REST),
    "pendulum": Scene((SWINGING,), "spin", 4.0, 0.3, 0.5, ALONG, floor=False),
}
VARIANTS: Final[dict[str, Scene]] = {
    "toss, half the noise": dataclasses.replace(SCENES["toss"], sigma=SCENES["toss"].sigma / 2),
    "toss from 0.3 m": dataclasses.replace(SCENES["toss"], center=0.3, sigma=0.05),
}
"""Scenes of few engines, beside the matrix."""
TIMESTEPS: Final = (0.005, 0.002)


def scene_named(name: str) -> Scene:
    """Return a scene of the matrix or a variant."""
    return {**SCENES, **VARIANTS}[name]


def damping_ratio(restitution: float) -> float:
    """Damping ratio of a spring and a damper which may pull that give a coefficient of restitution."""
    log = math.log(restitution)
    return -log / math.hypot(math.pi, log)


def mjcf(scene: Scene, timestep: float) -> str:
    """Return the scene in MuJoCo's format, for its relatives; the start is set by the state, not by this text."""
    solref = f"0.02 {damping_ratio(scene.restitution):.6g}" if scene.restitution else "0.02 1"
    geom = f'solref="{solref}" friction="{scene.friction} 0 0"'
    planes = f'<geom name="floor" type="plane" size="20 20 1" {geom}/>' * scene.floor
    if scene.wall is not None:
        planes += f'<geom name="wall" type="plane" size="20 20 1" pos="{scene.wall} 0 0" zaxis="-1 0 0" {geom}/>'
    bodies = ""
    for body in scene.bodies:
        if body.shape == "pendulum":
            bodies += f"""<body pos="0 0 {PIVOT}"><joint type="hinge" axis="0 -1 0" limited="true" range="-3 {LIMIT}"/>
              <geom type="sphere" size="0.05" mass="1" pos="0 0 {-LENGTH}" contype="0" conaffinity="0"/></body>"""
        else:
            size = f'type="{body.shape}" size="{RADIUS} {RADIUS} {RADIUS}"'
            position = "{} {} {}".format(*body.position)
            bodies += f'<body pos="{position}"><freejoint/><geom {size} mass="1" {geom}/></body>'
    return f"""<mujoco><compiler angle="radian"/><option timestep="{timestep}" gravity="0 0 {-scene.gravity}"/>
      <worldbody>{planes}{bodies}</worldbody></mujoco>"""


def mjcf_state(scene: Scene, theta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and velocities of the joints of `mjcf` at the start."""
    position, velocity = [], []
    for body in scene.start(theta):
        if body.shape == "pendulum":
            position += [body.tilt]
            velocity += [body.spin]
        else:
            position += [*body.position, math.cos(body.tilt / 2), 0, math.sin(body.tilt / 2), 0]
            velocity += [*body.velocity, 0, 0, 0]
    return np.array(position, float), np.array(velocity, float)


def mjcf_index(scene: Scene) -> tuple[bool, int]:
    """Return whether the parameter is a velocity, and its index in the state of `mjcf`."""
    return {"z": (False, 2), "vx": (True, 0), "spin": (True, 0)}[scene.parameter]
