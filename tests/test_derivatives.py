"""The table of derivatives: tasks, contact families and cones, each step and each whole-horizon gradient checked.

Families share the programs of a task, so a row costs one compilation; frictionless tasks have one cone only, since MJX
has no frictionless contact with an elliptic cone.
"""

import jax.numpy as jnp
import pytest

from mjx_study.gradcheck import gradcheck, plan_gradcheck
from mjx_study.tasks import make_task

FAMILIES = ("penalty", "impedance", "mujoco_default", "mujoco_stiff", "smooth_onset")
SMOOTH = 1e-6
"""Relative error of a step's Jacobian against differences where the step is smooth."""
slow = pytest.mark.slow
ROWS = [
    pytest.param("pusher", "pyramidal", 40, 100.0, id="pusher", marks=slow),
    pytest.param("sliding_box", "elliptic", 60, 500.0, id="sliding_box elliptic", marks=slow),
    pytest.param("sliding_box", "pyramidal", 60, 500.0, id="sliding_box pyramidal", marks=slow),
    pytest.param("ball_wall", "elliptic", 100, 3000.0, id="ball_wall elliptic", marks=slow),
    pytest.param("ball_wall", "pyramidal", 100, 3000.0, id="ball_wall pyramidal", marks=slow),
    pytest.param("ball_wall:dome", "elliptic", 100, 3000.0, id="ball_wall:dome", marks=slow),
    pytest.param("momentum_transfer", "pyramidal", 230, 10000.0, id="momentum_transfer", marks=slow),
    pytest.param("tennis", "pyramidal", 120, 4000.0, id="tennis", marks=slow),
    pytest.param("landing", "elliptic", 60, 5000.0, id="landing", marks=slow),
    pytest.param("gripper", "elliptic", 30, 1000.0, id="gripper", marks=slow),
]
# Parameters of a rollout in which contact happens, within few steps; those of the task itself otherwise.
THETA = {"sliding_box": 0.3, "ball_wall": 0.15, "ball_wall:dome": 0.15, "momentum_transfer": 0.3}
# Where a sphere of 1 kg meets a paddle of 1,000 kg, a force is a slack of 0.007 m/s^2 times 5e7, the derivative of D
# over d_width, and the slack is a difference of numbers near 74, whose rounding is 1.4e-14. XLA computes it once per
# entry, in vectors or not, and so rounds it differently: 7.7e-9 of the row's largest derivative.
MODES = {"tennis": 1e-8}


@pytest.mark.parametrize(("name", "cone", "horizon", "stiffness"), ROWS)
def test_steps_and_gradients_are_right(name: str, cone: str, horizon: int, stiffness: float) -> None:
    task = make_task(name, cone=cone, horizon=horizon)
    if name in THETA:
        task = task.replace(theta=jnp.full_like(task.theta, THETA[name]))
    report = gradcheck(plan_gradcheck(task, FAMILIES, [stiffness], seed=0, states=3))
    assert [check.contact for check in report.steps] == [check.contact for check in report.costs] == list(FAMILIES)
    assert report.passed, "\n".join(report.lines())
    for step in report.steps:
        assert step.differences <= SMOOTH and step.modes < MODES.get(name, 1e-9) and step.residual < 1e-6, step
    for cost in report.costs:
        assert cost.gradient_norm > 0 and cost.modes < 1e-9, cost
        assert cost.difference <= SMOOTH or cost.verdict in ("kink", "jump"), cost


@pytest.mark.slow
def test_without_contact() -> None:
    report = gradcheck(plan_gradcheck(make_task("double_pendulum", horizon=100), None, None, seed=0, states=3))
    (step,), (cost,) = report.steps, report.costs
    assert report.passed and step.differences <= SMOOTH and cost.difference <= SMOOTH
