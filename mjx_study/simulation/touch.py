"""Where contact begins and ends in a rollout: the steps, and the moment of touch within them."""

import dataclasses
from functools import partial
from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from estimators.pytree import register_pytree
from mjx_study.simulation import constraint
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.dynamics import Qpos, Qvel, Scalar, fwd_position
from mjx_study.simulation.integration import integrate_position

TOUCHING_SHARE: Final = 1e-6
"""Share of a cell: a body closer than this before the step was already touching, so there is no onset."""
NEAR_TOUCH: Final = 0.1
"""Share of the way from the touch to the state in contact at which the contact's geometry is evaluated."""


Flags = Bool[Array, " slots"]


@register_pytree
@dataclasses.dataclass(frozen=True)
class OnsetCounts:
    """Counts of the onsets in a corrected derivative.

    Attributes:
        found: onsets of contacts and limits, and missed events.
        bounded: onsets and ends at grazing speed, whose term is bounded.
        missed: events left uncorrected for lack of slots.
        strength: root-mean-square share of the approach speed that a corrected onset removes in one step; 0 if there is
            none, and with the jump, whose error does not depend on it.
        first: step of the first onset; NaN if there is none.
    """

    found: Int[Array, "*batch"]
    bounded: Int[Array, "*batch"]
    missed: Int[Array, "*batch"]
    strength: Float[Array, "*batch"]
    first: Float[Array, "*batch"]

    @classmethod
    def none(cls, dtype: Any) -> "OnsetCounts":
        """Counts of a rollout without constraints."""
        zero = jnp.zeros((), int)
        return cls(zero, zero, zero, jnp.zeros((), dtype), jnp.full((), jnp.nan, dtype))


@register_pytree
@dataclasses.dataclass(frozen=True)
class Events:
    """Steps at which a contact or limit begins, or ends while it exerts a force, earliest first.

    Attributes:
        step, guard: index of the step and of the contact or limit, as in `constraint.guard_rows`.
        ends: whether it ends at that step; otherwise it begins.
        brief: whether the gap before it, or the contact that ends, lasted one step.
        used: whether the slot holds an event; others hold step 1, guard 0.
    """

    step: Int[Array, "*slots"]
    guard: Int[Array, "*slots"]
    ends: Bool[Array, "*slots"]
    brief: Bool[Array, "*slots"]
    used: Bool[Array, "*slots"]

    def counts(
        self, missed: Int[Array, ""], valid: Flags, narrow: Flags, strength: Float[Array, " slots"]
    ) -> OnsetCounts:
        """Counts of a rollout, from the number of events without a slot and from what the term says of the others."""
        begins = valid & ~self.ends
        onsets = jnp.sum(begins)
        first = jnp.min(jnp.where(begins, self.step.astype(strength.dtype), jnp.inf), initial=jnp.inf)
        first = jnp.where(jnp.isinf(first), jnp.nan, first)
        strength = jnp.sqrt(jnp.sum(jnp.where(begins, strength, 0.0) ** 2) / jnp.maximum(onsets, 1))
        return OnsetCounts(onsets + missed, jnp.sum(narrow), missed, strength, first)


def find_events(
    distance: Float[Array, "horizon guards"],
    speed: Float[Array, "horizon guards"],
    under_force: Bool[Array, "horizon guards"],
    timestep: float | Float[Array, ""],
    slots: int,
) -> tuple[Events, Int[Array, ""]]:
    """Find where contacts and limits may begin, or end under force (`at_touch` says whether they do); count the rest.

    Args:
        distance, speed: `constraint.guards` before each step.
        under_force: whether each guard exerts a force in each step.
        slots: maximum number of events to return.
    """
    active = distance < 0
    before = jnp.roll(active, 1, axis=0)
    begins = onset_begins(distance, timestep * speed) | (active & ~before)
    ends = before & ~active & jnp.roll(under_force, 1, axis=0)
    brief = ends ^ jnp.roll(active, 2, axis=0).at[:2].set(False)
    happens = (begins | ends).at[0].set(False)
    (flat,) = jnp.nonzero(happens.reshape(-1), size=slots, fill_value=happens.size)
    used = flat < happens.size
    step, guard = jnp.divmod(jnp.where(used, flat, happens.shape[1]), happens.shape[1])
    return Events(step, guard, ends[step, guard], brief[step, guard], used), jnp.sum(happens) - jnp.sum(used)


def onset_begins(distance: Float[Array, "*steps guards"], travel: Float[Array, "*steps guards"]) -> Bool[Array, "..."]:
    """Whether contact begins at a step, from each guard's distance before it and travel in the preceding step."""
    return (distance < 0) & (travel < 0) & (distance - travel > -TOUCHING_SHARE * travel)


@dataclasses.dataclass(frozen=True)
class Touch:
    """Where the distance of a guard passes zero within the step before k.

    Attributes:
        share: s, the part of the step since then.
        weights: weights of the jumps of steps k and k - 1: 1 - s and s, or as in `at_touch`.
        travel: travel of the guard in a step at the rate that it has there, negative if it closes.
        positioned: position stage close to it, in contact.
        valid: whether it passes zero within the step, by motion.
    """

    share: Scalar
    weights: tuple[Scalar, Scalar]
    travel: Scalar
    positioned: mjx.Data
    valid: Bool[Array, ""]


def at_touch(model: mjx.Model, template: mjx.Data, qpos: Qpos, qvel: Qvel, event: Events) -> Touch:
    """Find the touch on the path of the step before k, on which the distance is a parabola.

    A body that passes an edge may be in contact for less than a step. A body slightly ahead of it then misses the edge,
    and the samples in contact, a share l of a step, must stand for both sides of first touch: their weight is
    2 (1 - s / l) / l. After a contact or a gap of one step (`Events.brief`), step k - 1 has no weight, since its
    boundary is the one that the event before has already counted.

    Position and velocity are those before step k, at which the event begins or ends; the template has everything else.
    """
    timestep, guard, ends = model.opt.timestep, event.guard, event.ends

    def stage(back):
        data = fwd_position(model, template.replace(qpos=integrate_position(model, qpos, qvel, -timestep * back)))
        distance, speed = constraint.guards(model, data.replace(qvel=qvel))
        return (distance[guard], timestep * speed[guard]), data

    def since(distance: Array, travel: Array, curvature: Array) -> tuple[Array, Array]:
        """Share of a step since the distance was zero, and the travel at that time."""
        speed = jnp.sqrt(jnp.maximum(travel**2 - 2 * curvature * distance, 0.0))
        return -2 * distance / jnp.maximum(speed - travel, tiny), -speed

    zero, tiny = jnp.zeros_like(qpos, shape=()), jnp.finfo(qpos.dtype).tiny
    (distance, travel), (_, curvature), deep = jax.jvp(stage, (zero,), (-jnp.ones_like(zero),), has_aux=True)
    begun, _ = since(distance, travel, curvature)
    back = jnp.where(ends, 1.0, (1 - NEAR_TOUCH) * jnp.minimum(begun, 1.0))
    at_back, near = stage(back)
    # MJX may report no contact close to the touch, or another one in its place.
    chosen = ends | (at_back[0] < 0)
    choose = lambda one, other: jax.tree.map(partial(jnp.where, chosen), one, other)  # noqa: E731
    (distance, travel), positioned, back = choose((at_back, near, back), ((distance, travel), deep, zero))
    more, closing = since(distance, travel, curvature)
    share = back + jnp.where(ends, distance / jnp.where(travel == 0, 1.0, travel), more)
    travel = jnp.where(ends, travel, closing)
    length = jnp.where(curvature > 0, -2 * closing / jnp.where(curvature > 0, curvature, 1.0), jnp.inf)
    passes = ~ends & (length < 1)
    length = jnp.where(passes, length, 1.0)
    last = jnp.where(passes, 2 * jnp.maximum(1 - share / length, 0.0) / length, 1 - share)
    moves = (distance < 0) & (share > 0) & (share < 1 - TOUCHING_SHARE) & (~ends | (travel > 0))
    before = jnp.where(passes | event.brief, 0.0, share)
    return Touch(share, (last, before), travel, positioned, event.used & moves)
