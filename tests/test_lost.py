"""Runs that could say nothing: refused before anything is compiled, or ended with the reason; samples lost by place."""

import dataclasses
import json
from collections.abc import Callable

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import xarray as xr

from mjx_study import cli
from mjx_study.bench import check_bench
from mjx_study.diagnose.measurement import measure
from mjx_study.diagnose.run import plan_diagnosis
from mjx_study.execution.lost import all_lost, first_nonfinite
from mjx_study.experiment.plan import plan_study
from mjx_study.objective import Simulator
from mjx_study.options.configuration import StudyConfig
from mjx_study.results.warnings import lost_samples
from mjx_study.simulation.dynamics import State, initial_state
from mjx_study.simulation.scene import put_scene
from mjx_study.tasks.policy import LinearFeedback, OpenLoop
from mjx_study.tasks.soundness import check_soundness
from mjx_study.tasks.task import StudyDefaults, Task
from tests.test_figures import along, study

FALLING = """
<mujoco model="falling"><option timestep="0.01"/>
  <worldbody><body name="ball"><geom size="0.1" mass="1"/>
    <joint name="z" type="slide" axis="0 0 1"/><joint name="x" type="slide" axis="1 0 0"/></body></worldbody>
  <actuator>{}</actuator></mujoco>
"""
MOTOR = '<motor joint="x"/>'


def height(state: State) -> jnp.ndarray:
    return state.qpos[0]


def falling(motors: str = MOTOR, **changes) -> Task:
    """A ball in free fall for 20 steps, pushed sideways."""
    scene = put_scene(mujoco.MjModel.from_xml_string(FALLING.format(motors)), "falling")
    policy = OpenLoop(20, scene.host.nu)
    task = Task(
        name="falling", scene=scene, horizon=20, policy=policy, theta=jnp.zeros(policy.num_params), sigma=0.1,
        start=initial_state(scene), final_cost=height, contact_pair=None, defaults=StudyDefaults(families=("mjcf",)),
    )  # fmt: skip
    return task.replace(**changes)


def lost() -> Task:
    return falling(final_cost=lambda state: height(state) / (state.qpos[1] == 0))


def wrong_in_step_ten(state: State, control: jnp.ndarray) -> jnp.ndarray:
    return jnp.where(state.qpos[0] < -0.05, jnp.log(state.qpos[0]), 0.0)


UNSOUND: dict[str, tuple[Callable[[], Task], str]] = {
    "empty": (lambda: falling(""), r"falling: theta has no entries \(the MJCF has no actuators\)"),
    "theta": (lambda: falling(theta=jnp.full(20, jnp.nan)), "falling: theta is not finite"),
    "start": (
        lambda: falling(start=initial_state(falling().scene, jnp.array([0.0, jnp.inf]))),
        "falling: the initial state is not finite",
    ),
    "running": (
        lambda: falling(running_cost=wrong_in_step_ten),
        "falling: the running_cost is nan at theta without noise, in step 10 of 20, where state and control are finite",
    ),
    "final": (
        lambda: falling(final_cost=lambda state: 1 / (state.qpos[1] * 0)),
        "falling: the final_cost is inf at theta without noise, where the state is finite",
    ),
}


@pytest.mark.parametrize("name", UNSOUND)
def test_what_cannot_be_studied_is_refused_before_it_is_compiled(name: str) -> None:
    make, message = UNSOUND[name]
    for plan in (
        check_soundness,
        lambda task: plan_study(StudyConfig(tasks=(task,), contact=("mjcf",))),
        lambda task: check_bench(task, 10),
        lambda task: plan_diagnosis("falling", task),
    ):
        with pytest.raises(ValueError, match=message):
            plan(make())


def test_sound_tasks_pass() -> None:
    feedback = LinearFeedback(20, 1, 2, lambda state: state.qvel)
    check_soundness(falling())
    check_soundness(falling(policy=feedback, theta=jnp.array([0.5, -1.0])))
    diverging = LinearFeedback(20, 1, 1, lambda state: 1e30 * (1 + state.qvel[1:]))
    check_soundness(falling(policy=diverging, theta=jnp.ones(1)))  # of a motion that overflows, the study says so


@pytest.mark.slow
def test_a_run_that_loses_all_samples_ends_with_the_reason(capsys: pytest.CaptureFixture[str]) -> None:
    options = "--samples 10 --reference-samples 10"
    assert cli.main(["compare", f"{__name__}:lost", *options.split()]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith(f"mjx-study: all samples are lost: {__name__}:lost, mjcf")
    assert last.endswith("the final_cost is -inf after step 20, where the state is finite")


def test_where_nothing_was_computed_or_descents_diverge_no_sample_is_blamed() -> None:
    (unwritten, descents), nan = (
        (
            plan_study(StudyConfig(tasks=("ball_wall",), contact=("reference",), kind=kind))
            for kind in ("gradients", "descents")
        ),
        ("seed", [np.nan]),
    )
    assert all_lost(unwritten, xr.Dataset()) is None
    diverged = xr.Dataset({"final_cost": nan, "start_cost": 2.0})
    assert str(all_lost(descents, diverged)).endswith("although that at the start is: use a lower --learning-rate")
    assert str(all_lost(descents, diverged.assign(start_cost=np.nan))).startswith("all samples are lost")


@pytest.mark.slow
def test_the_mean_cost_is_that_of_finite_samples() -> None:
    """About half of the pushes are in the direction in which the cost is infinite."""
    task = falling(final_cost=lambda state: jnp.where(state.qpos[1] > 0, jnp.inf, height(state)))
    found = measure(Simulator(task, chunk_size=8), None, samples=8)
    assert 0 < found.lost < found.samples and found.cost == pytest.approx(9.81 * 0.01**2 * 20 * 21 / 2)


def test_the_first_nonfinite_quantity_has_a_name() -> None:
    task, steps = falling(running_cost=lambda state, control: jnp.log(state.qpos[0] + 1)), np.zeros((21, 2))
    quiet = State(*(jnp.asarray(leaf) for leaf in (steps, steps, np.zeros((21, 0)), steps)))
    controls = jnp.zeros((20, 1))

    def told(task: Task = task, **changes) -> str:
        return first_nonfinite(task, dataclasses.replace(quiet, **changes), controls)

    late, later = steps.copy(), steps.copy()
    late[7:, 1], later[9:, 0] = np.nan, np.inf
    assert told(qvel=jnp.asarray(late), qpos=jnp.asarray(later)) == (
        "qvel of joint x (body ball) is not finite after step 7 of 20"
    )
    assert told(qpos=jnp.asarray(later)) == "qpos of joint z (body ball) is not finite after step 9 of 20"
    acts = np.zeros((21, 1))
    acts[3:] = np.nan
    assert told(act=jnp.asarray(acts)) == "act[0] is not finite after step 3 of 20"
    later[9:, 0] = -1
    assert told(qpos=jnp.asarray(later)) == "the running_cost is -inf in step 9 of 20, where the state is finite"
    final = falling(final_cost=lambda state: 1 / height(state))
    assert told(final) == "the final_cost is inf after step 20, where the state is finite"
    assert told().startswith("the costs are finite, their derivatives are not")


def test_lost_samples_are_told_by_contact_model_and_estimator() -> None:
    models = [("penalty", 10.0), ("penalty", 1e5), ("mujoco_default", 0.0)]
    lost = along("model", 0.0, 20.0, 1.0) * along("estimator", 0.0, 1.0, 1.0)
    variance = along("model", 1.0, 1e138, 2.0)
    first, second = lost_samples(study("gradients", models, nonfinite=lost, variance=variance))
    assert first == (
        "42 samples overflowed or became NaN and were left out, so that the rest are not random: "
        "penalty, K = 100000 N/m (FoBG 20, AoBG 20); mujoco_default (FoBG 1, AoBG 1)"
    )
    assert second.startswith("penalty, K = 100000 N/m: the motion explodes (numbers up to 1e+138)")
    assert lost_samples(study("gradients", models, nonfinite=0.0)) == []
    own = study("gradients", models, nonfinite=lost).assign_coords(estimator=["zobg", "mine", "aobg"])
    own.attrs["described"] = json.dumps({"mine": {"label": "Mine", "needs": ["pair"]}})  # registered in another process
    assert "(Mine 20, AoBG 20)" in lost_samples(own)[0]
