"""Tennis: exact impact times, elastic impacts in the paddle's frame, and the distribution of starts."""

import jax
import numpy as np
import pytest

from mjx_study.reference import Tennis, draw_start, roll_out
from tests.estimators.statistics_helpers import assert_mean_is
from tests.reference.systems import tennis_impacts

SUBSTEPS = 100_000


def rotation(angle: np.ndarray) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def brute_force(system: Tennis, state: np.ndarray, control: np.ndarray) -> tuple[np.ndarray, int]:
    """The step by watching the ball in the paddle's own frame at 1e5 instants, and turning its velocity there.

    Between two instants the crossing is interpolated: an error in time of (h / 1e5)^2 times curvature over speed.
    """
    ball, velocity, paddle, angle, now = state[:2], state[2:4], state[4:6], state[6], 0.0
    count = 0
    while True:
        times = np.linspace(0, system.timestep - now, SUBSTEPS + 1)
        offset = ball[:, None] + velocity[:, None] * times - paddle[:, None] - control[:2, None] * times
        turn = rotation(angle + control[2] * times)
        along, height = np.einsum("ijt,it->jt", turn, offset)
        gap = np.abs(height) - system.half_height - system.radius
        gap[0] = max(gap[0], 0.0) if gap[0] > -1e-9 else gap[0]
        entries = np.flatnonzero((gap[:-1] >= 0) & (gap[1:] < 0))
        if len(entries) == 0 or abs(along[entries[0]]) > system.half_width:
            break
        index = entries[0]
        time = times[index] + (times[1] - times[0]) * gap[index] / (gap[index] - gap[index + 1])
        count += 1
        ball, paddle, angle, now = (
            ball + time * velocity,
            paddle + time * control[:2],
            angle + time * control[2],
            now + time,
        )
        lever = ball - paddle
        surface = control[:2] + control[2] * np.array([-lever[1], lever[0]])
        local = rotation(angle).T @ (velocity - surface)
        velocity = surface + rotation(angle) @ (local * [1, -1])
    rest = system.timestep - now
    end = [ball + rest * velocity, system.damping * velocity, paddle + rest * control[:2], [angle + rest * control[2]]]
    return np.concatenate(end), count


@pytest.mark.parametrize(
    ("options", "most"), [({"seed": 5}, 2), ({"seed": 6, "tangential": 8.0, "spin": 8.0, "latest": 0.3}, 4)]
)
def test_a_step_is_exact(options, most):
    system = Tennis()
    states, controls, _, _ = tennis_impacts(system, 30, **options)
    counts = system.impacts(states, controls)
    after = system.step(states, controls)
    assert counts.min() >= 1 and counts.max() <= most
    compared = 0
    for state, control, count, result in zip(states, controls, counts, after, strict=True):
        expected, watched = brute_force(system, state, control)
        if count < 4:  # more are not looked for
            compared += 1
            assert watched == count
            # (5e-7 s)^2 times 100 m/s^2 over 0.1 m/s, times relative speeds of up to 10 m/s and a few impacts.
            np.testing.assert_allclose(result, expected, rtol=0, atol=1e-8)
    assert compared >= 25


def test_time_of_impact_is_exact():
    """Not damped, the ball at the end of the step tells when it turned: to rounding, by construction of the states."""
    system = Tennis(damping=1.0)
    states, controls, time, _ = tennis_impacts(system, 200)
    once = system.impacts(states, controls) == 1
    after = system.step(states, controls)
    change = after[:, 2:4] - states[:, 2:4]
    late = after[:, :2] - states[:, :2] - system.timestep * states[:, 2:4]  # = (h - time) change
    remaining = np.sum(late * change, axis=1) / np.sum(change**2, axis=1)
    assert once.sum() > 150
    np.testing.assert_allclose(remaining[once], system.timestep - time[once], rtol=0, atol=1e-14)


def test_only_the_faces_are_solid():
    system, still = Tennis(), np.zeros((6, 3))
    reach = system.half_height + system.radius
    states = np.zeros((6, 7))
    states[:, 1], states[:, 3] = reach + 0.01, -1.0
    states[1, 1], states[1, 3] = -reach - 0.01, 1.0  # from below
    states[2, 0] = system.half_width + 1e-6  # past the edge
    states[3, 0] = system.half_width - 1e-6
    states[4, 1] = reach - 0.01  # between the planes of the faces
    states[5, 3] = 1.0  # on its way out
    np.testing.assert_array_equal(system.impacts(states, still), [1, 1, 0, 1, 0, 0])
    np.testing.assert_allclose(system.step(states, still)[:, 3], 0.999 * np.array([1, -1, -1, 1, -1, 1]))


def test_an_impact_at_the_end_of_a_step_counts_once():
    """The ball then starts the next step on the face, up to rounding."""
    system, control = Tennis(damping=1.0), np.zeros(3)
    for distance in np.nextafter(0.05 + system.half_height + system.radius, [-1, 0.25, 1]):
        state, counts = np.array([0.1, distance, 0.0, -1.0, 0.0, 0.0, 0.0]), []
        for _ in range(3):
            counts.append(int(system.impacts(state, control)))
            state = system.step(state, control)
        assert sum(counts) == 1 and state[3] == 1.0


@pytest.mark.parametrize(("before", "after"), [(0.0, 0.3), (0.3, 0.3)])
def test_an_impact_jumps_where_it_passes_to_the_next_step(before: float, after: float):
    """By twice the change of the command, and by the damping on the other side of the impact."""
    system, steps, switch = Tennis(), 20, 10
    controls = np.zeros((steps, 3))
    controls[:switch, 1], controls[switch:, 1] = before, after
    flown = system.timestep * np.sum(system.damping ** np.arange(switch))  # by the ball at -1 m/s, until the switch
    height = system.half_height + system.radius + before * switch * system.timestep + flown
    starts = np.zeros((2, 7))
    starts[:, 1], starts[:, 3] = height + 1e-9 * np.array([-1, 1]), -1.0
    early, late = roll_out(system, starts, controls).states[:, -1, 3]
    kept = system.damping ** (steps - switch)
    paddle_early = 2 * before * system.damping ** (steps - switch + 1)
    assert late - early == pytest.approx(2 * after * kept - paddle_early, rel=1e-9)
    assert abs(late - early) > 1e-4


def test_starts_are_as_described():
    samples = np.asarray(jax.vmap(draw_start)(jax.random.split(jax.random.key(0), 100_000)))
    assert samples.shape == (100_000, 7) and samples.dtype == np.float64
    x, y = samples[:, 0], samples[:, 1]
    assert -2 <= x.min() < -1.999 and 1.999 < x.max() <= 2
    centred = np.column_stack([x, y - 2, samples[:, 2] + 0.2 * x, samples[:, 3] + 0.2 * y, samples[:, 4:]])
    deviations = np.array([2 / np.sqrt(3), 0.2, 0.03, 0.03, 0.5, 0.05, 0.05])
    scaled = centred / deviations
    assert_mean_is(scaled, np.zeros(7))
    products = scaled[:, :, None] * scaled[:, None, :]
    assert_mean_is(products.reshape(len(products), -1), np.eye(7).ravel())
