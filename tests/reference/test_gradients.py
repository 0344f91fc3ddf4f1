"""Every derivative by hand against extrapolated central differences, to 1e-8."""

import numpy as np
import pytest

from mjx_study.reference import Rollout, Tennis, roll_out, value_and_gradients
from tests.pusher_fixtures import relative
from tests.reference.systems import ROLLOUTS, STEPS, RolloutCase, StepCase, differentiate

TOLERANCE = 1e-8  # relative to a column's norm; truncation and rounding of the quotients are below 1e-10 of it
STEP = 1e-4
steps = pytest.mark.parametrize("case", STEPS.values(), ids=STEPS.keys())
rollouts = pytest.mark.parametrize("case", ROLLOUTS.values(), ids=ROLLOUTS.keys())


def test_impacts_happen_inside_the_steps():
    counts = {name: STEPS[name].system.impacts(*STEPS[name][1:]) for name in STEPS if "tennis" in name}  # type: ignore[attr-defined]
    assert np.all(counts["tennis, flight"] == 0) and np.all(counts["tennis, impact"] >= 1)
    assert np.all(counts["tennis, several impacts"] >= 1) and np.sum(counts["tennis, several impacts"] >= 2) >= 20


@steps
def test_jacobians(case: StepCase):
    system, states, controls = case
    over_state, over_control = system.jacobians(states, controls)
    assert over_state.shape == (len(states), system.num_states, system.num_states)
    assert over_control.shape == (len(states), system.num_states, system.num_controls)

    def columns(jacobian, shifted, size):
        for column, axis in enumerate(np.eye(size)):
            expected = differentiate(lambda shift, axis=axis: shifted(shift * axis), STEP)
            for row in range(len(states)):
                bound = TOLERANCE * max(1.0, float(np.linalg.norm(jacobian[row, :, column])))
                assert np.linalg.norm(jacobian[row, :, column] - expected[row]) <= bound

    if isinstance(system, Tennis):  # a ball that just touches once more within a quotient would be no derivative
        counts = system.impacts(states, controls)
        steady = np.ones(len(states), bool)
        for axis in np.eye(7):
            for shift in (-STEP, STEP):
                steady &= system.impacts(states + shift * axis, controls) == counts
                steady &= system.impacts(states, controls + shift * axis[:3]) == counts
        assert steady.sum() >= 0.7 * len(states)
        states, controls = states[steady], controls[steady]
        over_state, over_control = over_state[steady], over_control[steady]
    columns(over_state, lambda shift: system.step(states + shift, controls), system.num_states)
    columns(over_control, lambda shift: system.step(states, controls + shift), system.num_controls)


@steps
def test_cost_gradients(case: StepCase):
    system, states, controls = case
    over_state, over_control = system.cost_gradients(states, controls)
    final = system.final_gradient(states)
    for column, axis in enumerate(np.eye(system.num_states)):
        expected = differentiate(lambda shift, axis=axis: system.cost(states + shift * axis, controls), STEP)
        np.testing.assert_allclose(over_state[:, column], expected, rtol=TOLERANCE, atol=TOLERANCE)
        expected = differentiate(lambda shift, axis=axis: system.final_cost(states + shift * axis), STEP)
        np.testing.assert_allclose(final[:, column], expected, rtol=TOLERANCE, atol=TOLERANCE * np.abs(final).max())
    for column, axis in enumerate(np.eye(system.num_controls)):
        expected = differentiate(lambda shift, axis=axis: system.cost(states, controls + shift * axis), STEP)
        np.testing.assert_allclose(over_control[:, column], expected, rtol=TOLERANCE, atol=TOLERANCE)


@rollouts
@pytest.mark.parametrize("argument", ["start", "controls", "feedback"])
def test_gradients_of_a_rollout(case: RolloutCase, argument: str):
    arguments = {"start": case.start, "controls": case.controls, "feedback": case.feedback}
    point = arguments[argument]
    value, gradients = value_and_gradients(case.system, **arguments)
    exact = getattr(gradients, argument)
    if point is None or point.size == 0:
        assert exact is None or exact.size == 0
        return
    rng = np.random.default_rng(1)
    events = case.events(roll_out(case.system, **arguments))

    def shifted(shift: float, direction: np.ndarray) -> np.ndarray:
        rollout: Rollout = roll_out(case.system, **{**arguments, argument: point + shift * direction})
        np.testing.assert_array_equal(case.events(rollout), events, "straddles an event")
        return rollout.value

    assert roll_out(case.system, **arguments).value == value
    axes = np.eye(point.size)[:4].reshape(-1, *point.shape)
    for direction in [*axes, *rng.standard_normal((4, *point.shape))]:
        direction = direction / np.linalg.norm(direction)
        expected = differentiate(lambda shift, along=direction: shifted(shift, along), case.step)
        assert abs(np.sum(exact * direction) - expected) <= TOLERANCE * np.linalg.norm(exact)


def test_the_rollouts_meet_events():
    """The tennis ball is hit, the pusher touches and parts, the block slips, sticks and falls off."""
    kinds = {}
    for name, case in ROLLOUTS.items():
        rollout = roll_out(case.system, case.start, case.controls, case.feedback)
        kinds[name] = set(case.events(rollout).ravel().tolist())
    assert kinds["tennis"] == {0, 1} and kinds["pusher"] == {True, False} and kinds["sliding_box"] == {0, 2, 3}


@pytest.mark.parametrize("name", [name for name, case in ROLLOUTS.items() if case.feedback is not None])
def test_feedback_is_the_same_as_the_controls_it_applies(name: str):
    case = ROLLOUTS[name]
    assert case.feedback is not None
    closed = roll_out(case.system, case.start, case.controls, case.feedback)
    applied = case.controls + closed.states[:-1] @ case.feedback.T
    np.testing.assert_allclose(closed.controls, applied, rtol=1e-12)
    np.testing.assert_array_equal(roll_out(case.system, case.start, closed.controls).states, closed.states)


@rollouts
def test_batches_of_starts_and_controls_are_broadcast(case: RolloutCase):
    rng = np.random.default_rng(2)
    starts = case.start + 1e-3 * rng.standard_normal((3, 1, len(case.start)))
    controls = case.controls + 1e-3 * rng.standard_normal((2, *case.controls.shape))
    values, gradients = value_and_gradients(case.system, starts, controls, case.feedback)
    assert values.shape == (3, 2) and gradients.start.shape == (3, 2, len(case.start))
    for first, second in np.ndindex(3, 2):
        alone, parts = value_and_gradients(case.system, starts[first, 0], controls[second], case.feedback)
        assert values[first, second] == pytest.approx(alone, rel=1e-12)
        for name in ("start", "controls", "feedback"):
            if getattr(parts, name) is not None and getattr(parts, name).size:
                assert relative(getattr(gradients, name)[first, second], getattr(parts, name)) < 1e-9


@pytest.mark.parametrize(
    ("start", "controls", "feedback", "match"),
    [
        (np.zeros(3), np.zeros((5, 1)), None, r"an axis of 4 states, got shape \(3,\)"),
        (np.zeros(4), np.zeros((5, 2)), None, r"\(..., horizon, 1\), got shape \(5, 2\)"),
        (np.zeros(4), np.zeros((5, 1)), np.zeros((4, 1)), r"must be \(1, 4\), got shape \(4, 1\)"),
    ],
)
def test_shapes_that_do_not_match_are_refused(start, controls, feedback, match):
    with pytest.raises(ValueError, match=match):
        roll_out(STEPS["pusher"].system, start, controls, feedback)
