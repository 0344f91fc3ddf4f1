r"""Contacts that begin together: their jumps add up, and their derivatives are those of one contact of joint strength.

n equal frictionless contacts of impedance d at a body that cannot turn are one contact of impedance n d/(1 + (n - 1) d)
with the same damping b and stiffness k d.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_study import InitialStatePolicy, Task
from mjx_study.experiment.quadrature import grid, means
from mjx_study.objective.cost import rollout_cost
from mjx_study.simulation import constraint, guards, touch
from mjx_study.simulation.contact import ContactModel, apply_contact
from mjx_study.simulation.drop_in import step
from mjx_study.simulation.dynamics import advance_velocity, force_stage, initial_state, position_stage, rollout
from mjx_study.simulation.saltation import passages
from mjx_study.simulation.touch import Crossings, Events, replaced_points
from tests.scenes import corrected_rollout, floor_scene, option, run, scene_of
from tests.test_onset_term import LAW

CORNERS = 4
FALLING = '<body pos="0 0 .1"><joint type="slide" axis="0 0 1"/>{}</body>'
BALL, BOX = (
    FALLING.format(f'<geom name="body" {shape} mass="1" condim="1"/>')
    for shape in ('size=".1"', 'type="box" size=".2 .1 .1"')
)


def contact(damping: float, stiffness: float, impedance: float) -> ContactModel:
    """Of damping b [1/s], stiffness k d [1/s^2] and constant impedance d."""
    solref = -jnp.array([stiffness * impedance, damping * impedance])
    return ContactModel(solref, jnp.array([impedance, impedance, 1e-3, 0.5, 2.0]))


def falls(body: str, law: ContactModel, gaps: np.ndarray, by_steps: bool) -> np.ndarray:
    """Last gap, and its derivatives by the first with the linear term and with shifts in time."""
    scene = scene_of(floor_scene(body, option(2e-3, "", 'refsafe="disable"'), 'condim="1"'))
    model = apply_contact(scene.model, law)
    speed, steps = jnp.array([-1.0]), 60

    def last(gap, **options):
        start = initial_state(scene, gap[None], speed)
        states, *_, counts = corrected_rollout(scene, model, start, LAW, steps, **options)
        return states.qpos[-1, 0], counts.found

    def drop_in(gap):
        advance = lambda data, _: (step(model, data, onset="linear"), None)  # noqa: E731
        start = scene.template.replace(qpos=gap[None], qvel=speed)
        return jax.lax.scan(advance, start, length=steps)[0].qpos[0]

    def sample(gap):
        if by_steps:
            return jnp.stack(jax.value_and_grad(drop_in)(gap)), None
        (value, found), of_linear = jax.value_and_grad(last, has_aux=True)(gap)
        of_shift, also_found = jax.grad(partial(last, onset="shift"), has_aux=True)(gap)
        return jnp.stack([value, of_linear, of_shift]), jnp.stack([found, also_found])

    values, found = run(jax.vmap(sample), gaps)
    assert found is None or np.all(found == (1 if body is BALL else CORNERS))
    return values


@pytest.mark.parametrize(
    "by_steps", [pytest.param(False, id="of a rollout"), pytest.param(True, id="of steps", marks=pytest.mark.slow)]
)
def test_four_corners_have_the_derivatives_of_one_contact(by_steps: bool) -> None:
    """Which begins, and ends under the body's weight."""
    damping, stiffness, impedance = 3.5, 1e4, 0.5
    joint = CORNERS * impedance / (1 + (CORNERS - 1) * impedance)
    gaps = np.linspace(0.0311, 0.0489, 8)
    of_box = falls(BOX, contact(damping, stiffness, impedance), gaps, by_steps)
    of_ball = falls(BALL, contact(damping, stiffness, joint), gaps, by_steps)
    np.testing.assert_allclose(of_box[:, 0], of_ball[:, 0], rtol=0, atol=1e-12)
    scale = np.abs(of_ball).max(axis=0)
    np.testing.assert_allclose(of_box / scale, of_ball / scale, rtol=0, atol=1e-9)


# Four corners with friction, the limit of a hinge and that of a tendon, all of them barely passed.
MIXED = floor_scene(
    '<body pos="0 0 .0999"><joint name="x" type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    '<joint type="hinge" axis="0 1 0" range=".0057 50" limited="true"/>'
    '<geom name="box" type="box" size=".2 .1 .1" mass="1"/></body>',
    option(4e-3, "", 'refsafe="disable"'),
).replace(
    "</mujoco>", '<tendon><fixed limited="true" range=".0001 1"><joint joint="x" coef="1"/></fixed></tendon></mujoco>'
)


def test_jumps_of_a_step_add_up_whatever_their_order() -> None:
    """The velocity with everything that begins, less that with what ends, for random orders and ties."""
    scene = scene_of(MIXED)
    model = apply_contact(scene.model, contact(100.0, 0.0, 0.5))
    solref, solimp = jnp.array([[0.0, -50.0]]), jnp.array([[0.5, 0.5, 1e-3, 0.5, 2.0]])
    model = model.replace(
        jnt_solref=jnp.tile(solref, (3, 1)),
        jnt_solimp=jnp.tile(solimp, (3, 1)),
        tendon_solref_lim=solref,
        tendon_solimp_lim=solimp,
    )
    qvel = jnp.array([-0.8, -1.3, -2.0])
    positioned = position_stage(scene, model, scene.template.qpos)
    forced = force_stage(model, positioned, qvel, jnp.zeros(0), jnp.zeros(0))
    members = guards.find_guards(model, positioned, qvel, ends=False).members
    count = len(members)
    passes = members.any(axis=1) & (np.arange(count) < count - CORNERS)  # not upper corners, nor contacts
    own = np.flatnonzero(passes)
    assert len(own) == CORNERS + 2

    def sums(since, begins):
        crossing, no = Crossings(begins & passes, ~begins & passes, since), jnp.zeros((), bool)

        def jump(guard):
            event = Events(jnp.zeros((), int), guard, ~begins[guard], no, *crossing.others(guard), ~no)
            at = scene.template.qpos, qvel, qvel, jnp.zeros(0), jnp.zeros(0), jnp.zeros((2, 3)), event
            on, off = passages(constraint.run_solver, model, scene.template, *at).qvel
            return jnp.where(begins[guard], 1.0, -1.0) * (on - off)

        def velocity(kept):
            prepared = guards.without(forced, (~kept[own]).astype(qvel.dtype) @ members[own])
            return advance_velocity(model, prepared, constraint.run_solver(model, prepared))[0]

        return jnp.sum(jax.vmap(jump)(own), axis=0), velocity(begins) - velocity(~begins)

    random = np.random.default_rng(0)
    since = random.uniform(size=(12, count))
    since[:4] = np.round(since[:4] * 2) / 2  # ties
    begins = random.uniform(size=(12, count)) < 0.5
    begins[:2] = True
    added, expected = run(jax.vmap(sums), since, begins)
    np.testing.assert_allclose(added, expected, rtol=0, atol=1e-9)
    assert np.all(np.abs(expected).max(axis=1) > 0.04)


def slope_and_mean(hinge: str, onset: str, feet: str = "") -> tuple[float, float, np.ndarray]:
    """Slope of the mean cost of a box thrown along a floor, the mean of the corrected derivatives, both by quadrature,
    and numbers of events: all, without a term, replaced points. With feet, they touch in place of the box."""
    slides = '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
    touches = 'contype="0" conaffinity="0"' if feet else ""
    body = f'<geom type="box" size=".2 .1 .1" mass="1" friction=".6" {touches}/>'
    box = f'<body pos="0 0 .1">{slides}{hinge}{body}{feet}</body>'
    scene = scene_of(floor_scene(box, '<option timestep="0.004"/>'))
    position, sigma, steps = np.array([0.15]), 0.05, 100

    def thrown(start, gap):
        qpos = start.qpos.at[1].add(gap[0])
        qpos = qpos.at[2].set(0.03) if hinge else qpos
        return dataclasses.replace(start, qpos=qpos, qvel=start.qvel.at[:2].set(jnp.array([1.0, -1.0])))

    final = lambda state: 100 * state.qpos[1] ** 2 + state.qpos[0] + state.qpos[1]  # noqa: E731
    task = Task(
        name="thrown",
        scene=scene,
        horizon=steps,
        policy=InitialStatePolicy(1, steps, 0, thrown),
        theta=jnp.asarray(position),
        sigma=sigma,
        start=(start := initial_state(scene)),
        final_cost=final,
        contact_pair=None,
    )

    def sample(gap):
        noise = jnp.zeros(task.policy.noise_shape)
        value, (*_, counts) = rollout_cost(task, gap[None], None, start, noise, onset)
        assert counts is not None
        return value, jnp.stack([counts.found, counts.missed, counts.replaced])

    points = grid(0.15, 0.15, sigma, 400, "gaussian")
    (values, counts), slopes = run(jax.vmap(jax.value_and_grad(sample, has_aux=True)), points)
    found = means(points, values, slopes, position, sigma, "gaussian")
    return float(found.slope[0]), float(found.first[0]), counts.sum(axis=0)


TILTED = '<joint type="hinge" axis="0 1 0"/>'
FOOT = '<geom type="sphere" size=".001" mass=".001" pos="{} {} -.099" friction=".6"/>'
LANDINGS = "flat", "tilted", "on feet"
FEET = "".join(FOOT.format(x, y) for x in (-0.199, 0.199) for y in (-0.099, 0.099))


@pytest.mark.parametrize(
    ("onset", "lands"),
    [
        *(("linear", lands) for lands in LANDINGS),
        *(pytest.param("shift", lands, marks=pytest.mark.slow if "feet" in lands else ()) for lands in LANDINGS),
    ],
)
def test_a_box_that_lands_has_the_slope(onset: str, lands: str) -> None:
    """Though corners of a tilted one replace each other in penetration; by plain first order the slope is 96 % off."""
    feet = FEET if lands == "on feet" else ""
    slope, mean, (found, missed, replaced) = slope_and_mean("" if lands == "flat" else TILTED, onset, feet)
    assert abs(mean / slope - 1) < 0.03 and replaced == 0 and (missed == 0 or feet)
    assert found > {"flat": 4 * 350, "tilted": 8 * 400, "on feet": 3 * 400}[lands]  # some start in contact, flat


@pytest.mark.parametrize(
    ("steps", "guards_at", "used", "chatter"),
    [
        pytest.param([1, 5, 9, 60], [0, 0, 0, 0], 4, [1, 1, 1, 0], id="three in a row"),
        pytest.param([1, 5, 60, 64], [0, 0, 0, 0], 4, [0, 0, 0, 0], id="begins and ends soon, twice"),
        pytest.param([1, 5, 9, 13], [0, 1, 0, 1], 4, [0, 0, 0, 0], id="two contacts"),
        pytest.param([1, 13, 25, 37], [0, 0, 0, 0], 4, [0, 0, 0, 0], id="slowly"),
        pytest.param([1, 5, 9, 13], [0, 0, 0, 0], 2, [0, 0, 0, 0], id="without slots"),
    ],
)
def test_rows_of_events_of_one_contact_are_told(
    monkeypatch: pytest.MonkeyPatch, steps: list[int], guards_at: list[int], used: int, chatter: list[int]
) -> None:
    """Steps of 2 ms, and contact that relaxes in 10 ms: up to ten steps apart is soon. Three make a row here."""
    monkeypatch.setattr(touch, "LEAST", 3)
    number, none = len(steps), jnp.zeros((len(steps), 2), bool)
    ends = jnp.arange(number) % 2 == 1
    at = jnp.array(steps, jnp.int32), jnp.array(guards_at)
    events = Events(*at, ends, ends, none, none, jnp.arange(number) < used)
    np.testing.assert_array_equal(events.chattering(jnp.full(number, 100.0), 2e-3), np.array(chatter, bool))


def test_a_box_that_chatters_has_no_terms_that_multiply_each_other() -> None:
    """Sliding on four corners, which touch and leave at nearly no speed; with all terms the deviation is 17."""
    body = '<body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1" mass="1" friction=".5"/></body>'
    scene = scene_of(floor_scene(body, '<option timestep="0.005"/>', 'friction=".5"'))
    start = initial_state(scene)

    def last(speed, corrects):
        state = dataclasses.replace(start, qvel=start.qvel.at[0].set(speed))
        if not corrects:
            return rollout(scene, scene.model, state, LAW, 100)[0].qpos[-1, 0], jnp.zeros(())
        states, *_, counts = corrected_rollout(scene, scene.model, state, LAW, 100, slots=96)
        return states.qpos[-1, 0], counts.missed

    both = lambda speed: tuple(jax.grad(last, has_aux=True)(speed, each) for each in (False, True))  # noqa: E731
    speeds = 1.0 + 0.1 * np.random.default_rng(0).standard_normal(60)
    (plain, _), (corrected, missed) = run(jax.vmap(both), speeds)
    assert 0 < np.std(plain) < np.std(corrected) < 40 * np.std(plain) < 1
    assert np.mean(missed) > 10


@pytest.mark.parametrize(
    ("second", "travel", "number"),
    [
        pytest.param([0.0, 0.2], 0.0, 0, id="both stay"),
        pytest.param([0.2, 0.0], 0.0, 0, id="change places in the list"),
        pytest.param([0.0, 0.201], 0.0, 0, id="within reach"),
        pytest.param([0.0, 0.4], 0.0, 2, id="one replaces another"),
        pytest.param([0.0, 0.4], -0.6, 1, id="one begins by motion, another vanishes"),
        pytest.param([0.0, 0.4], 0.6, 1, id="one turns in contact, another vanishes"),
        pytest.param([0.0, 0.4], -0.4, 2, id="too deep for its motion"),
    ],
)
def test_corners_that_replace_each_other_are_counted(second: list[float], travel: float, number: int) -> None:
    """At a depth of 1 m; the first guard is a limit, and the last one moves in the second step."""
    place = jnp.zeros((2, 2, 3)).at[:, :, 0].set(jnp.array([[0.0, 0.2], second]))
    touching, timestep = -jnp.ones((2, 3)), 0.01
    points = guards.Points(place, jnp.full((2, 2), 0.01), jnp.tile(jnp.array([0, 1]), (2, 2, 1)))
    speed = jnp.zeros((2, 3)).at[1, 2].set(travel / timestep)
    course = guards.Course(touching, speed, touching, jnp.zeros((2, 3)), touching < 0, points)
    before, here = (jax.tree.map(lambda leaf, at=at: leaf[at], course) for at in (0, 1))
    assert replaced_points(here, before, timestep) == number


def test_corners_at_a_plane_that_replace_each_other_are_counted() -> None:
    """Of three corners one stays, one vanishes and one appears in penetration; MJX's contacts are no guards then."""
    gone, came = (jnp.array([*corners, 1.0, 1.0]) for corners in ([-0.1, -0.1, 0.0], [-0.1, 0.0, -0.1]))
    points = guards.Points(jnp.zeros((2, 3)), jnp.full(2, 0.01), jnp.tile(jnp.array([0, 1]), (2, 1)))
    here, before = (guards.Course(each, 0 * each, each, 0 * each, each < 0, points) for each in (came, gone))
    assert replaced_points(here, before, 0.01) == 2
    sinking = here._replace(speed=jnp.array([0.0, 0.0, -6.0, 0.0, 0.0]))
    assert replaced_points(sinking, before, 0.01) == 1  # the new one has passed zero by motion


def test_a_sphere_that_meets_a_cylinder_replaces_no_point() -> None:
    """It moves on circles, so that its distance passes zero where the tangent of its path does not: 2 % of such events
    had been taken for corners."""
    rod = '<geom name="rod" type="cylinder" size=".05 .2" euler="90 0 0" pos=".36 0 .2" condim="1"/>'
    ball = '<geom name="ball" size=".03" pos=".3 0 0" mass=".2" condim="1"/>'
    arm = f'<body pos="0 0 .3"><joint type="hinge" axis="0 1 0"/>{ball}</body>'
    scene = scene_of(floor_scene(rod + arm, '<option timestep="0.004"/>'))

    def events(speed):
        start = initial_state(scene)
        start = dataclasses.replace(start, qvel=start.qvel.at[0].set(speed))
        *_, counts = corrected_rollout(scene, scene.model, start, lambda *_: jnp.zeros(0), 100)
        return jnp.stack([counts.found, counts.replaced])

    found, replaced = run(jax.vmap(events), jnp.linspace(0.0, 6.0, 300)).sum(axis=0)
    assert found >= 300 and replaced == 0
