"""States that exercise what a model has, and what is said where they do not; with the C engine alone."""

import mujoco
import numpy as np
import pytest

from mjx_study.gradcheck.coverage import Coverage
from mjx_study.gradcheck.states import Sample, states_of
from mjx_study.simulation.engine import host_state
from mjx_study.simulation.scene import Scene, load_scene, put_scene

FLOOR = '<geom name="floor" type="plane" size="5 5 .1"/>'
# A puck that rests on the floor and does not slide by itself; an arm that hangs far from its limits; dry friction.
PUCK = '<body pos="0 0 .099"><freejoint/><geom type="box" size=".1 .1 .1" mass="1"/></body>'
ARM = """<body pos="2 0 2"><joint name="arm" axis="0 1 0" limited="true" range="-150 150" frictionloss=".3"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".1"/></body>"""


def sampled(world: str, count: int, option: str = "", **options) -> tuple[list[Sample], Coverage]:
    return states_of(scene(world, option), None, count, options.pop("horizon", 100), 0, **options)


def scene(world: str, option: str = "") -> Scene:
    return put_scene(
        mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{world}</worldbody></mujoco>"), "scene"
    )


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_what_a_slow_rollout_misses_is_looked_for(cone: str) -> None:
    samples, found = sampled(FLOOR + PUCK + ARM, 6, f'<option cone="{cone}"/>')
    assert found.missing == () and len(samples) == found.states == 6
    for part in ("stick", "slide", "limit", "held", "slipping"):
        assert found.counts[part] >= 1, found
    assert samples[0].label == "start, at rest" and any("pushed" in s.label or "pose" in s.label for s in samples)


def test_a_part_out_of_reach_is_said() -> None:
    _, found = sampled(
        FLOOR.replace("/>", ' pos="0 0 -90"/>') + PUCK.replace("<freejoint/>", '<joint type="slide"/>'), 3
    )
    assert found.missing == ("contact",) and "contact in 0" in found.line()


def test_fewer_states_than_parts_are_said() -> None:
    samples, found = sampled(FLOOR + PUCK + ARM, 1)
    assert len(samples) == 1 and {"slide", "limit"} <= set(found.missing)


@pytest.mark.parametrize("count", [1, 4, 9])
@pytest.mark.parametrize("horizon", [1, 3, 50])
def test_there_are_as_many_states_as_asked_for(count: int, horizon: int) -> None:
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


def test_the_line_of_a_model_without_constraints_is_empty() -> None:
    _, found = sampled('<body><joint type="slide"/><geom size=".1" mass="1"/></body>', 2)
    assert found.line() == "" and found.missing == ()
