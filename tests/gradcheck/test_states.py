"""States exercise all parts of a model, or the missing parts are reported; with the C engine alone."""

import mujoco
import numpy as np
import pytest

from mjx_study.gradcheck.coverage import Coverage, Reach, contact_parts, possible
from mjx_study.gradcheck.states import CONTROL, Sample, states_of
from mjx_study.simulation.contact_pair import contact_pairs
from mjx_study.simulation.engine import host_state
from mjx_study.simulation.scene import Scene, load_scene
from tests.scenes import scene_of

FLOOR = '<geom name="floor" type="plane" size="5 5 .1"/>'
# A puck that rests on the floor and does not slide by itself; an arm that hangs far from its limits; dry friction.
PUCK = '<body pos="0 0 .099"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>'
ARM = """<body pos="2 0 2"><joint name="arm" axis="0 1 0" limited="true" range="-150 150" frictionloss=".3"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".1"/></body>"""


def sampled(world: str, count: int, option: str = "", **options) -> tuple[list[Sample], Coverage]:
    return states_of(scene(world, option), None, count, options.pop("horizon", 100), 0, **options)


def scene(world: str, option: str = "") -> Scene:
    return scene_of(f"<mujoco>{option}<worldbody>{world}</worldbody></mujoco>")


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_parts_that_a_slow_rollout_misses_are_searched(cone: str) -> None:
    samples, found = sampled(FLOOR + PUCK + ARM, 6, f'<option cone="{cone}"/>')
    assert found.missing == () and len(samples) == found.states == 6
    for part in ("stick", "slide", "limit", "held", "slipping"):
        assert found.counts[part] >= 1, found
    assert samples[0].label == "start, at rest" and any("pushed" in s.label or "pose" in s.label for s in samples)


@pytest.mark.parametrize(("low", "high", "key"), [(0, 20, 10), (0, 20, 0), (-1, 1, 0), (-3, -1, -1.5)])
def test_controls_stay_within_their_range(low: float, high: float, key: float) -> None:
    """Beyond it MuJoCo clips them, and every derivative is zero."""
    xml = f"""<mujoco><worldbody>{FLOOR + PUCK + ARM}</worldbody>
    <actuator><motor joint="arm" ctrllimited="true" ctrlrange="{low} {high}"/></actuator>
    <keyframe><key ctrl="{key}"/></keyframe></mujoco>"""
    samples, _ = states_of(scene_of(xml), None, 12, 100, 0)
    slow, pushed = (
        np.array([s.state.control[0] for s in samples[1:] if ("," in s.label) == elsewhere])
        for elsewhere in (False, True)
    )
    half, spread = (high - low) / 2, CONTROL * (high - low) / 2
    assert len(slow) and np.all(np.abs(slow - np.clip(key, low + spread, high - spread)) <= spread)
    assert len(pushed) and np.all(np.abs(pushed - low - half) <= half)


def test_an_equality_that_is_off_need_not_be_exercised() -> None:
    def parts(active: str) -> frozenset[str]:
        equality = f'<equality><joint joint1="arm" active="{active}"/></equality>'
        found = scene_of(f"<mujoco><worldbody>{ARM}</worldbody>{equality}</mujoco>")
        return possible(found, found.host)[0]

    assert "equality" in parts("true") and "equality" not in parts("false")


def test_an_unreached_part_is_reported() -> None:
    _, found = sampled(
        FLOOR.replace("/>", ' pos="0 0 -90"/>') + PUCK.replace("<freejoint/>", '<joint type="slide"/>'), 3
    )
    assert found.missing == ("contact",) and "contact in 0" in found.line()


def test_too_few_states_leave_parts_missing() -> None:
    samples, found = sampled(FLOOR + PUCK + ARM, 1)
    assert len(samples) == 1 and {"slide", "limit"} <= set(found.missing)


@pytest.mark.parametrize("count", [1, 4, 9])
@pytest.mark.parametrize("horizon", [1, 3, 50])
def test_the_number_of_states_is_as_requested(count: int, horizon: int) -> None:
    samples, _ = sampled(FLOOR + PUCK, count, horizon=horizon)
    assert len(samples) == count
    assert len({(tuple(s.state.qpos), tuple(s.state.qvel)) for s in samples}) == count


def test_a_tasks_own_states_come_first() -> None:
    pusher = load_scene("pusher")
    data = mujoco.MjData(pusher.host)
    data.qvel[0] = 0.1
    visited = []
    for _ in range(20):
        visited.append(host_state(data))
        mujoco.mj_step(pusher.host, data)
    samples, found = states_of(pusher, None, 4, 20, 0, visited)
    assert [sample.label.partition(" ")[0] for sample in samples] == ["start", "step", "step", "step"]
    assert found.missing == ()
    for sample in samples:
        np.testing.assert_array_equal(sample.state.qpos, visited[sample.index].qpos)


UPRIGHT = '<joint type="slide" axis="0 0 1"/>'


def puck(joints: str = UPRIGHT, geom: str = "") -> str:
    return f'<body pos="0 0 .15">{joints}<geom size=".1" mass="1" {geom}/></body>'


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_a_body_that_can_only_fall_need_not_slide(cone: str) -> None:
    option = f'<option cone="{cone}"/>'
    _, found = sampled(FLOOR + puck(), 4, option)
    assert found.missing == () and found.unreachable == {"slide": 1} and "slide" not in found.counts
    assert found.line().endswith("; slide out of reach of the only pair of geoms")
    for more in ('<joint type="slide" axis="1 0 0"/>', '<joint axis="0 1 0"/>'):
        _, found = sampled(FLOOR + puck(UPRIGHT + more), 4, option)
        assert not found.unreachable and {"slide"} <= found.counts.keys()


def test_balls_on_a_line_cannot_slide() -> None:
    def on_a_line(offset: float) -> dict[str, int]:
        other = f'<body pos="0 {offset} .4">{UPRIGHT}<geom size=".1" mass="1"/></body>'
        return contact_parts(scene(puck() + other).host)[1]

    assert on_a_line(0.0) == {"slide": 1} and on_a_line(0.01) == {}


@pytest.mark.parametrize(("geom", "cone"), [('condim="1"', "pyramidal"), ('friction="0 0 0"', "elliptic")])
def test_contact_without_friction_pushes(geom: str, cone: str) -> None:
    option = f'<option cone="{cone}"/>'
    _, found = sampled(FLOOR.replace("/>", f" {geom}/>") + puck("<freejoint/>", geom), 4, option)
    assert found.missing == () and not found.unreachable and found.counts["push"]


def test_frictionless_contact_beside_friction_is_looked_for() -> None:
    rail = '<body pos="2 0 9"><joint type="slide" axis="1 0 0"/><geom size=".1" condim="1" priority="1"/></body>'
    wall = '<geom type="plane" pos="-900 0 0" zaxis="1 0 0" size="1 1 .1"/>'
    _, found = sampled(FLOOR + puck("<freejoint/>") + rail + wall, 4)
    assert found.missing == ("push",)


@pytest.mark.parametrize(
    ("height", "joints", "within"),
    [(1.0, "", False), (0.72, "", False), (0.7, "", True), (1.0, UPRIGHT, True)]
    + [(1.0, '<joint type="slide" axis="1 0 0"/>', False), (1.0, '<joint axis="0 1 0" pos="0 0 .5"/>', True)],
)
def test_a_pole_too_short_for_the_floor_need_not_touch_it(height: float, joints: str, within: bool) -> None:
    pole = f"""<body pos="0 0 {height}">{joints}<geom size=".05" mass="1" contype="0" conaffinity="0"/>
      <body><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .6" size=".1" mass=".2"/></body></body>"""
    _, found = sampled(FLOOR + pole, 4)
    assert found.unreachable == ({} if within else {"contact": 1})
    assert ("contact" in found.counts) is within and ("contact" in found.missing) <= within


def chain(random: np.random.Generator) -> mujoco.MjModel:
    """A chain with joints of any kind beside a plane and a ball, all anywhere."""

    def vector(scale: float = 0.3) -> str:
        return " ".join(map(str, scale * random.normal(size=3)))

    bodies = ""
    for _ in range(3):
        kind = random.choice(["hinge", "hinge", "ball", "slide", "none"])
        axis = "" if kind == "ball" else f'axis="{random.choice(["1 0 0", "0 1 0", "0 0 1"])}"'
        pos = "" if kind == "slide" else f'pos="{vector(0.1)}"'
        joint = "" if kind == "none" else f'<joint type="{kind}" {axis} {pos}/>'
        geom = f'<geom type="capsule" size=".05" fromto="{vector()} {vector()}" mass="1"/>'
        bodies += f'<body pos="{vector()}" euler="{vector(30)}">{joint}{geom}'
    normal = random.choice(["0 0 1", "0 1 0", vector()])
    still = f"""<geom type="plane" size="1 1 1" pos="{vector(0.8)}" zaxis="{normal}" margin=".02"/>
      <geom size=".1" pos="{vector(0.8)}"/>"""
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{still}{bodies}{'</body>' * 3}</worldbody></mujoco>")


def test_unreachable_geoms_never_touch() -> None:
    """100 random chains in 200 random poses each."""
    random, apart, met = np.random.default_rng(0), 0, 0
    for _ in range(100):
        host = chain(random)
        reach, data = Reach(host), mujoco.MjData(host)
        within = {frozenset((pair.first, pair.second)): reach.touch(pair) for pair in contact_pairs(host)}
        for _ in range(200):
            mujoco.mj_integratePos(host, data.qpos, 3 * random.normal(size=host.nv), 1.0)
            mujoco.mj_fwdPosition(host, data)
            pairs = [frozenset(contact.geom.tolist()) for contact in data.contact]
            assert all(within[pair] for pair in pairs)
            met += len(pairs)
        apart += sum(not value for value in within.values())
    assert apart > 50 and met > 1000


def test_mocap_bodies_may_bring_anything_together() -> None:
    tray = '<body pos="0 0 -9" mocap="true"><geom type="plane" size="1 1 1"/></body>'
    assert contact_parts(scene(tray + puck()).host)[1] == {}
