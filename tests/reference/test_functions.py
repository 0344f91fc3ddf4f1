"""The scalar functions: their gradients, jumps and smoothing, and the ball against its trajectory."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from mjx_study.reference import (
    BallWall,
    Function,
    Heaviside,
    MomentumTransfer,
    RelaxedHeaviside,
    ScalarFunction,
    smoothed,
)
from tests.reference.functions import FUNCTIONS, FunctionCase, Square
from tests.reference.systems import differentiate

ANGLES = np.linspace(-np.pi, np.pi, 4001)
BARE: Any = SimpleNamespace(num_params=1, value=lambda x: x[..., 0], gradient=np.ones_like)
scalar = pytest.mark.parametrize("case", FUNCTIONS.values(), ids=FUNCTIONS.keys())


def value(function: Function, points) -> np.ndarray:
    return function.value(np.asarray(points)[..., None])


def distance_to_breakpoint(function: ScalarFunction, points: np.ndarray) -> np.ndarray:
    period = function.period if np.isfinite(function.period) else 100.0
    gaps = points[:, None] - np.array(function.breakpoints())
    return np.abs(gaps - period * np.round(gaps / period)).min(axis=1)


def expected_slope(function: ScalarFunction, theta: np.ndarray, sigma: float) -> float:
    """E f'(theta + w), by another quadrature between the breakpoints than `smoothed` uses."""
    centre = theta[0]
    cuts = {centre - 12 * sigma, centre + 12 * sigma, *(centre + sigma * np.arange(-6, 7))}
    cuts |= {point for point in function.breakpoints() if abs(point - centre) < 12 * sigma}

    def integrand(x: float) -> float:
        slope = function.gradient(np.array([x]))[0]
        return slope * np.exp(-((x - centre) ** 2) / (2 * sigma**2)) / (sigma * np.sqrt(2 * np.pi))

    edges = sorted(cuts)
    return sum(quad(integrand, low, high, epsabs=1e-13)[0] for low, high in zip(edges, edges[1:], strict=False))


@scalar
def test_gradient(case: FunctionCase):
    """Between breakpoints; which also says that no kink is missing from their list."""
    function = case.function
    points = ANGLES[distance_to_breakpoint(function, ANGLES) > 1e-3]
    assert len(points) > 3900
    expected = differentiate(lambda shift: value(function, points + shift), 5e-4)
    np.testing.assert_allclose(function.gradient(points[:, None])[:, 0], expected, rtol=1e-8, atol=1e-8)


@scalar
def test_jumps_are_all_there_and_of_their_size(case: FunctionCase):
    function = case.function
    for jump in function.jumps():
        above, below = value(function, [jump.position + 1e-9, jump.position - 1e-9])
        assert above - below == pytest.approx(jump.size, rel=1e-6)
        assert jump.position in function.breakpoints()
    # Elsewhere the function changes by no more than its slope allows.
    grid = np.linspace(-np.pi, np.pi, 400_001)
    change, width = np.diff(value(function, grid)), grid[1] - grid[0]
    steepest = max(1.0, float(np.abs(function.gradient(grid[:, None])).max()))
    leaps = grid[:-1][np.abs(change) > 2 * steepest * width]
    assert len(leaps) == len(function.jumps())
    for leap, jump in zip(leaps, function.jumps(), strict=True):
        assert abs(leap - jump.position) <= 2 * width


@scalar
def test_smoothed_gradient_is_the_derivative_of_the_smoothed_value(case: FunctionCase):
    exact = smoothed(*case)
    quotient = differentiate(
        lambda t: np.array(smoothed(case.function, case.theta + t, case.sigma).value), 0.01 * case.sigma
    )
    assert exact.gradient[0] == pytest.approx(float(quotient), rel=1e-8, abs=1e-9)


@scalar
def test_gradient_is_mean_slope_and_jump_term(case: FunctionCase):
    exact = smoothed(*case)
    scale = np.abs(exact.gradient[0]) + np.abs(exact.jump_term[0])
    assert exact.gradient[0] - exact.jump_term[0] == pytest.approx(expected_slope(*case), abs=1e-11 * max(1.0, scale))


def test_quadrature_is_exact_for_a_square():
    """F = theta^2 + sigma^2, through the same quadrature as the ball's."""
    exact = smoothed(Square(), np.array([1.3]), 0.4)
    assert exact.value == pytest.approx(1.3**2 + 0.4**2, rel=1e-13)
    assert exact.gradient[0] == pytest.approx(2.6, rel=1e-12)


@pytest.mark.parametrize("name", ["ball_wall", "momentum_transfer"])
def test_wide_noise_goes_round_the_circle(name: str):
    """With sigma beyond a turn every repetition of a jump counts; against the midpoint rule with 4e5 points."""
    function = FUNCTIONS[name].function
    sigma, centre = 2.0, 0.6
    edges = np.linspace(-9, 9, 400_001)
    z, width = (edges[:-1] + edges[1:]) / 2, edges[1] - edges[0]
    weight = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi) * width
    values, slopes = value(function, centre + sigma * z), function.gradient((centre + sigma * z)[:, None])[:, 0]
    exact = smoothed(function, np.array([centre]), sigma)
    # A jump inside a cell of the midpoint rule: its size times the cell, about 1e-5 / 2 for each.
    assert exact.value == pytest.approx(weight @ values, abs=1e-4 * np.abs(values).max())
    assert exact.gradient[0] == pytest.approx(weight @ (values * z) / sigma, abs=1e-4 * np.abs(values).max())
    missed = exact.gradient[0] - exact.jump_term[0]
    assert missed == pytest.approx(weight @ slopes, abs=1e-4 * np.abs(values).max())
    assert abs(exact.jump_term[0]) > 1e-3 * np.abs(values).max()


@pytest.mark.parametrize("name", ["ball_wall", "ball_wall, far", "ball_wall, high"])
def test_the_ball_lands_where_its_trajectory_does(name: str):
    """Brute force at 2e4 instants: the first of meeting the wall's line below its top, and touching the ground."""
    system = FUNCTIONS[name].function
    angles = np.linspace(-np.pi, np.pi, 721) + 1e-4
    landing = system.landing(angles[:, None])
    flight = 2 * system.speed / system.gravity
    time = np.linspace(0, flight, 20_001)[1:]
    tolerance = 2 * system.speed * time[0]
    near_jump = [np.abs(angles - jump.position) < 2e-3 for jump in system.jumps()]
    for index, angle in enumerate(angles):
        x = system.speed * np.cos(angle) * time
        y = system.speed * np.sin(angle) * time - system.gravity * time**2 / 2
        aground = np.flatnonzero(y < 0)[0]
        at_wall = np.flatnonzero((x >= system.distance) & (y >= 0))
        blocked = len(at_wall) and at_wall[0] < aground and y[at_wall[0]] < system.height
        expected = system.distance if blocked else x[aground]
        if not any(near[index] for near in near_jump):
            assert abs(landing[index] - expected) <= tolerance, angle
    assert (len(system.jumps()) == 2) == (name == "ball_wall")


def test_the_published_landscape():
    """Jumps at 0.69 and 1.20 rad, highest reward at 45 degrees."""
    ball = BallWall()
    np.testing.assert_allclose([jump.position for jump in ball.jumps()], [0.6932038, 1.1993430], atol=1e-7)
    assert ANGLES[2000:][np.argmin(value(ball, ANGLES[2000:]))] == pytest.approx(np.pi / 4, abs=2e-3)


def test_momentum_transfer_against_the_collision_s_conservation_laws():
    """Solve for the velocities after: angular momentum about the foot is conserved, restitution gives the rest."""
    mass, speed, reach, inertia, restitution = 1.0, 2.0, 0.7, 4.9, 0.3
    system = MomentumTransfer(restitution=restitution, inertia_ratio=mass * reach**2 / inertia)
    for angle in (-0.6, 0.1, 0.5):
        height, towards = reach * np.tan(angle), speed * np.cos(angle)
        # m height (towards - after) = I spin and height spin - after = e towards, for the ball's velocity after.
        matrix = np.array([[mass * height, inertia], [-1.0, height]])
        _, spin = np.linalg.solve(matrix, [mass * height * towards, restitution * towards])
        expected = -((inertia * spin / (mass * speed * reach)) ** 2)
        assert value(system, [angle])[0] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: RelaxedHeaviside(0.0), "width must be positive and finite, got 0.0"),
        (lambda: BallWall(speed=0.0), "speed must be positive and finite, got 0.0"),
        (lambda: BallWall(distance=-1.0), "distance must be positive"),
        (lambda: MomentumTransfer(edge=2.0), "edge must be an angle between 0 and pi/2, got 2.0"),
        (lambda: MomentumTransfer(restitution=1.5), "restitution must be from 0 to 1, got 1.5"),
        (lambda: MomentumTransfer(inertia_ratio=-0.1), "inertia_ratio must not be negative, got -0.1"),
        (lambda: smoothed(Heaviside(), np.zeros(1), 0.0), "sigma must be positive and finite"),
        (lambda: smoothed(BARE, np.zeros(1), 1.0), "cannot be smoothed: it needs a method `smoothed`, or `period`"),
        (lambda: smoothed(Heaviside(), np.zeros(2), 1.0), r"theta must have shape \(1,\), got \(2,\)"),
    ],
)
def test_refuses(make, match):
    with pytest.raises((ValueError, TypeError), match=match):
        make()
