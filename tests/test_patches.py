"""The terms that stand in for MJX's have its values, and the derivatives that its own lack."""

import threading
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mjx_study.simulation import patches
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.scene import load_scene

UNIT = st.floats(-1, 1)


def original(module: str, name: str) -> Any:
    return getattr(patches.mjx_module(module), name)


LEVEL = """<mujoco><option timestep=".002"><flag contact="disable"/></option>
<worldbody><body><joint name="x" type="slide"/><geom size=".1" mass="1"/></body></worldbody>
<equality><joint joint1="x" solref="{} {}" solimp="{} {} {} {} {}"/></equality></mujoco>"""


@pytest.mark.parametrize("solref", [(-3000.0, -40.0), (-500.0, 0.0), (0.03, 0.8), (0.003, 1.0)])
@pytest.mark.parametrize("solimp", [(0.3, 0.9, 0.01, 0.3, 3.0), (0.9, 0.95, 0.001, 0.5, 2.0)])
def test_stiffness_damping_and_impedance_are_the_c_engines(solref, solimp) -> None:
    """Of an equality, whose position has either sign; a time constant below two timesteps among them."""
    host = mujoco.MjModel.from_xml_string(LEVEL.format(*solref, *solimp))
    data, model = mujoco.MjData(host), mjx.put_model(host)
    for position in (-0.02, -0.004, -0.0004, 0.0004, 0.002, 0.0095):
        data.qpos[:] = position
        mujoco.mj_forward(host, data)
        arguments = model, jnp.array(solref), jnp.array(solimp), jnp.array(position)
        ours = patches.stiffness_damping_impedance(*arguments)
        np.testing.assert_allclose(ours, data.efc_KBIP[0, :3], rtol=1e-12)


def test_both_quaternions_of_an_orientation_are_one() -> None:
    start, end = (jnp.array(part) / np.linalg.norm(part) for part in ([0.9, 0.1, -0.3, 0.2], [0.2, 0.7, 0.4, -0.1]))
    expected = patches.rotation_difference(end, start)
    np.testing.assert_allclose(patches.rotation_difference(-end, start), expected, rtol=0, atol=1e-15)
    np.testing.assert_allclose(patches.rotation_difference(end, -start), expected, rtol=0, atol=1e-15)


@settings(deadline=None, max_examples=60, derandomize=True)
@given(
    solref=st.one_of(
        st.tuples(st.floats(1e-4, 1), st.floats(0.01, 3)), st.tuples(st.floats(-1e5, -1), st.floats(-1e3, -0.1))
    ),
    low=st.floats(-0.5, 1.5),
    high=st.floats(-0.5, 1.5),
    width=st.floats(-0.1, 0.1),
    midpoint=st.floats(-0.5, 1.5),
    power=st.sampled_from([0.5, 1.0, 2.0, 3.0, 5.0]),
    position=st.floats(-0.2, 0.2),
)
def test_stiffness_damping_and_impedance_are_mjxs(solref, low, high, width, midpoint, power, position) -> None:
    """Whatever the parameters, those out of MuJoCo's bounds among them; one that falls mirrors one that rises."""
    model, solimp = load_scene("pusher").model, jnp.array([low, high, width, midpoint, power])

    def theirs(solimp):
        return original("constraint", "_kbi")(model, jnp.array(solref), solimp, jnp.array(position))

    ours = patches.stiffness_damping_impedance(model, jnp.array(solref), solimp, jnp.array(position))
    ends = np.clip([low, high], mujoco.mjMINIMP, mujoco.mjMAXIMP)
    rising = theirs(solimp.at[:2].set(np.sort(ends)))[2]
    expected = *theirs(solimp)[:2], rising if ends[0] <= ends[1] else np.sum(ends) - rising
    np.testing.assert_allclose(ours, expected, rtol=1e-12)


def turned(vector: np.ndarray) -> np.ndarray:
    """The matrix of a rotation vector, which is one and the same for both vectors of half a turn (Rodrigues)."""
    x, y, z = np.asarray(vector)
    cross, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.linalg.norm(vector)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * cross @ cross


@settings(deadline=None, max_examples=40, derandomize=True)
@given(st.lists(UNIT, min_size=8, max_size=8))
@example([-2e-116, 0, 0, 0, 0, 0, 0, 0])  # half a turn, which may go either way round
def test_rotations_are_mjxs(numbers: list[float]) -> None:
    parts = np.array(numbers).reshape(2, 4) + np.array([[0.0, 1e-3, 0, 0], [1e-3, 0, 0, 0]])
    first, second = (jnp.array(part / np.linalg.norm(part)) for part in parts)
    axis, angle = original("math", "quat_to_axis_angle")(first)
    ours, one = patches.rotation_vector(first)
    np.testing.assert_allclose(turned(np.asarray(ours * one)), turned(np.asarray(axis * angle)), rtol=0, atol=1e-10)
    assert np.linalg.norm(ours) <= np.pi + 1e-12
    difference = patches.rotation_difference(second, first)
    theirs = original("math", "quat_sub")(second, first)
    np.testing.assert_allclose(turned(np.asarray(difference)), turned(np.asarray(theirs)), rtol=0, atol=1e-10)


def test_a_rotation_has_its_derivative_at_no_angle() -> None:
    still = jnp.array([1.0, 0, 0, 0])
    right = np.concatenate([np.zeros((3, 1)), 2 * np.eye(3)], axis=1)  # sin(angle / 2) is half the angle
    np.testing.assert_allclose(jax.jacfwd(lambda q: patches.rotation_vector(q)[0])(still), right, rtol=0, atol=1e-15)
    np.testing.assert_allclose(
        jax.jacrev(lambda q: patches.rotation_difference(q, still))(still), right, rtol=0, atol=1e-15
    )


def test_mjxs_own_functions_are_back_afterwards() -> None:
    still, slow = jnp.array([1.0, 0, 0, 0]), jnp.full(3, 1e-9)  # too slow for MJX to have a derivative
    turn = jax.jit(lambda velocity: original("math", "quat_integrate")(still, velocity, 0.1)[1])
    stock = float(jax.grad(turn)(slow)[0])
    with pytest.raises(KeyError), patches.patched(), patches.patched():
        assert float(jax.grad(turn)(slow)[0]) == pytest.approx(0.05)
        raise KeyError
    assert float(jax.grad(turn)(slow)[0]) == stock != pytest.approx(0.05)


def test_levels_of_a_chain_are_not_fused() -> None:
    """Fused, the Jacobian of six links takes fifty times as long, and a step of ten some minutes."""
    chain = "".join('<body pos="0 0 .1"><joint axis="0 1 0"/><geom size=".1"/>' for _ in range(4)) + "</body>" * 4
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{chain}</worldbody></mujoco>")
    data = mjx.make_data(model).replace(qpos=jnp.array([0.3, -0.2, 0.5, 0.1]))

    def places(data: mjx.Data) -> mjx.Data:
        with patches.patched():
            return mjx.kinematics(mjx.put_model(model), data)

    apart = [each for each in jax.make_jaxpr(places)(data).eqns if each.primitive.name == "optimization_barrier"]
    assert len(apart) == 4
    stock = jax.jit(lambda data: mjx.kinematics(mjx.put_model(model), data).xpos)(data)
    np.testing.assert_allclose(jax.jit(places)(data).xpos, stock, rtol=0, atol=1e-15)


def test_other_threads_are_left_alone() -> None:
    chosen: list[Any] = []
    with patches.patched():
        thread = threading.Thread(target=lambda: chosen.append(patches._CHOSEN.value))
        thread.start()
        thread.join()
        assert patches._CHOSEN.value
    assert chosen == [()]


def test_another_mjx_is_an_error_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patches, "_REPLACED", {**patches._REPLACED, ("math", "no_such_function"): jnp.sin})
    with pytest.raises(RuntimeError, match=r"no mujoco\.mjx\._src\.math\.no_such_function"), patches.patched():
        pytest.fail("nothing may be traced")
    assert not patches._CHOSEN.value


def test_tendon_springs_are_linear_at_rest() -> None:
    """Also where MJX's two halves meet, each with derivative zero."""
    xml = """<mujoco><worldbody><body><joint name="x" type="slide"/><geom size=".1" mass="1"/></body></worldbody>
    <tendon><fixed stiffness="100" springlength="0"><joint joint="x" coef="2"/></fixed></tendon></mujoco>"""
    host = mujoco.MjModel.from_xml_string(xml)
    model = mjx.put_model(host)
    data = mjx.put_data(host, mujoco.MjData(host))

    def force(x):
        moved = mjx.kinematics(model, data.replace(qpos=x[None]))
        return patches.springs_and_dampers(model, mjx.tendon(model, mjx.com_pos(model, moved)))[0]

    program = jax.jit(jax.value_and_grad(force))
    assert [float(part) for part in program(jnp.zeros(()))] == [0.0, -400.0]
    assert [float(part) for part in program(jnp.array(0.1))] == [-40.0, -400.0]


RING: Final = """<mujoco><worldbody><geom name="ring" type="cylinder" size=".1 .5" contype="0"/><site name="side"/>
<site name="a" pos=".2 {height} 0"/><body pos="-.2 .03 0"><joint type="slide" axis="0 1 0"/><geom size=".01" mass="1"/>
<site name="b"/></body></worldbody><tendon><spatial><site site="a"/><geom geom="ring" sidesite="side"/><site site="b"/>
</spatial></tendon></mujoco>"""


@pytest.mark.parametrize("bits", [32, 64])
@pytest.mark.parametrize("height", [0.02, 0.15], ids=["straight", "wrapped"])
def test_tendons_inside_a_ring_have_derivatives(height: float, bits: int) -> None:
    """Whether they touch it or pass through; by the tape, which computes the branch that is not taken, too."""
    with jax.enable_x64(bits == 64):
        host = mujoco.MjModel.from_xml_string(RING.format(height=height))
        model, data = mjx.put_model(host), mjx.make_data(host)

        def length(y: jax.Array) -> jax.Array:
            moved = mjx.kinematics(model, data.replace(qpos=y[None]))
            with patches.patched():
                return mjx.tendon(model, mjx.com_pos(model, moved)).ten_length[0]

        y = 0.12 if height > 0.1 else 0.0
        reverse = jax.jit(jax.grad(length))(jnp.array(y))
        moved = []
        for qpos in (y + 1e-6, y - 1e-6):
            there = mujoco.MjData(host)
            there.qpos[:] = qpos
            mujoco.mj_forward(host, there)
            moved.append(there.ten_length[0])
        np.testing.assert_allclose(reverse, (moved[0] - moved[1]) / 2e-6, rtol=1e-4)


@pytest.mark.parametrize("place", ["inside", "outside", "edge", "above", "axis", "middle"])
def test_contacts_of_cylinders(place: str) -> None:
    """The distance and its gradient are MJX's, and the gradient has a derivative in reverse mode."""
    places = {
        "inside": (0.1, 0.05, 0.1),
        "outside": (0.5, 0.1, 0.1),
        "edge": (0.5, -0.2, 0.4),
        "above": (0.1, 0.1, 0.4),
    }
    point, size = jnp.array(places.get(place, (0, 0, 0.1 * (place == "axis")))), jnp.array([0.3, 0.25, 0])
    mjx_distance = original("collision_sdf", "_cylinder")
    ours, theirs = (jax.value_and_grad(distance) for distance in (patches.cylinder_distance, mjx_distance))
    for mine, its in zip(ours(point, size), theirs(point, size), strict=True):
        np.testing.assert_allclose(mine, its, rtol=0, atol=1e-15)
    second, reverse = (mode(jax.grad(patches.cylinder_distance))(point, size) for mode in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(reverse, second, rtol=0, atol=1e-12)
    stock = jax.jacrev(jax.grad(mjx_distance))(point, size)
    assert np.isnan(stock).any() == (place in ("inside", "axis", "middle"))
    if place not in ("axis", "middle"):  # where the gradient jumps
        moved = [jax.grad(mjx_distance)(point + h, size) for h in 1e-6 * jnp.concatenate([jnp.eye(3), -jnp.eye(3)])]
        truth = (np.array(moved[:3]) - np.array(moved[3:])).T / 2e-6
        np.testing.assert_allclose(second, truth, rtol=0, atol=1e-8)
