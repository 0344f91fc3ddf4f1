"""What the published examples chose, offered beside the defaults: constants of AoBG's bound, and a pendulum's start."""

from typing import Any

import jax
import numpy as np
import pytest

from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.resolution import configured_estimators
from mjx_study.experiment.study import estimators_of
from mjx_study.options.configuration import StudyConfig
from mjx_study.reference import DoublePendulum, roll_out
from mjx_study.reference.system import gradients_along
from mjx_study.tasks import make_task

MOMENTUM = 4 / 1.1**2  # an elastic hit of a bar ten times as heavy, in units of the published cost
CONSTANTS = {
    "pusher": (1e8, 100.0),
    "sliding_box": (2e4, 100.0),
    "ball_wall": (0.01, 1.0),
    "ball_wall:dome": (0.01, 1.0),
    "momentum_transfer": (0.2 * MOMENTUM, MOMENTUM),
    "tennis": (1000.0, 1000.0),
}


@pytest.mark.parametrize("name", CONSTANTS)
def test_published_constants_on_the_scale_of_the_task_s_cost(name: str) -> None:
    """In the options that estimators get."""
    gamma, radius = CONSTANTS[name]
    holder = alpha_order(StudyConfig(tasks=(name,), published=True))
    assert (holder.gamma, holder.radius) == (pytest.approx(gamma), pytest.approx(radius))
    assert (holder.failure_probability, holder.variance_proxy) == (0.95, "second_moment")
    default = alpha_order(StudyConfig(tasks=(name,)))
    assert (default.gamma, default.failure_probability) == (pytest.approx(gamma), 0.05)
    assert (default.radius, default.variance_proxy) == ("max_deviation", "variance")


def alpha_order(config: StudyConfig) -> Any:
    plan = plan_study(config)
    return estimators_of(plan, plan.cells[0])[2]


@pytest.mark.parametrize("kind", ["gradients", "descents", "landscapes"])
def test_every_study_takes_them(kind: str) -> None:
    changes: dict[str, Any] = {"points": 3} if kind == "landscapes" else {}
    assert alpha_order(StudyConfig(tasks=("tennis",), kind=kind, published=True, **changes)).radius == 1000.0


def test_what_they_do_to_the_weight_of_first_order_gradients() -> None:
    """More of it in momentum_transfer, whose bound is wider read so; none in ball_wall, whose R = 1 is far out."""
    alphas = {}
    for name in ("momentum_transfer", "ball_wall"):
        task = make_task(name)
        objective = task.analytic(task.defaults.middle_stiffness)
        for published in (False, True):
            config = StudyConfig(tasks=(name,), estimators=("aobg",), published=published)
            (estimator,) = configured_estimators(config, task)
            combine = jax.jit(lambda drawn, estimator=estimator: estimator(drawn).alpha)
            for seed in range(20):
                keys = jax.random.split(jax.random.key(seed), 100)
                batches = {
                    "evaluation": objective.evaluate(task.theta, keys[:50]),
                    "differentiation": objective.differentiate(task.theta, keys[50:]),
                }
                alphas.setdefault((name, published), []).append(float(combine(batches).alpha))
    mean = {key: np.mean(values) for key, values in alphas.items()}
    assert mean["momentum_transfer", True] > 0.3 + mean["momentum_transfer", False]
    assert mean["ball_wall", False] > 0.1 and mean["ball_wall", True] == 0


def test_the_published_pendulum_starts_where_its_absolute_angles_are() -> None:
    default, published = (
        np.asarray(make_task(name).theta) for name in ("double_pendulum", "double_pendulum:published")
    )
    absolute = np.array([[1, 0, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]])
    np.testing.assert_allclose(absolute @ published, [np.pi / 2, 0, 5, -5], rtol=0, atol=1e-15)
    np.testing.assert_allclose(default, [np.pi / 2, 0, 5, -5])
    with pytest.raises(ValueError, match="unknown start of double_pendulum 'upright'; choose from default, published"):
        make_task("double_pendulum", start="upright")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "before", "after"), [("", 850, 1200), (":published", 1050, 1450)])
def test_where_chaos_overtakes(name: str, before: int, after: int) -> None:
    """The horizon at which FoBG's variance passes ZoBG's: about 1050 steps, and 1250 from the published start."""
    task, system = make_task(f"double_pendulum{name}"), DoublePendulum()
    noise = 0.5 * np.random.default_rng(0).standard_normal((1000, 4))
    start = np.asarray(task.theta)
    ratios = []
    for horizon in (before, after):
        rollout = roll_out(system, start + noise, np.zeros((horizon, 0)))
        silent = roll_out(system, start, np.zeros((horizon, 0)))
        zeroth = (rollout.value - silent.value)[:, None] * noise / 0.5**2
        first = gradients_along(system, rollout).start
        ratios.append(np.var(first, axis=0).sum() / np.var(zeroth, axis=0).sum())
    assert ratios[0] < 0.7 and ratios[1] > 1.4
