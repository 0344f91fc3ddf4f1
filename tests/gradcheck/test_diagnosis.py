"""Every verdict on an entry, and its threshold."""

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest

from mjx_study.gradcheck import diagnosis
from mjx_study.gradcheck.coordinates import Coordinates, make_coordinates
from mjx_study.gradcheck.diagnosis import (
    VERDICTS,
    disagreements,
    judge,
    modes_apart,
    resolved_by,
    worst_error,
)
from mjx_study.gradcheck.differences import Differences
from tests.scenes import scene_of

CART = """<mujoco><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/><geom size=".1"/></body>
</worldbody><actuator><motor name="push" joint="x"/></actuator></mujoco>"""


@cache
def layout() -> Coordinates:
    """One slide joint and one motor: outputs (qpos, qvel), inputs (qpos, qvel, ctrl)."""
    return make_coordinates(scene_of(CART), None)


TRUE = np.array([[1.0, 0.01, 1e-4], [0.5, 1.0, 0.01]])


def verdict(
    entry: float,
    *,
    value: float = 0.5,
    uncertainty: float = 0.0,
    gap: float = 0.0,
    kink: bool = False,
    jump: bool = False,
    converged: float | None = None,
) -> str:
    """The verdict on d qvel / d qpos, everything else right."""
    derivative, truth = TRUE.copy(), TRUE.copy()
    derivative[1, 0], truth[1, 0] = entry, value
    there = np.zeros_like(TRUE)
    there[1, 0] = 1
    exact = None
    if converged is not None:
        exact = TRUE.copy()
        exact[1, 0] = converged
    found = Differences(truth, uncertainty * there, gap * there, (kink * there) > 0, (jump * there) > 0, there < 0)
    codes = judge(layout(), derivative, found, exact)
    assert (np.delete(codes, 3) == diagnosis.RIGHT).all()
    return VERDICTS[codes[1, 0]]


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("entry", "expected", "differences"),
    [
        (0.5, "right", {}),
        (0.5 * (1 + 0.9e-6), "right", {}),
        (0.5 * (1 + 1.1e-5), "wrong", {}),
        (0.51, "wrong", {}),
        (0.51, "right", {"uncertainty": 0.004}),
        # as small as its uncertainty, unless differences are zero as well
        (0.5, "right", {"uncertainty": 0.1}),
        (0.5, "unresolved", {"uncertainty": 0.2}),
        (0.0, "unresolved", {"value": 0.1, "uncertainty": 0.2}),
        (0.0, "right", {"value": 0.0, "uncertainty": 0.2}),
        (0.0, "zero", {}),
        (0.0, "right", {"value": 0.0}),
        # differences that are not a number contradict nothing
        (0.5, "unresolved", {"value": NAN}),
        (0.0, "unresolved", {"value": NAN}),
        # nothing excuses a derivative that is not a number
        (NAN, "nan", {}),
        (INF, "nan", {}),
        (NAN, "nan", {"kink": True, "jump": True, "gap": 1.0}),
        # zero is one of the slopes 0 and 1, but neither of the slopes 0.4 and 0.6
        (0.75, "kink", {"kink": True, "gap": 0.5}),
        (2.0, "wrong", {"kink": True, "gap": 0.5}),
        (0.0, "kink", {"kink": True, "gap": 1.0}),
        (0.0, "zero", {"kink": True, "gap": 0.2}),
        (7.0, "jump", {"jump": True}),
        (0.0, "jump", {"jump": True}),
        (0.51, "unconverged", {"converged": 0.5}),
        (0.51, "wrong", {"converged": 0.51}),
    ],
)
def test_verdicts(entry: float, expected: str, differences: dict[str, Any]) -> None:
    assert verdict(entry, **differences) == expected


def test_a_degenerate_contact_excuses_its_entries_that_jump() -> None:
    """Not an entry where differences are smooth, nor one that does not depend on it."""
    derivative, rough = TRUE.copy(), TRUE < 0
    derivative[1] *= 2
    rough[1, :2] = True
    none, never = np.zeros_like(TRUE), np.zeros(TRUE.shape, bool)
    truth = Differences(TRUE, none, none, never, never, rough)
    entered = np.array([[True, False, True], [True, False, True]])
    codes = judge(layout(), derivative, truth, degenerate=entered)
    assert [VERDICTS[code] for code in codes[1]] == ["jump", "wrong", "wrong"]


def test_the_engine_is_a_judge() -> None:
    none, never = np.zeros_like(TRUE), np.zeros(TRUE.shape, bool)
    right = Differences(TRUE, none, none, never, never, never)
    theirs = TRUE.copy()
    theirs[1, 0] *= 1.01
    ours, engine = (judge(layout(), TRUE, right), judge(layout(), TRUE, dataclasses.replace(right, value=theirs)))
    found = disagreements(ours, right, engine, right)
    assert np.argwhere(found).tolist() == [[1, 0]]
    rough = dataclasses.replace(right, kink=found)
    assert not disagreements(ours, right, engine, rough).any()
    vague = judge(layout(), TRUE, dataclasses.replace(right, uncertainty=np.ones_like(TRUE)))
    assert (vague == diagnosis.UNRESOLVED).all() and (resolved_by(vague, ours) == diagnosis.RIGHT).all()


def test_the_error_leaves_out_unresolved_entries() -> None:
    none, never = np.zeros_like(TRUE), np.zeros(TRUE.shape, bool)
    truth = Differences(TRUE * (1 + 1e-7), none, none, never, never, never)
    right, columns = np.full(TRUE.shape, diagnosis.RIGHT), range(TRUE.shape[1])
    assert worst_error(layout(), TRUE, truth, right, columns) == pytest.approx(1e-7, rel=1e-3)
    vague = dataclasses.replace(truth, uncertainty=np.full_like(TRUE, 1e-3))
    assert worst_error(layout(), TRUE, vague, right, columns) == 0.0


def test_modes_are_compared_by_rows_and_blocks() -> None:
    other = TRUE.copy()
    assert modes_apart(layout(), TRUE, other) == 0
    other[1, 2] *= 1 + 1e-5
    assert modes_apart(layout(), TRUE, other) == pytest.approx(1e-5, rel=1e-3)
    other[1, 2] = np.nan  # a finding of its own
    assert modes_apart(layout(), TRUE, other) == 0
