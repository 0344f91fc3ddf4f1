r"""The onset term against an independent simulation with derivatives by hand, and against slopes by quadrature.

One body falls on a plane at speed v. Everything about it is known: MuJoCo's law in contact is a = (1 - d) a_0 + d aref,
aref = -b v - k d r, with the impedance d(r) of solimp and no pulling.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_study.experiment.quadrature import Line, grid, means
from mjx_study.results.findings import ERROR_PER_STRENGTH
from mjx_study.simulation import drop_in
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import ContactModel, apply_contact, contact_model
from mjx_study.simulation.dynamics import initial_state, rollout
from mjx_study.simulation.observation import observed
from mjx_study.simulation.scene import put_scene
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import family_grid
from tests.scenes import DROP, FALLING, corrected_rollout, floor_scene, option, run, scene_of

TIMECONST, LOW, HIGH, WIDTH = 0.02, 0.9, 0.95, 0.001
SPEED, GRAVITY = -1.7, -9.81
BOX = '<body pos="0 0 0.1"><freejoint/><geom name="box" type="box" size="0.1 0.1 0.1" mass="1"/></body>'
LAW = lambda index, state: jnp.zeros(0)  # noqa: E731, of no control


@dataclasses.dataclass(frozen=True)
class Law:
    """MuJoCo's contact law of one body; impedances and damping ratio 0 to 1, lengths [m], times [s]."""

    timeconst: float = TIMECONST
    ratio: float = 1.0
    low: float = LOW
    high: float = HIGH
    width: float = WIDTH

    @property
    def damping(self) -> float:
        return 2 / (self.high * self.timeconst)

    @property
    def rate(self) -> float:
        """How fast contact changes the speed of approach [1/s]; slower than |a| over this a body grazes."""
        return max(self.high * self.damping, self.spring)

    @property
    def spring(self) -> float:
        return (self.low * self.high * self.stiffness) ** 0.5

    @property
    def stiffness(self) -> float:
        return 1 / (self.high * self.timeconst * self.ratio) ** 2

    @property
    def contact(self) -> ContactModel:
        solimp = jnp.array([self.low, self.high, self.width, 0.5, 2.0])
        return ContactModel(jnp.array([self.timeconst, self.ratio]), solimp)

    def impedance(self, r):
        depth = np.minimum(np.abs(r) / self.width, 1.0)
        share = np.where(depth < 0.5, 2 * depth**2, 1 - 2 * (1 - depth) ** 2)
        slope = np.where(depth < 0.5, 4 * depth, 4 * (1 - depth)) * np.where(depth < 1, np.sign(r) / self.width, 0.0)
        return self.low + share * (self.high - self.low), slope * (self.high - self.low)

    def force(self, r, v, free):
        """Acceleration by the contact, and its derivatives by gap and speed."""
        (d, over_d), b, k = self.impedance(r), self.damping, self.stiffness
        pull = -b * v - k * d * r - free
        return d * pull, over_d * pull - d * k * (over_d * r + d), -d * b

    def touch(self, v, free):
        """The same at first touch, where there is no spring force."""
        return np.maximum(self.low * (-free - self.damping * v), 0.0)

    def fastest(self, v, ends, free):
        """The larger acceleration of those with contact, where it ends, and without."""
        return np.maximum(abs(free), np.where(ends, np.abs(free + self.touch(v, free)), 0.0))


DEFAULT = Law()
BOUNCING = Law(timeconst=0.6, ratio=0.0166)
"""Contact with so little damping that it ends under the body's weight."""
SPRING = Law(timeconst=0.1, ratio=0.05, low=1e-4, high=1e-4)
"""Contact as a spring and a damper beside the other forces: the penalty method."""


def cost(gap):
    return 100 * (gap - 0.02) ** 2


def fall(gap, steps: int, timestep: float, free: float, law: Law = DEFAULT, start: float = SPEED):
    """Last gap and speed of falling bodies, and its derivatives by the first gap: of the steps alone, with the linear
    term, and with shifts in time."""
    r, v, last_v = gap.copy(), np.full_like(gap, start), np.full_like(gap, start)
    tangents = {False: (np.ones_like(r), np.zeros_like(r)), True: (np.ones_like(r), np.zeros_like(r))}
    touched, touched_before, pushed = (np.zeros(r.shape, bool) for _ in range(3))
    states, slopes, events = [(r, v)], [], []
    for step in range(steps):
        push, over_r, over_v = law.force(r, v, free)
        acts, cell = (r < 0) & (push > 0), timestep * v
        ends = touched & pushed & (r >= 0)
        event = ends | ((r < 0) & (cell < 0) & (r - cell >= 0) & (step > 0))
        share = np.where(event, r / np.where(event, cell, 1.0), 0.0)
        before = np.where(ends == touched_before, share, 0.0)  # the gap before, or this contact, was longer than a step
        at_once = (1 - share) * v + share * last_v  # at which the linear term has both of its jumps
        bounded = -np.maximum(np.abs(cell), timestep * law.fastest(at_once, ends, free) / law.rate)
        for has_term, (dr, dv) in tangents.items():
            here, previous = (
                np.where(event & has_term, part / np.where(event, bounded, 1.0), 0.0)
                for part in (dr, dr - timestep * dv)
            )
            jump = timestep * law.touch(at_once, free)
            extra = before * jump * previous
            moved_r, moved_v = dr + timestep * extra, dv + extra
            next_v = moved_v + timestep * np.where(acts, over_r * moved_r + over_v * moved_v, 0.0)
            next_v = next_v + (1 - share) * jump * here
            tangents[has_term] = (moved_r + timestep * next_v, next_v)
        touched_before, touched, pushed = touched, r < 0, acts
        last_v, v = v, v + timestep * (free + np.where(acts, push, 0.0))
        r = r + timestep * v
        states.append((r, v))
        slopes.append([np.where(acts, part, 0.0) for part in (over_r, over_v)])
        events.append((event, ends, share))
    of_shift = shifted(np.array(states), slopes, events, timestep, law.rate)
    return np.stack([r, v], -1), np.stack(tangents[False], -1), np.stack(tangents[True], -1), of_shift


def shifted(states: np.ndarray, slopes, events, timestep: float, rate: float) -> np.ndarray:
    """Derivative of the last state with shifts in time, from states `(steps + 1, 2, bodies)`, the derivatives of the
    acceleration in each step, and the events."""
    changes, none = np.diff(states, axis=0), np.zeros_like(states[0])
    acceleration = changes[:, 1] / timestep
    moving, shift = np.stack([np.ones_like(none[0]), none[0]]), none[0]
    for step, (over_r, over_v) in enumerate(slopes):
        earlier = shift
        if step + 1 < len(slopes):
            event, ends, share = events[step + 1]
            flow = (changes[step] + changes[step - 1]) / 2 if step else changes[0]
            path, off = (dr + (1 - share) * timestep * dv for dr, dv in (flow, moving - shift * flow))
            fastest = np.abs(acceleration[step])
            fastest = np.where(ends, np.maximum(fastest, np.abs(acceleration[step + 1])), fastest)
            width = np.sign(path) * np.maximum(np.abs(path), timestep * fastest / rate)
            shift = shift + np.where(event, off / np.where(event, width, 1.0), 0.0)
        taken, given = none, none[1]
        if step + 1 < len(slopes):
            taken, given = taken + shift * changes[step] / 2, given + shift * changes[step + 1][1] / 2
        if step:
            taken, given = taken + earlier * changes[step - 1] / 2, given + earlier * changes[step][1] / 2
        rest = moving - taken
        next_v = rest[1] + timestep * (over_r * rest[0] + over_v * rest[1]) + given
        moving = np.stack([moving[0] + timestep * next_v, next_v])
    return moving.T


@pytest.mark.parametrize("mode", [jax.jacrev, pytest.param(jax.jacfwd, marks=pytest.mark.slow)])
def test_every_sample_is_that_of_the_formula(mode) -> None:
    timestep, steps = 2e-3, 60
    scene = scene_of(floor_scene(DROP, option(timestep, "", 'refsafe="disable"'), 'condim="1"'))
    hit, graze = np.linspace(0.0611, 0.0789, 12), np.linspace(5e-5, 3e-4, 12)
    cases = [
        (hit, SPEED, 0.0, DEFAULT),
        (hit, SPEED, GRAVITY, DEFAULT),
        (graze, -0.03, GRAVITY, DEFAULT),
        (np.linspace(0.0311, 0.0489, 12), -1.0, GRAVITY, BOUNCING),
        (np.linspace(0.0311, 0.0489, 12), -1.0, GRAVITY, SPRING),
    ]

    def scene_at(gap, speed, free, contact):
        gravity = jnp.array([0.0, 0.0, 1.0]) * free
        model = apply_contact(scene.model.replace(opt=scene.model.opt.replace(gravity=gravity)), contact)
        return scene, model, initial_state(scene, gap[None], speed[None])

    def last(gap, *case, **options):
        states, _, _, counts = corrected_rollout(*scene_at(gap, *case), LAW, steps, **options)
        found = jnp.stack([states.qpos[-1, 0], states.qvel[-1, 0]])
        return found, (found, counts)

    def sample(*case):
        def weighted(onset):
            kind = partial(last, onset=onset)
            return jax.vmap(lambda weight: mode(partial(kind, weight=weight), has_aux=True)(*case))(weights)

        weights = jnp.array([1.0, 0.0])
        return weighted("linear"), weighted("shift")

    batched = jax.vmap(jax.vmap(sample, in_axes=(0, None, None, None)))
    gaps, speeds, frees, laws = zip(*cases, strict=True)
    contacts = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(law.contact for law in laws))
    results = run(batched, *map(np.array, (gaps, speeds, frees)), contacts)
    for at, (gaps, speed, free, law) in enumerate(cases):
        ours, of_steps, *terms = fall(gaps, steps, timestep, free, law, start=speed)
        found = jax.tree.map(lambda leaf, at=at: leaf[at, :, 0], results)
        for (derivative, (values, counts)), (rest, _), expected in zip(
            found, jax.tree.map(lambda leaf, at=at: leaf[at, :, 1], results), terms, strict=True
        ):
            np.testing.assert_allclose(values, ours, rtol=0, atol=1e-12)
            np.testing.assert_allclose(derivative, expected, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(rest, of_steps, rtol=1e-9, atol=1e-12)
            assert np.all(np.abs(of_steps - expected).max(axis=1) > 0.05)  # the term is no small matter here
            assert np.all(counts.found == 1) and np.all(counts.bounded == (gaps is graze)) and not np.any(counts.missed)
            assert np.all((counts.first > 0) & (counts.first < steps))
        counts = found[0][1][1]
        lost = max(law.touch(speed, free) * timestep / -speed, (timestep * law.spring) ** 2)
        assert gaps is graze or np.allclose(counts.strength, lost, rtol=0.3)


TIMESTEPS = (5e-3, 2.5e-3, 1.25e-3)


def errors_of_means(law: Law, free: float, timestep: float) -> np.ndarray:
    """Relative errors of the means of plain first order, and with either term, by the formula."""
    spread = 0.05
    noise = (np.arange(8001) - 4000) / 4000 * 6 * spread
    weight = np.exp(-((noise / spread) ** 2) / 2)
    weight /= weight.sum()
    last, *tangents = fall(0.32 + noise, round(0.25 / timestep), timestep, free, law)
    value = cost(last[:, 0])
    slope = weight @ ((value - weight @ value) * noise) / spread**2
    return np.abs(np.array([weight @ (200 * (last[:, 0] - 0.02) * each[:, 0]) for each in tangents]) / slope - 1)


@pytest.mark.parametrize(
    ("law", "free"),
    [
        pytest.param(Law(), GRAVITY, id="MuJoCo's default"),
        pytest.param(Law(low=0.9, high=0.9), GRAVITY, id="constant impedance", marks=pytest.mark.slow),
        pytest.param(Law(low=0.5, high=0.5), -30.0, id="half the impedance, pressed on", marks=pytest.mark.slow),
        pytest.param(BOUNCING, GRAVITY, id="bounces under its weight", marks=pytest.mark.slow),
    ],
)
def test_the_error_of_the_mean_falls_with_the_square_of_the_timestep(law: Law, free: float) -> None:
    """In the simulation by hand, by quadrature over gaps spread by 5 cm; the last gap's square as cost.

    Where the impedance changes within a step's travel, the linear term's error falls more slowly.
    """
    plain, linear, shift = np.array([errors_of_means(law, free, timestep) for timestep in TIMESTEPS]).T
    if law is BOUNCING:  # contact that ends under force
        assert np.all(plain > 1.2) and np.all(linear < (0.06, 0.03, 0.01)) and np.all(shift < (4e-3, 5e-4, 1e-4))
        return
    rate_linear, rate_shift = (np.polyfit(np.log(TIMESTEPS), np.log(each), 1)[0] for each in (linear, shift))
    assert np.all(plain > 2)
    assert np.all(shift < (5e-3, 2e-3, 8e-4)) and rate_shift > 1.3
    assert np.all(linear < 1e-2) and rate_linear > (0.5 if law.low < law.high else 1.5)


@pytest.mark.slow
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_both_programs_agree_where_four_corners_land(cone: str) -> None:
    """Friction rows, several corners, a free joint: the Jacobian program and the tape, values as without the term."""
    scene = scene_of(floor_scene(BOX, option(2e-3, f'cone="{cone}"'), ""))
    pose = jnp.array([0.0, 0.0, 0.15, 1.0, 0.0, 0.0, 0.0])
    start = initial_state(scene, pose, jnp.array([0.4, 0.1, -1.0, 0.01, 0.02, 0.3]))
    steps = 32

    def last(velocity):
        state = dataclasses.replace(start, qvel=velocity)
        states, *_, counts = corrected_rollout(scene, scene.model, state, LAW, steps)
        return states.qvel[-1], (states.qvel[-1], counts)

    by_jacobian, (value, counts) = run(jax.jacfwd(last, has_aux=True), start.qvel)
    plain = run(lambda: rollout(scene, scene.model, start, LAW, steps)[0].qvel[-1])
    np.testing.assert_allclose(value, plain, rtol=1e-9)
    assert counts.found >= 4 and counts.missed == 0
    scene = dataclasses.replace(scene, adjoint="tape")
    by_tape, _ = run(jax.jacrev(last, has_aux=True), start.qvel)
    np.testing.assert_allclose(by_jacobian, by_tape, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("onset", "within"), [("linear", 0.04), ("shift", 0.01)])
def test_the_mean_has_the_slope_where_plain_first_order_has_the_wrong_sign(onset: str, within: float) -> None:
    """MuJoCo's default contact, h b = 0.2: the mean of plain first-order gradients is +0.78 at 0.5 rad, not -0.945."""
    task = make_task("momentum_transfer").replace(onset=onset)
    position, points = np.array([0.5]), grid(0.5, 0.5, task.sigma, 400, task.noise)
    (cell,), _ = family_grid(task, ("mujoco_default",))
    found = means(points, *Line(task)(points, cell.contact), position, task.sigma, task.noise)
    assert found.slope_error + found.first_error < 0.02
    assert found.slope < -0.9
    assert np.abs(found.first - found.slope) < within + 2 * (found.slope_error + found.first_error)


@pytest.mark.slow
def test_the_error_that_findings_tell_is_not_exceeded() -> None:
    """By contact models that the rule was not fitted to; and it is of the right size, not a hundred times too large."""
    task = make_task("momentum_transfer")
    position, points = np.array([0.4, 0.6]), grid(0.4, 0.6, task.sigma, 800, task.noise)
    plain, linear = (Line(task.replace(onset=onset)) for onset in ("none", "linear"))
    rest, shares = (0.5, 2.0), []  # midpoint and power of the impedance
    for solref, solimp in (
        ((0.03, 0.8), (0.7, 0.9, 0.002, *rest)),
        ((0.012, 1.0), (0.85, 0.95, 0.001, *rest)),
        ((0.025, 1.5), (0.95, 0.99, 0.0005, *rest)),
    ):
        contact = contact_model(solref, solimp, scene=task.scene)
        found = means(points, *linear(points, contact), position, task.sigma, task.noise)
        without = means(points, *plain(points, contact), position, task.sigma, task.noise)
        # with constant impedance d and no load an onset takes h d b, of the law's damping, of the speed
        strength = task.scene.timestep * solimp[0] * 2 / (solimp[1] * solref[0])
        share = np.abs(found.first - found.slope) / np.abs(found.first - without.first)
        unsure = (found.slope_error + found.first_error + without.first_error) / np.abs(found.first - without.first)
        assert np.all(share < ERROR_PER_STRENGTH * strength + unsure)
        shares.append(np.max(share / strength))
    assert max(shares) > ERROR_PER_STRENGTH / 10


@pytest.mark.slow
@pytest.mark.parametrize("onset", ["linear", "shift"])
@pytest.mark.parametrize(
    ("between", "within"),
    [
        pytest.param((0.745, 0.79), 0.06, id="clips the wall's corner"),
        pytest.param((1.2, 1.245), 0.04, id="slides down the wall until friction throws it off"),
    ],
)
def test_contact_that_turns_or_ends_has_its_share(between: tuple[float, float], within: float, onset: str) -> None:
    """The integral of the gradients is the difference of the cost, to a share of what the term adds.

    With onsets alone, found by straight lines, the linear term was 27 % off in either range.
    """
    task = make_task("ball_wall")
    (cell,), _ = family_grid(task, ("mujoco_default",))
    points = np.linspace(*between, 3000)
    (values, plain), (_, gradients) = (Line(task.replace(onset=each))(points, cell.contact) for each in ("none", onset))
    added = np.trapezoid(gradients - plain, points)
    assert abs(np.trapezoid(gradients, points) - (values[-1] - values[0])) < within * abs(added)


@pytest.mark.slow
def test_grazing_onsets_do_not_spoil_the_mean() -> None:
    """ball_wall at 0.2 rad: where it is thrown flat the ball leaves the floor, and meets it again, at no speed."""
    task = make_task("ball_wall").replace(onset="linear")
    position, points = np.array([0.2]), grid(0.2, 0.2, task.sigma, 2000, task.noise)
    (cell,), _ = family_grid(task, ("mujoco_default",))
    values, gradients = Line(task)(points, cell.contact)
    found = means(points, values, gradients, position, task.sigma, task.noise)
    weights = np.exp(-(((points - 0.2) / task.sigma) ** 2) / 2)
    deviation = np.sqrt(np.average((gradients - found.first) ** 2, weights=weights))
    assert np.abs(found.first - found.slope) < 0.02 * np.abs(found.slope) + 2 * (found.first_error + found.slope_error)
    assert found.first_error < 0.02 * np.abs(found.slope)
    assert deviation < 0.012  # ZoBG's is 0.010; without the bound 0.75


@pytest.mark.parametrize("onset", ["linear", "shift"])
def test_a_model_of_another_timestep_has_its_own(onset: str) -> None:
    short, long = (scene_of(floor_scene(DROP, option(step), 'condim="1"')) for step in (2e-3, 4e-3))

    def gradients(speed):
        def last(speed, scene):
            start = dataclasses.replace(initial_state(scene, jnp.array([0.05])), qvel=speed)
            return corrected_rollout(scene, long.model, start, LAW, 20, onset=onset)[0].qpos[-1, 0]

        return [jax.grad(last)(speed, scene) for scene in (short, long)]

    found, expected = run(gradients, jnp.array([SPEED]))
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_without_constraints_there_is_no_term() -> None:
    """MJX then has contacts, but no rows of theirs."""
    host = mujoco.MjModel.from_xml_string(FALLING)
    scene = put_scene(host, "ball", disable_flags="constraint")
    model, data = mjx.put_model(scene.host), mjx.make_data(scene.host)
    start = initial_state(scene)

    def by_scene(qvel):
        state = dataclasses.replace(start, qvel=qvel)
        return corrected_rollout(scene, scene.model, state, LAW, 2)[0].qpos[-1, 0]

    def by_step(qvel):
        return drop_in.step(model, data.replace(qvel=qvel), onset="linear").qpos[0]

    for function in (by_scene, by_step):
        assert jax.eval_shape(jax.grad(function), start.qvel).shape == (1,)
    np.testing.assert_array_equal(observed(scene, start).contact_force(0, 1), np.zeros(3))


def test_onsets_beyond_the_slots_are_counted_and_left_out() -> None:
    scene = scene_of(floor_scene(DROP, option(2e-3, "", 'refsafe="disable"'), 'condim="1"'))
    start = initial_state(scene, jnp.array([0.05]), jnp.array([SPEED]))

    def corrected(gap):
        state = dataclasses.replace(start, qpos=gap)
        states, *_, counts = corrected_rollout(scene, scene.model, state, LAW, 40, slots=0)
        return states.qpos[-1, 0], counts

    def plain(gap):
        return rollout(scene, scene.model, dataclasses.replace(start, qpos=gap), LAW, 40)[0].qpos[-1, 0]

    both = lambda gap: (jax.value_and_grad(corrected, has_aux=True)(gap), jax.grad(plain)(gap))  # noqa: E731
    ((_, counts), gradient), expected = run(both, start.qpos)
    assert (counts.found, counts.missed) == (1, 1)
    np.testing.assert_allclose(gradient, expected, rtol=1e-9)
