r"""The onset term against an independent simulation with derivatives by hand, and against slopes by quadrature.

One body falls on a plane at speed v. Everything about it is known: MuJoCo's law in contact is a = (1 - d) a_0 + d aref,
aref = -b v - k d r, with the impedance d(r) of solimp and no pulling.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_study.objective import Simulator
from mjx_study.simulation.contact import ContactModel, apply_contact
from mjx_study.simulation.dynamics import initial_state, rollout
from mjx_study.simulation.onset import check_onset, corrected_rollout
from mjx_study.study.quadrature import Line, grid, means
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import contact_grid
from tests.scenes import floor_scene, option, scene_of

TIMECONST, LOW, HIGH, WIDTH = 0.02, 0.9, 0.95, 0.001
SPEED, GRAVITY = -1.7, -9.81
BODY = '<body pos="0 0 0.1"><joint type="slide" axis="0 0 1"/><geom name="ball" size="0.1" mass="1" condim="1"/></body>'
BOX = '<body pos="0 0 0.1"><freejoint/><geom name="box" type="box" size="0.1 0.1 0.1" mass="1"/></body>'
CONTACT = ContactModel(jnp.array([TIMECONST, 1.0]), jnp.array([LOW, HIGH, WIDTH, 0.5, 2.0]))


def fall(gap, steps: int, timestep: float, free: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Last gap and speed of falling bodies; derivatives over the first gap, of the steps alone and with the term."""
    b, k = 2 / (HIGH * TIMECONST), 1 / (HIGH * TIMECONST) ** 2

    def impedance(r):
        depth = np.minimum(np.abs(r) / WIDTH, 1.0)
        share = np.where(depth < 0.5, 2 * depth**2, 1 - 2 * (1 - depth) ** 2)
        slope = np.where(depth < 0.5, 4 * depth, 4 * (1 - depth)) * np.where(depth < 1, np.sign(r) / WIDTH, 0.0)
        return LOW + share * (HIGH - LOW), slope * (HIGH - LOW)

    def force(r, v):
        d, over_d = impedance(r)
        pull = -b * v - k * d * r - free
        return d * pull, over_d * pull - d * k * (over_d * r + d), -d * b

    jump = lambda v: timestep * np.maximum(LOW * (-free - b * v), 0.0)  # noqa: E731
    r, v = gap.copy(), np.full_like(gap, SPEED)
    tangents = {False: (np.ones_like(r), np.zeros_like(r)), True: (np.ones_like(r), np.zeros_like(r))}
    for step in range(steps):
        push, over_r, over_v = force(r, v)
        acts, cell = (r < 0) & (push > 0), timestep * v
        begins = (r < 0) & (cell < 0) & (r - cell >= 0) & (step > 0)
        share = np.where(begins, r / np.where(begins, cell, 1.0), 0.0)
        for corrected, (dr, dv) in tangents.items():
            after, before = (
                np.where(begins & corrected, part / np.where(begins, cell, 1.0), 0.0)
                for part in (dr, dr - timestep * dv)
            )
            extra = share * jump(v - timestep * free) * before
            moved_r, moved_v = dr + timestep * extra, dv + extra
            next_v = moved_v + timestep * np.where(acts, over_r * moved_r + over_v * moved_v, 0.0)
            next_v = next_v + (1 - share) * jump(v) * after
            tangents[corrected] = (moved_r + timestep * next_v, next_v)
        v = v + timestep * (free + np.where(acts, push, 0.0))
        r = r + timestep * v
    return np.stack([r, v], -1), np.stack(tangents[False], -1), np.stack(tangents[True], -1)


def compiled(function, *arguments):
    """A result of one program, compiled without optimisation: compiling is most of the time here."""
    program = jax.jit(function, compiler_options={"xla_backend_optimization_level": "0"})
    return jax.device_get(program(*arguments))


def test_every_sample_is_that_of_the_formula() -> None:
    timestep, steps = 2e-3, 60
    scene = scene_of(floor_scene(BODY, option(timestep, "", 'refsafe="disable"'), 'condim="1"'))
    gaps = np.linspace(0.0611, 0.0789, 12)

    def last(gap, free):
        gravity = jnp.array([0.0, 0.0, 1.0]) * free
        model = apply_contact(scene.model.replace(opt=scene.model.opt.replace(gravity=gravity)), CONTACT)
        start = initial_state(scene, gap[None], jnp.array([SPEED]))
        states, _, _, counts = corrected_rollout(scene, model, start, lambda index, state: jnp.zeros(0), steps)
        found = jnp.stack([states.qpos[-1, 0], states.qvel[-1, 0]])
        return found, (found, counts)

    def sample(gap, free):
        forward, (value, counts) = jax.jacfwd(last, has_aux=True)(gap, free)
        return value, counts, forward, jax.jacrev(last, has_aux=True)(gap, free)[0]

    accelerations = (0.0, GRAVITY)
    batched = jax.vmap(jax.vmap(sample, in_axes=(0, None)), in_axes=(None, 0))
    for free, (values, counts, forward, backward) in zip(
        accelerations, _unstacked(compiled(batched, gaps, np.array(accelerations)), 2), strict=True
    ):
        ours, of_steps, corrected = fall(gaps, steps, timestep, free)
        np.testing.assert_allclose(values, ours, rtol=0, atol=1e-12)
        np.testing.assert_allclose(forward, corrected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(backward, corrected, rtol=1e-9, atol=1e-12)
        assert np.all(np.abs(of_steps - corrected).max(axis=1) > 0.1)  # the term is no small matter here
        assert np.all(counts.found == 1) and not np.any(counts.bounded) and not np.any(counts.missed)


def _unstacked(tree, size: int):
    return [jax.tree.map(lambda leaf, row=row: leaf[row], tree) for row in range(size)]


def test_the_error_of_the_mean_falls_with_the_square_of_the_timestep() -> None:
    """In the simulation by hand: gaps spread by 5 cm, the last gap's square as cost, h b from 0.5 down to 0.13."""
    spread = 0.05
    noise = (np.arange(40_001) - 20_000) / 20_000 * 6 * spread
    weight = np.exp(-((noise / spread) ** 2) / 2)
    weight /= weight.sum()
    errors, plain = [], []
    for timestep in (5e-3, 2.5e-3, 1.25e-3):
        last, of_steps, corrected = fall(0.32 + noise, round(0.25 / timestep), timestep, GRAVITY)
        cost = 100 * (last[:, 0] - 0.02) ** 2
        slope = weight @ ((cost - weight @ cost) * noise) / spread**2
        gradients = [weight @ (200 * (last[:, 0] - 0.02) * tangent[:, 0]) for tangent in (of_steps, corrected)]
        plain.append(abs(gradients[0] / slope - 1))
        errors.append(abs(gradients[1] / slope - 1))
    assert min(plain) > 1.0
    assert errors[0] < 0.05 and errors[2] < 0.01 and errors[2] < 0.4 * errors[0]


@pytest.mark.slow
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_both_programs_agree_where_four_corners_land(cone: str) -> None:
    """Friction rows, several corners, a free joint: the Jacobian program and the tape, values as without the term."""
    scene = scene_of(floor_scene(BOX, option(2e-3, f'cone="{cone}"'), ""))
    pose = jnp.array([0.0, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0])
    start = initial_state(scene, pose, jnp.array([0.4, 0.1, -1.0, 0.01, 0.02, 0.3]))
    steps, law = 32, lambda index, state: jnp.zeros(0)

    def last(velocity):
        state = dataclasses.replace(start, qvel=velocity)
        states, *_, counts = corrected_rollout(scene, scene.model, state, law, steps)
        return states.qvel[-1], (states.qvel[-1], counts)

    by_jacobian, (value, counts) = compiled(jax.jacfwd(last, has_aux=True), start.qvel)
    plain = compiled(lambda: rollout(scene, scene.model, start, law, steps)[0].qvel[-1])
    np.testing.assert_allclose(value, plain, rtol=1e-9)
    assert counts.found >= 4 and counts.missed == 0
    scene = dataclasses.replace(scene, adjoint="tape")
    by_tape, _ = compiled(jax.jacrev(last, has_aux=True), start.qvel)
    np.testing.assert_allclose(by_jacobian, by_tape, rtol=1e-5, atol=1e-7)


def test_the_mean_has_the_slope_where_plain_first_order_has_the_wrong_sign() -> None:
    """MuJoCo's default contact, h b = 0.2: the mean of plain first-order gradients is +0.78 at 0.5 rad, not -0.945."""
    task = make_task("momentum_transfer").replace(onset="linear")
    position, points = np.array([0.5]), grid(0.5, 0.5, task.sigma, 400, task.noise)
    (cell,), _ = contact_grid(task, ("mujoco_default",))
    found = means(points, *Line(task)(points, cell.contact), position, task.sigma, task.noise)
    assert found.slope_error + found.first_error < 0.02
    assert found.slope < -0.9
    assert np.abs(found.first - found.slope) < 0.04 + 2 * (found.slope_error + found.first_error)


def test_onsets_beyond_the_slots_are_counted_and_left_out() -> None:
    scene = scene_of(floor_scene(BODY, option(2e-3, "", 'refsafe="disable"'), 'condim="1"'))
    start = initial_state(scene, jnp.array([0.05]), jnp.array([SPEED]))
    law = lambda index, state: jnp.zeros(0)  # noqa: E731

    def corrected(gap):
        state = dataclasses.replace(start, qpos=gap)
        states, *_, counts = corrected_rollout(scene, scene.model, state, law, 40, slots=0)
        return states.qpos[-1, 0], counts

    def plain(gap):
        return rollout(scene, scene.model, dataclasses.replace(start, qpos=gap), law, 40)[0].qpos[-1, 0]

    both = lambda gap: (jax.value_and_grad(corrected, has_aux=True)(gap), jax.grad(plain)(gap))  # noqa: E731
    ((_, counts), gradient), expected = compiled(both, start.qpos)
    assert (counts.found, counts.missed) == (1, 1)
    np.testing.assert_allclose(gradient, expected, rtol=1e-9)


@pytest.mark.slow
def test_a_batch_says_what_the_term_met() -> None:
    task = make_task("momentum_transfer").replace(onset="linear")
    (cell,), _ = contact_grid(task, ("mujoco_default",))
    keys = jax.random.split(jax.random.key(0), 4)
    batch = Simulator(task, chunk_size=2).objective(cell.contact).differentiate(task.theta, keys)
    assert batch.events is not None and batch.events.tolist() == [[1.0, 0.0, 0.0]] * 4


def test_what_has_no_meaning_is_refused() -> None:
    with pytest.raises(ValueError, match="unknown onset 'exact'; choose from none, linear"):
        check_onset("exact")
    scene = scene_of(floor_scene(BODY, option(2e-3, "", ""), 'condim="1"'))
    start = initial_state(scene)

    def over_model(solref):
        model = apply_contact(scene.model, ContactModel(solref, CONTACT.solimp))
        return corrected_rollout(scene, model, start, lambda index, state: jnp.zeros(0), 2)[0].qpos[-1, 0]

    with pytest.raises(TypeError, match="not in the model"):
        jax.grad(over_model)(CONTACT.solref)
