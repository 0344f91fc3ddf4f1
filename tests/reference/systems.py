"""One table of the analytic systems, at generic states and along generic rollouts, and difference quotients."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from experiments.linear_quadratic import LinearQuadratic
from mjx_study.reference import DoublePendulum, Pusher, Rollout, SlidingBox, System, Tennis
from tests.pusher_fixtures import INPUTS, ImpedancePusher

RNG = np.random.default_rng(0)


def differentiate(function: Callable[[float], np.ndarray], step: float) -> np.ndarray:
    """d function / dt at t = 0 by central differences and one Richardson extrapolation.

    The truncation error is about step^4 times the fifth derivative / 480, rounding about 1e-16 |function| / step.
    """

    def quotient(size: float) -> np.ndarray:
        return (function(size) - function(-size)) / (2 * size)

    return (4 * quotient(step / 2) - quotient(step)) / 3


def symmetric(size: int, rng: np.random.Generator) -> np.ndarray:
    """A random positive definite matrix."""
    root = rng.standard_normal((size, size))
    return root @ root.T / size


def linear_quadratic(seed: int = 4) -> LinearQuadratic:
    """Three states, two controls."""
    rng = np.random.default_rng(seed)
    transition = 0.9 * np.linalg.qr(rng.standard_normal((3, 3)))[0]
    weights = symmetric(3, rng), symmetric(2, rng), symmetric(3, rng)
    return LinearQuadratic(transition, rng.standard_normal((3, 2)), *weights)


def tennis_impacts(
    system: Tennis, count: int, seed: int = 5, *, tangential: float = 2.0, spin: float = 3.0, latest: float = 0.8
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States and controls whose first impact happens inside the step: chosen at the impact, then taken back in time.

    Returns:
        States, controls, times of impact, sides.
    """
    rng = np.random.default_rng(seed)
    time = system.timestep * rng.uniform(0.2, latest, count)
    side, angle = rng.choice([-1.0, 1.0], count), rng.uniform(-0.6, 0.6, count)
    control = np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.choice([-1, 1], count) * spin])
    along = rng.uniform(-0.6, 0.6, count)
    tangent = np.column_stack([np.cos(angle), np.sin(angle)])
    normal = np.column_stack([-np.sin(angle), np.cos(angle)])
    offset = along[:, None] * tangent + (side * (system.half_height + system.radius))[:, None] * normal
    surface = control[:, :2] + control[:, 2:] * np.column_stack([-offset[:, 1], offset[:, 0]])
    # Turning with the spin moves the ball back into the face, which makes second impacts likely.
    speed = side * np.sign(control[:, 2]) * tangential * rng.uniform(0.8, 1, count)
    # The surface velocity at the ball's centre differs from that at the point of contact along the tangent only.
    relative_velocity = speed[:, None] * tangent - (side * rng.uniform(1, 2, count))[:, None] * normal
    velocity = surface + relative_velocity
    paddle = rng.uniform(-0.5, 0.5, (count, 2))
    at_impact = np.column_stack([paddle + offset, velocity, paddle, angle])
    backwards = np.column_stack([velocity, np.zeros((count, 2)), control])
    return at_impact - time[:, None] * backwards, control, time, side


class StepCase(NamedTuple):
    """A batch of states and controls away from kinks."""

    system: System
    states: np.ndarray
    controls: np.ndarray


def _pusher_states() -> np.ndarray:
    states = RNG.standard_normal((50, 4))
    states[:, 1] = states[:, 0] + 1 + RNG.choice([-1, 1], 50) * RNG.uniform(0.01, 0.1, 50)
    return states


def _sliding_box_states() -> np.ndarray:
    states = RNG.standard_normal((60, 4))
    states[:40, 1] = states[:40, 0] + RNG.uniform(-0.09, 0.09, 40)  # on the box; the rest has fallen off
    states[40:, 1] = states[40:, 0] + RNG.choice([-1, 1], 20) * RNG.uniform(0.11, 0.3, 20)
    states[:20, 3] = states[:20, 2] + RNG.uniform(-0.09, 0.09, 20)  # sticking
    states[20:40, 3] = states[20:40, 2] + RNG.choice([-1, 1], 20) * RNG.uniform(0.11, 0.3, 20)
    return states


def _tennis_case(**options) -> StepCase:
    system = Tennis()
    states, controls, _, _ = tennis_impacts(system, 50, **options)
    return StepCase(system, states, controls)


LINEAR_QUADRATIC = linear_quadratic()
PUSHER = _pusher_states(), RNG.standard_normal((50, 1))
STEPS = {
    "pusher": StepCase(Pusher(100.0), *PUSHER),
    "pusher, unstable": StepCase(Pusher(1e4), *PUSHER),
    "pusher, impedance": StepCase(ImpedancePusher(1e3), *PUSHER),
    "sliding_box": StepCase(SlidingBox(), _sliding_box_states(), RNG.standard_normal((60, 1))),
    "double_pendulum": StepCase(
        DoublePendulum(timestep=0.05), RNG.standard_normal((50, 4)) * [2.0, 2.0, 4.0, 4.0], np.zeros((50, 0))
    ),
    "tennis, impact": _tennis_case(),
    "tennis, several impacts": _tennis_case(seed=6, tangential=8.0, spin=8.0, latest=0.3),
    "tennis, flight": StepCase(Tennis(), RNG.standard_normal((50, 7)) + 5 * np.eye(7)[1], RNG.standard_normal((50, 3))),
    "linear_quadratic": StepCase(LINEAR_QUADRATIC, RNG.standard_normal((50, 3)), RNG.standard_normal((50, 2))),
}


class RolloutCase(NamedTuple):
    """A policy on a system; `events` is what must not change within a difference quotient."""

    system: System
    start: np.ndarray
    controls: np.ndarray
    feedback: np.ndarray | None
    events: Callable[[Rollout], np.ndarray]
    step: float = 1e-4


def _no_events(rollout: Rollout) -> np.ndarray:
    return np.zeros(0)


def _pusher_events(rollout: Rollout) -> np.ndarray:
    return rollout.states[..., 1] - rollout.states[..., 0] < 1


def _sliding_box_events(rollout: Rollout) -> np.ndarray:
    slip = rollout.states[..., 3] - rollout.states[..., 2]
    return SlidingBox().on_box(rollout.states) * (2 + (np.abs(slip) < 0.1))


def tennis_events(rollout: Rollout) -> np.ndarray:
    """Impacts per step."""
    return Tennis().impacts(rollout.states[..., :-1, :], rollout.controls)


BALL = np.array([0.6, 0.75, -0.15, -0.5, 0.2, 0.03, -0.04])  # on its way down to the paddle
ROLLOUTS = {
    "pusher": RolloutCase(
        Pusher(100.0), np.array([0.0, 0.98, 0.1, -0.2]), 0.3 * RNG.standard_normal((60, 1)),
        np.array([[-0.8, 0.5, -0.3, 0.1]]), _pusher_events, 1e-5,
    ),
    "sliding_box": RolloutCase(
        SlidingBox(), np.array([0.0, 0.005, 0.1, 0.15]), 0.6 + 0.3 * RNG.standard_normal((100, 1)),
        np.array([[-0.2, 0.4, -0.3, 0.1]]), _sliding_box_events, 5e-5,
    ),
    "double_pendulum": RolloutCase(
        DoublePendulum(timestep=0.01), np.array([1.5, 0.2, 2.0, -3.0]), np.zeros((100, 0)), None, _no_events
    ),
    "tennis": RolloutCase(
        Tennis(), BALL, 0.05 * RNG.standard_normal((45, 3)), 0.05 * RNG.standard_normal((3, 7)), tennis_events, 1e-5
    ),
    "linear_quadratic": RolloutCase(
        LINEAR_QUADRATIC, RNG.standard_normal(3), RNG.standard_normal((8, 2)), 0.3 * RNG.standard_normal((2, 3)),
        _no_events,
    ),
    "pusher, impedance": RolloutCase(
        ImpedancePusher(100.0), np.array([0.0, 0.98, 0.1, -0.2]), INPUTS["swell"], np.zeros((1, 4)), _pusher_events,
        1e-5,
    ),
}  # fmt: skip
