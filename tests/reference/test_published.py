"""The analytic systems against the published ones: which are the same, and how each of the others differs.

`pusher` and `sliding_box` step the same maps, and equal the published code's numbers to 1e-10
(`tests/data/published_rollouts.json`). Of the others no such numbers are kept, since those systems are not the same;
the tests below state in what they differ, and docs/published-systems.md what that does:

- `ball_wall` and `momentum_transfer` are functions in closed form: the same ones where the published formulas hold, and
  others for launches into the ground and for a bar that gives way and throws the ball back;
- `tennis` finds impacts at their exact times, on a paddle of its own width, where the published one is wider in effect;
- `double_pendulum` has equations of motion that conserve energy, and angles that are relative and not wrapped.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from mjx_study.reference import BallWall, MomentumTransfer, Pusher, SlidingBox, Tennis, roll_out, value_and_gradients
from mjx_study.tasks import TASKS

PAGES = Path(__file__).parents[2] / "docs"
DATA = json.loads((Path(__file__).parents[1] / "data" / "published_rollouts.json").read_text())
CASES = [(name, case) for name in ("pusher", "sliding_box") for case in DATA[name]["cases"]]
OWN = ("gripper", "landing")
"""Systems of this project, which nobody has published."""
DIFFER = ("ball_wall", "momentum_transfer", "tennis", "double_pendulum")


def controls_of(case: str, horizon: int) -> np.ndarray:
    """The control sequence that a case names: a number, or sin(a t)."""
    label = case.split("u=")[1].split(" ")[0]
    if label.startswith("sin"):
        rate = float(label.removeprefix("sin(").removesuffix("t)"))
        return np.sin(rate * np.arange(horizon))[:, None]
    return np.full((horizon, 1), float(label))


def system_of(name: str, case: str) -> Pusher | SlidingBox:
    if name == "sliding_box":
        return SlidingBox()
    return Pusher(float(case.split(",")[0].removeprefix("k=")))


@pytest.mark.parametrize(("name", "case"), CASES, ids=[f"{name} {case}" for name, case in CASES])
def test_equals_the_published_system(name: str, case: str) -> None:
    settings, expected, system = DATA[name]["settings"], DATA[name]["cases"][case], system_of(name, case)
    horizon, start = settings["T"], np.array(settings["x0"], float)
    controls = controls_of(case, horizon)
    states = roll_out(system, start, controls).states
    value, gradients = value_and_gradients(system, start, controls)
    gradient, size = gradients.controls.ravel(), expected["grad_norm"]
    found = {"xT": states[horizon], "x100": states[100], "x200": states[200], "cost": value}
    found |= {"grad_norm": np.linalg.norm(gradient), "grad_sum": gradient.sum(), "grad_first3": gradient[:3]}
    found |= {f"grad_{index}": gradient[index] for index in (50, 100, 150)} | {"grad_last": gradient[-1]}
    if isinstance(system, SlidingBox):
        found["grad_50_100_200_300"] = gradient[[50, 100, 200, 300]]
        off = ~system.on_box(states)
        first = int(np.argmax(off)) if off.any() else None
        assert (off.sum(), first) == (expected["steps_out_of_contact"], expected["first_step_out_of_contact"])
    for key, number in expected.items():
        if not key.endswith("of_contact"):
            least = 1e-10 * (size if key.startswith("grad") else 1.0)
            np.testing.assert_allclose(found[key], number, rtol=1e-10, atol=least, err_msg=key)


@pytest.mark.parametrize("name", ["pusher", "sliding_box"])
def test_their_settings_are_the_published_ones(name: str) -> None:
    settings, system = DATA[name]["settings"], system_of(name, "k=10,")
    assert (system.timestep, system.mass, system.control_weight) == (settings["h"], settings["mass"], settings["R"])
    assert list(system.goal) == settings["xg"] and list(system.state_weight) == settings["Q"]
    if isinstance(system, Pusher):
        assert system.damping == settings["damping"]
    else:
        own = (system.viscosity, system.slip_tolerance, system.width)
        assert own == (settings["mu"], settings["vs"], settings["width"])


def test_every_task_states_its_differences_from_the_published_system() -> None:
    systems = {name.split(":")[0] for name in TASKS} - set(OWN)
    assert systems == {*DIFFER, "pusher", "sliding_box"}
    page = (PAGES / "published-systems.md").read_text()
    for name in systems:
        assert f"\n## {name}\n" in page


def published_range(angle: np.ndarray) -> np.ndarray:
    """Landing of the published ball: its range where that is short of the wall or clears it, else the wall."""
    speed, distance, height, gravity = 1.0, 0.06, 0.02, 9.81
    free = 2 * speed**2 * np.sin(angle) * np.cos(angle) / gravity
    at_wall = distance * np.tan(angle) - gravity * distance**2 / (2 * (speed * np.cos(angle)) ** 2)
    return np.where((free < distance) | (at_wall >= height), free, distance)


def test_ball_wall_differs_below_the_horizon_alone() -> None:
    """There the published formula has a range below 0, whose square is rewarded; here the ball stays on the ground."""
    above, below = np.linspace(1e-3, 1.57, 500), np.linspace(-0.7, -1e-3, 100)
    system = BallWall()
    np.testing.assert_allclose(system.value(above[:, None]), -(published_range(above) ** 2), rtol=1e-10, atol=1e-14)
    np.testing.assert_array_equal(system.value(below[:, None]), 0.0)
    assert np.all(published_range(below) ** 2 > 0)


def test_momentum_transfer_differs_by_restitution_and_a_bar_that_gives_way() -> None:
    angle = np.linspace(-1.0, 1.0, 401)
    hit = np.abs(angle) <= np.pi / 4
    published = np.where(hit, -(np.sin(angle) ** 2), 0.0)
    np.testing.assert_allclose(MomentumTransfer().value(angle[:, None]), published, rtol=1e-10, atol=1e-14)
    own = MomentumTransfer(restitution=1.0, inertia_ratio=0.1).value(angle[:, None])
    ratio = own[hit & (angle != 0)] / published[hit & (angle != 0)]
    assert ratio.max() == pytest.approx(4, rel=1e-4) and ratio.min() == pytest.approx(4 / 1.1**2, rel=1e-2)


def test_tennis_differs_where_a_ball_meets_the_paddle_between_its_half_widths() -> None:
    """At 0.9 m from the middle the published paddle, as wide as 0.8 m and the ball's radius, still hits."""
    state, still = np.array([0.0, 0.21, 0.0, -1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    for along, hits in ((0.7, (1, 1)), (0.9, (0, 1)), (1.0, (0, 0))):
        state[0] = along
        counts = [int(Tennis(half_width=width).impacts(state, still)) for width in (Tennis.half_width, 0.95)]
        assert tuple(counts) == hits
