"""Where contact begins and ends in a rollout: the steps, and the moment of touch within them."""

import dataclasses
from functools import partial
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Int8, Int32

from estimators.pytree import register_pytree
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.dynamics import Qpos, Qvel, Scalar, fwd_position
from mjx_study.simulation.guards import Course, find_guards
from mjx_study.simulation.integration import integrate_position

TOUCHING_SHARE: Final = 1e-6
"""Share of a cell: a body closer than this before the step was already touching, so there is no onset."""
SPARE: Final = 2.0
"""Depth, in travels of a step, up to which a contact may appear or vanish by motion: a guard moves along a curve."""
NEAR_TOUCH: Final = 0.1
"""Share of the way from the touch to the state in contact at which the contact's geometry is evaluated."""
LEAST: Final = 8
"""Number of events of a contact in a row from which it chatters: a ball in a corner rarely has as many."""
CHATTER: Final = 2.2
"""Time between two events of a contact below which they belong together, in the time that contact takes to slow a body
down, one over the larger of `guards.relaxation_rates`: a little more than `solref`'s time constant where damping is
critical."""

Flags = Bool[Array, " slots"]


@register_pytree
@dataclasses.dataclass(frozen=True)
class OnsetCounts:
    """Counts of the onsets in a corrected derivative.

    Attributes:
        found: onsets of contacts and limits, and missed events.
        bounded: onsets and ends at grazing speed, whose term is bounded.
        missed: events left uncorrected, for lack of slots or because their contact chatters (`Events.chattering`).
        strength: root-mean-square share of the approach speed that a corrected onset removes in one step, by the force
            at touch or by the spring at the depth of a step, h^2 k d_0 / d_width, whichever is more; 0 if there is
            none, and with shifts, whose error does not depend on it.
        first: step of the first onset; NaN if there is none.
        replaced: contact points of corners and edges that appear or vanish without their distance passing zero, for
            which there is no term.
    """

    found: Int[Array, "*batch"]
    bounded: Int[Array, "*batch"]
    missed: Int[Array, "*batch"]
    strength: Float[Array, "*batch"]
    first: Float[Array, "*batch"]
    replaced: Int[Array, "*batch"]

    @classmethod
    def none(cls, dtype: Any) -> "OnsetCounts":
        """Counts of a rollout without constraints."""
        zero = jnp.zeros((), int)
        return cls(zero, zero, zero, jnp.zeros((), dtype), jnp.full((), jnp.nan, dtype), zero)


class Events(NamedTuple):
    """Steps at which a contact or limit begins, or ends while it exerts a force, earliest first.

    Attributes:
        step, guard: index of the step and of the guard, as in `guards.Guards`.
        ends: whether it ends at that step; otherwise it begins.
        brief: whether the gap before it, or the contact that ends, lasted one step.
        absent: guards that begin later in the step, or have ended earlier in it.
        touching: guards that pass zero at the same time or almost, including this one.
        used: whether the slot holds an event; others hold step 1, guard 0.
    """

    step: Int[Array, "*slots"]
    guard: Int[Array, "*slots"]
    ends: Bool[Array, "*slots"]
    brief: Bool[Array, "*slots"]
    absent: Bool[Array, "*slots guards"]
    touching: Bool[Array, "*slots guards"]
    used: Bool[Array, "*slots"]

    def chattering(self, rate: Float[Array, " slots"], timestep: float | Scalar) -> Flags:
        """Events of contacts that begin and end again and again: in a row of `LEAST` or more, each soon after the last.

        The derivatives of such a row multiply by about n^T dq / D at each event, and so does the variance of the term.

        Args:
            rate: relaxation rate of each event's contact [1/s].
        """
        guards = jnp.arange(self.absent.shape[-1])
        own = lambda here, every: jnp.sum(jnp.where(here, every, 0), dtype=every.dtype)  # noqa: E731

        def forwards(carry: tuple[Array, Array], event: tuple[Array, ...]) -> tuple[Any, Array]:
            """Number of an event in its row."""
            last, numbers = carry
            step, guard, used, rate = event
            here = (guards == guard) & used
            soon = (step - own(here, last)) * timestep * rate < CHATTER
            number = jnp.where(soon, own(here, numbers), 0) + 1
            return (jnp.where(here, step, last), jnp.where(here, number, numbers)), number

        def backwards(carry: tuple[Array, Array], event: tuple[Array, ...]) -> tuple[Any, Array]:
            """Length of its row, which the next event of the contact continues if it has the next number."""
            following, lengths = carry
            number, guard, used = event
            here = (guards == guard) & used
            continued = own(here, following) == number + 1
            length = jnp.where(continued, own(here, lengths), number)
            return (jnp.where(here, number, following), jnp.where(here, length, lengths)), length

        zeros = jnp.zeros(len(guards), self.step.dtype)
        events = self.step, self.guard.astype(zeros.dtype), self.used, rate
        _, number = jax.lax.scan(forwards, (zeros, zeros), events)
        _, length = jax.lax.scan(backwards, (zeros, zeros), (number, *events[1:3]), reverse=True)
        return self.used & (length >= LEAST)

    def counts(
        self,
        past: "Past",
        valid: Flags,
        narrow: Flags,
        strength: Float[Array, " slots"],
        chatters: Flags,
    ) -> OnsetCounts:
        """Counts of a rollout, from what is known at its end and from what the term says of these events."""
        missed = past.events - jnp.sum(self.used) + jnp.sum(valid & chatters)
        valid, narrow = valid & ~chatters, narrow & ~chatters
        begins = valid & ~self.ends
        onsets = jnp.sum(begins)
        first = jnp.min(jnp.where(begins, self.step.astype(strength.dtype), jnp.inf), initial=jnp.inf)
        first = jnp.where(jnp.isinf(first), jnp.nan, first)
        strength = jnp.sqrt(jnp.sum(jnp.where(begins, strength, 0.0) ** 2) / jnp.maximum(onsets, 1))
        return OnsetCounts(onsets + missed, jnp.sum(narrow), missed, strength, first, past.replaced)


class Changes(NamedTuple):
    """What begins and ends in a step, or in the steps of a rollout.

    Attributes:
        since: as in `Crossings`.
        kinds: sums of the kinds of change of each guard, of `_KINDS`.
        before, after: number of events before the step, and with those of the step.
    """

    since: Float[Array, "*steps guards"]
    kinds: Int8[Array, "*steps guards"]
    before: Int32[Array, "*steps"]
    after: Int32[Array, "*steps"]


_KINDS: Final = {"begins": 1, "ends": 2, "happens": 4, "under_force": 8, "brief": 16}
"""Crossings that begin and end, events, those that end, and those of `Events.brief`."""


class Past(NamedTuple):
    """What has to be known of the steps before one to tell its changes.

    Attributes:
        course: what the guards did in the preceding step.
        touched: guards below zero two steps before.
        steps, events, replaced: numbers so far; see `OnsetCounts`.
    """

    course: Course
    touched: Bool[Array, " guards"]
    steps: Int32[Array, ""]
    events: Int32[Array, ""]
    replaced: Int32[Array, ""]

    @classmethod
    def none(cls, like: Course) -> "Past":
        """That of the first step, for which nothing begins or ends."""
        nothing, zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like), jnp.zeros((), jnp.int32)
        return cls(nothing, nothing.pushes, zero, zero, zero)


def changes(here: Course, past: Past, timestep: float | Scalar) -> tuple[Past, Changes]:
    """Where contacts and limits may begin in a step, or end under force (`at_touch` says whether they do)."""
    active, before, started = here.distance < 0, past.course.distance < 0, past.steps > 0
    crossing = crossings(here, past.course, timestep)
    ends = before & past.course.pushes & (~active | crossing.ends)
    happens = (crossing.begins | (active & ~before) | ends) & started
    flags = crossing.begins, crossing.ends, happens, ends, ends ^ past.touched
    kinds = sum(flag.astype(jnp.int8) * jnp.int8(kind) for flag, kind in zip(flags, _KINDS.values(), strict=True))
    events = past.events + jnp.sum(happens, dtype=jnp.int32)
    replaced = jnp.where(started, replaced_points(here, past.course, timestep), 0).astype(jnp.int32)
    following = Past(here, before, past.steps + 1, events, past.replaced + replaced)
    return following, Changes(crossing.since, jnp.asarray(kinds, jnp.int8), past.events, events)


def event_of(found: Changes, number: Int[Array, ""], step: Int[Array, ""]) -> Events:
    """The event of a step that has a number among those of the rollout."""
    begins, ends, happens, under_force, brief = (found.kinds & jnp.int8(kind) != 0 for kind in _KINDS.values())
    guard = jnp.argmax(jnp.cumsum(happens) > number - found.before)
    others = Crossings(begins, ends, found.since).others(guard)
    return Events(step, guard, under_force[guard], brief[guard], *others, number < found.after)


def events_of(found: Changes, slots: int) -> Events:
    """The first events of a rollout.

    Args:
        slots: maximum number of events to return.
    """

    def next_event(step: Array, slot: Array) -> tuple[Array, Events]:
        later = lambda at: (at < len(found.after) - 1) & (found.after[at] <= slot)  # noqa: E731
        step = jax.lax.while_loop(later, lambda at: at + 1, step)
        used = slot < jnp.minimum(found.after[-1], slots)
        event = event_of(jax.tree.map(lambda leaf: leaf[step], found), slot, step)
        at = jnp.where(used, step, 1), jnp.where(used, event.guard, 0)
        return step, event._replace(step=at[0], guard=at[1], used=used)

    return jax.lax.scan(next_event, jnp.zeros((), jnp.int32), jnp.arange(max(slots, 1), dtype=jnp.int32))[1]


class Crossings(NamedTuple):
    """Guards that pass zero between two steps, along straight lines.

    Attributes:
        begins, ends: whether the guard becomes negative, or ceases to be.
        since: share of a step since then.
    """

    begins: Bool[Array, "*steps guards"]
    ends: Bool[Array, "*steps guards"]
    since: Float[Array, "*steps guards"]

    def others(self, guard: Int[Array, ""]) -> tuple[Bool[Array, " guards"], Bool[Array, " guards"]]:
        """Guards that are absent when one passes zero, and those that pass zero with it; see `Events`.

        In a tie guards take turns by index. Any order that the guards of a step share makes their jumps add up to that
        of all of them together.
        """
        index, own = jnp.arange(len(self.since)), self.since[guard]
        earlier = (self.since > own) | ((self.since == own) & (index < guard))
        absent = ((self.begins & ~earlier) | (self.ends & earlier)) & (index != guard)
        return absent, (self.begins | self.ends) & (jnp.abs(self.since - own) < NEAR_TOUCH) | (index == guard)


def crossings(here: Course, preceding: Course, timestep: float | Scalar) -> Crossings:
    """Crossings between a step and the one that precedes it.

    A slot of MJX that changes to another corner of its geom may have one that ends and one that begins, if it does.
    """
    travel, leaves = timestep * here.speed, timestep * preceding.leaving
    begins = onset_begins(here.distance, travel)
    ends = (preceding.room < 0) & (leaves > 0) & (preceding.room + leaves >= 0)
    carried_on = jnp.abs(here.distance - travel - preceding.room) < jnp.abs(leaves) / 2
    ends = ends & ~((here.distance < 0) & carried_on)
    begun = here.distance / jnp.where(begins, travel, 1.0)
    return Crossings(begins, ends, jnp.where(begins, begun, 1 + preceding.room / jnp.where(ends, leaves, 1.0)))


def replaced_points(here: Course, preceding: Course, timestep: float | Scalar) -> Int[Array, ""]:
    """Number of contact points that appear, or that vanish under force, deeper than the bodies' motion explains.

    Args:
        here, preceding: what the guards do in the step, and did in the one before.
    """
    points, others = here.points, preceding.points
    if points is None or others is None:
        return jnp.zeros((), int)
    deep = here.distance < -SPARE * timestep * jnp.abs(here.speed)
    deep_before = preceding.pushes & (preceding.room < -SPARE * timestep * jnp.abs(preceding.leaving))
    flags = here.distance < 0, preceding.distance < 0, deep, deep_before
    split = len(here.distance) - len(points.reach)
    touching, touched, deep, deep_before = (each[:split] for each in flags)  # limits, and corners at planes
    corners = jnp.sum(touching & deep & ~touched) + jnp.sum(touched & deep_before & ~touching)
    touching, touched, deep, deep_before = (each[split:] for each in flags)
    same = jnp.all(points.geom[:, None] == others.geom[None], axis=-1) & touching[:, None] & touched[None]
    moved = jnp.linalg.norm(points.place[:, None] - others.place[None], axis=-1)
    near = same & (moved <= jnp.maximum(points.reach[:, None], others.reach[None]))
    appear = touching & deep & ~jnp.any(near, axis=1)
    vanish = touched & deep_before & ~jnp.any(near, axis=0)
    return corners + jnp.sum(appear) + jnp.sum(vanish)


def onset_begins(distance: Float[Array, "*steps guards"], travel: Float[Array, "*steps guards"]) -> Bool[Array, "..."]:
    """Whether contact begins at a step, from each guard's distance before it and travel in the preceding step."""
    return (distance < 0) & (travel < 0) & (distance - travel > -TOUCHING_SHARE * travel)


class Touch(NamedTuple):
    """Where the distance of a guard passes zero within the step before k.

    Attributes:
        share: s, the part of the step since then.
        weights: weights of the jumps of steps k and k - 1: 1 - s and s, or as in `at_touch`.
        travel: travel of the guard in a step at the rate that it has there, negative if it closes.
        qpos: position close to it, in contact.
        valid: whether it passes zero within the step, by motion.
    """

    share: Scalar
    weights: tuple[Scalar, Scalar]
    travel: Scalar
    qpos: Qpos
    valid: Bool[Array, ""]


def at_touch(_: Any, model: mjx.Model, template: mjx.Data, qpos: Qpos, qvel: Qvel, event: Events) -> Touch:
    """Find the touch on the path of the step before k, on which the distance is a parabola.

    A body that passes an edge may be in contact for less than a step. A body slightly ahead of it then misses the edge,
    and the samples in contact, a share l of a step, must stand for both sides of first touch: their weight is
    2 (1 - s / l) / l. After a contact or a gap of one step (`Events.brief`), step k - 1 has no weight, since its
    boundary is the one that the event before has already counted.

    Position and velocity are those before step k, at which the event begins or ends; the template has everything else.
    The first argument is a solver's place, for callers of functions with one.
    """
    timestep, guard, ends = model.opt.timestep, event.guard, event.ends

    def position(back):
        return integrate_position(model, qpos, qvel, -timestep * back)

    def stage(back):
        found = find_guards(model, fwd_position(model, template.replace(qpos=position(back))), qvel, ends)
        return found.distance[guard], timestep * found.speed[guard]

    def since(distance: Array, travel: Array, curvature: Array) -> tuple[Array, Array]:
        """Share of a step since the distance was zero, and the travel at that time."""
        speed = jnp.sqrt(jnp.maximum(travel**2 - 2 * curvature * distance, 0.0))
        return -2 * distance / jnp.maximum(speed - travel, tiny), -speed

    zero, tiny = jnp.zeros_like(qpos, shape=()), jnp.finfo(qpos.dtype).tiny
    inside = jnp.where(ends, 1.0, zero)
    known, (_, curvature) = jax.jvp(stage, (inside,), (-jnp.ones_like(zero),))
    distance, travel = known
    begun, _ = since(distance, travel, curvature)
    away = jnp.where(ends, jnp.maximum(distance / jnp.where(travel == 0, 1.0, travel), -1.0), jnp.minimum(begun, 1.0))
    away = (1 - NEAR_TOUCH) * away
    at_back = stage(inside + away)
    # MJX may report no contact close to the touch, or another one in its place.
    unexpected = jnp.abs(at_back[0] - (distance - travel * away + curvature * away**2 / 2))
    chosen = (at_back[0] < 0) & (unexpected < jnp.abs(distance) / 2)
    choose = lambda one, other: jax.tree.map(partial(jnp.where, chosen), one, other)  # noqa: E731
    (distance, travel), back = choose((at_back, inside + away), (known, inside))
    more, closing = since(distance, travel, curvature)
    share = back + jnp.where(ends, distance / jnp.where(travel == 0, 1.0, travel), more)
    travel = jnp.where(ends, travel, closing)
    length = jnp.where(curvature > 0, -2 * closing / jnp.where(curvature > 0, curvature, 1.0), jnp.inf)
    passes = ~ends & (length < 1)
    length = jnp.where(passes, length, 1.0)
    last = jnp.where(passes, 2 * jnp.maximum(1 - share / length, 0.0) / length, 1 - share)
    moves = (distance < 0) & (share > 0) & (share < 1 - TOUCHING_SHARE) & (~ends | (travel > 0))
    before = jnp.where(passes | event.brief, 0.0, share)
    return Touch(share, (last, before), travel, position(back), event.used & moves)
