"""Differences over a ladder of steps find the derivative, or the kind of nonsmoothness."""

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_study.gradcheck.coordinates import make_coordinates
from mjx_study.gradcheck.differences import (
    SIZES,
    UNSEEN,
    Differences,
    moves,
    solution_noise,
    take_differences,
    unseen_moves,
    unsteady_outputs,
)
from mjx_study.gradcheck.programs import ContactCase, Programs
from mjx_study.simulation.engine import HostState
from tests.scenes import scene_of


def read(function: Callable[[np.ndarray], np.ndarray], noise: float = 0.0) -> Differences:
    """Differences of a function of one variable at zero, with rounding of a given size."""
    points = moves(np.ones((1, 1)))[:, 0]
    random = np.random.default_rng(0)
    return take_differences((function(points) + noise * random.normal(size=points.shape))[:, None])


def test_moves_are_the_ladder_both_ways() -> None:
    changes = moves(np.eye(2))
    assert changes.shape == (1 + 2 * 2 * len(SIZES), 2)
    assert not changes[0].any() and changes[1].tolist() == [SIZES[0], 0] and changes[2].tolist() == [0, SIZES[0]]
    np.testing.assert_array_equal(changes[1 : 1 + 2 * len(SIZES)], -changes[1 + 2 * len(SIZES) :])


@pytest.mark.parametrize("length", [1.0, 1e-2, 1e-3])
def test_a_smooth_function(length: float) -> None:
    """Down to the finest structure of MuJoCo's contact, a millimetre."""
    found = read(lambda x: np.exp(x / length), noise=1e-15)
    assert found.value[0, 0] * length == pytest.approx(1, abs=1e-6 * length**-0.5)
    assert abs(found.value[0, 0] - 1 / length) <= 3 * found.uncertainty[0, 0]
    assert not found.kink[0, 0] and not found.jump[0, 0]


def test_many_outputs_and_columns_keep_their_places() -> None:
    matrix = np.random.default_rng(1).normal(size=(3, 2))
    found = take_differences(moves(np.eye(2)) @ matrix.T)
    assert found.value.shape == (3, 2)
    np.testing.assert_allclose(found.value, matrix, rtol=1e-9)


@pytest.mark.parametrize("beyond", [np.nan, np.inf])
def test_long_steps_may_leave_the_domain(beyond: float) -> None:
    found = read(lambda x: np.where(x > -1e-4, np.sqrt(np.maximum(x + 1e-4, 0)), beyond))
    assert found.value[0, 0] == pytest.approx(50, rel=1e-6) and found.uncertainty[0, 0] < 1e-4
    assert not found.rough[0, 0]
    for edge in (0.0, 4e-7):  # no or too few steps stay within
        assert np.isnan(read(lambda x, edge=edge: np.where(x > -edge, x, beyond)).value[0, 0])


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e3])
def test_a_kink(scale: float) -> None:
    found = read(lambda x: scale * (np.abs(x) + 0.5 * x), noise=1e-16 * scale)
    assert found.kink[0, 0] and not found.jump[0, 0]
    assert found.value[0, 0] == pytest.approx(0.5 * scale, rel=1e-6)  # the mean of the slopes
    assert found.gap[0, 0] == pytest.approx(2 * scale, rel=1e-6)


def test_a_kink_with_curvature() -> None:
    found = read(lambda x: np.where(x > 0, np.expm1(300 * x), 0.0))
    assert found.kink[0, 0] and not found.jump[0, 0]
    assert found.gap[0, 0] == pytest.approx(300, rel=1e-3)


def test_a_nearby_kink_does_not_count() -> None:
    """Where short steps do not reach it, there is a derivative."""
    found = read(lambda x: 2 * x + np.maximum(x - 2e-6, 0.0), noise=1e-17)
    assert not found.kink[0, 0] and not found.jump[0, 0]
    assert found.value[0, 0] == pytest.approx(2, rel=1e-6)


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("size", [1e-6, 1.0])
def test_a_jump(side: str, size: float) -> None:
    found = read(lambda x: np.where(x > 0 if side == "right" else x >= 0, size, 0.0) + x)
    assert found.jump[0, 0] and not found.kink[0, 0]


def test_a_jump_that_is_odd() -> None:
    """Its one-sided slopes agree at every step."""
    found = read(lambda x: 1e-3 * np.sign(x) + x, noise=1e-17)
    assert found.jump[0, 0] and not found.kink[0, 0]
    assert found.gap[0, 0] > 100


def test_a_nearby_odd_jump_does_not_count() -> None:
    found = read(lambda x: 1e-3 * np.sign(x) * (np.abs(x) > 2e-6) + 2 * x, noise=1e-18)
    assert not found.jump[0, 0] and not found.kink[0, 0]
    assert found.value[0, 0] == pytest.approx(2, rel=1e-6)


def test_rounding_is_not_a_jump() -> None:
    found = read(lambda x: np.ones_like(x), noise=1e-16)
    assert not found.jump[0, 0] and not found.kink[0, 0]
    assert abs(found.value[0, 0]) <= found.uncertainty[0, 0]


def test_what_jumps_within_rounding_is_unsteady() -> None:
    """A steep output and one with rounding of its own are not, nor one that jumps farther away."""
    moves = unseen_moves(2)
    assert np.abs(moves).max() <= UNSEEN and np.linalg.matrix_rank(moves) == 2
    noise = np.array([0.0, 0.0, 1e-9, 0.0])
    outputs = lambda at: np.array([1e-6 * (at[0] > 2e-14), 1e6 * at[1], 1e-9 * np.sign(at[0]), at[0] > 1e-12])  # noqa: E731
    around = np.array([outputs(each) for each in moves])
    jacobian = np.array([[0.0, 0.0], [0.0, 1e6], [0.0, 0.0], [0.0, 0.0]])
    found = unsteady_outputs(outputs(np.zeros(2)), around, jacobian, noise)
    np.testing.assert_allclose(found, [1e-6, 0, 0, 0])


def test_forces_that_cancel_are_rounded() -> None:
    """Two constraints pull a slider apart: its velocity follows from their difference, which does not jump.

    Rounding of half the expected size looks like one unless that size is given.
    """
    pull = '<joint joint1="x" polycoef="{} 0 0 0 0"/>'
    xml = f"""<mujoco><worldbody><body><joint name="x" type="slide"/><geom size=".1" mass="1"/></body></worldbody>
    <equality>{pull.format(1e5)}{pull.format(1 - 1e5)}</equality><actuator><motor joint="x"/></actuator></mujoco>"""
    layout = make_coordinates(scene_of(xml), None)
    programs, case, ladder = Programs(layout), ContactCase(None, layout.scales), moves(np.eye(3)[2:])
    nothing, zero = np.zeros(0), np.zeros(1)
    state = HostState(zero, zero, nothing, zero, zero)
    for _ in range(2):  # the second time from the solution
        exact = programs.exact(case, state, jnp.zeros(1), ladder)
        state = dataclasses.replace(state, warmstart=exact.after.warmstart)
    noise = solution_noise(layout, exact.stages, state.warmstart)
    assert not take_differences(exact.outputs, noise).rough.any()
    rng = np.random.default_rng(0)
    for _ in range(10):
        rounded = exact.outputs + 0.5 * noise * rng.uniform(-1, 1, np.shape(exact.outputs))
        assert take_differences(rounded).rough.any()
        assert not take_differences(rounded, noise).rough.any()
