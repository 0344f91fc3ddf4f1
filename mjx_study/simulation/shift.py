r"""The onset term by shifts in time: `--onset shift`.

A rollout in which contact begins a step later is the rollout itself, a step late, as long as nothing but its state
moves it. So its own states tell what a shift of an event changes, to all orders in the contact's damping and however
many events follow. With states x_k, controls u_k and z_k = (x_{k+1} - x_{k-1})/2, the derivative dx_k is split into a
shift by a steps and the rest,

    dx_{k+1} = A_k (dx_k - a z_k) + B_k (du_k - a w_k) + a z_{k+1},     w_k = (u_{k+1} - u_{k-1})/2,

where A and B are the step's own derivatives. Where no event is near, that is A_k dx_k + B_k du_k up to curvature, and a
makes no difference. a starts from 0. If contact begins or ends at step k, then before step k - 1 it is chosen so that
the rest leaves the time of touch unchanged:

    a <- a + n^T (dq - a z^q + (1 - s) h (dv - a z^v)) / D,     D = n^T (z^q + (1 - s) h z^v),

with n the derivative of the guard's distance, s the share of a step since the touch, and z = (z^q, z^v) its parts of
position and velocity. The half of z that looks ahead has this a at once, the half that looks behind a step later; the
first and the last step have one half only.

For touches spread evenly over a cell, the mean of the derivative of the cost along a shift is the difference of the
cost over a whole step, which this computes; that half of each difference looks ahead and half behind makes the error
one of second order in the step over the spread. Since a whole step's shift is mapped to a whole step's shift whatever
s, events at fixed intervals, whose s are not spread, are right, too, and the variance over s vanishes.

Events of one step share a equally. A cell narrower than in `observed.least_travel` counts as that wide: only what a
lacks is then taken too small. Bodies on several feet, each with noise of its own, have one a: there the term of
`mjx_study.simulation.saltation` has less variance.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_study.simulation import guards
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Qvel, Scalar
from mjx_study.simulation.dynamics import Control, Qpos, State, entry_by_entry, fwd_position
from mjx_study.simulation.integration import difference_position, integrate_position
from mjx_study.simulation.observed import (
    Known,
    Observed,
    Replay,
    along_events,
    known_step,
    least_travel,
    moving_values,
    over_events,
    tangent_of,
)
from mjx_study.simulation.over_model import moved_by_model
from mjx_study.simulation.scene import Scene
from mjx_study.simulation.touch import Events, Flags, OnsetCounts, at_touch


def shifts(
    scene: Scene, model: mjx.Model, fixed_model: mjx.Model, seen: Observed, events: Events, weight: float | Scalar
) -> tuple[Replay, Scalar, Any, OnsetCounts]:
    """What `onset.corrected` needs of this term, as `saltation.saltation`; a is passed from step to step."""
    timestep, step_length = model.opt.timestep, fixed_model.opt.timestep
    before, controls, after, found = seen.before, seen.controls, seen.after, seen.found
    crossings = over_events(partial(_crossing_of, scene, fixed_model, before, after), events)
    travel, rate, valid, narrow = _cells(crossings, events, before.qvel, step_length)
    over_velocity = (1 - crossings.since)[:, None] * crossings.normal
    slopes = jnp.concatenate([crossings.normal, over_velocity, -travel[:, None]], axis=1)
    by_model = rate * moved_by_model(scene, model, before, events)
    by_model = jnp.zeros(len(controls), by_model.dtype).at[events.step - 1].add(by_model)

    def replay(state: State, earlier: Scalar, control: Control, known: Known, row: Any) -> tuple[State, Scalar]:
        (fixed, given, after), (own, of_model, previous, subsequent, goes_on) = known, row
        moved = difference_position(scene.host, fixed.qpos, state.qpos)
        moved = jnp.concatenate([moved, timestep * state.qvel - step_length * fixed.qvel, earlier[None]])
        (change,) = tangent_of(along_events(rate[:, None], slopes, own, moved))
        shift = earlier + change + of_model
        # halves of the differences to the step after and to the one before
        ahead, behind = weight * goes_on * shift / 2, weight * earlier / 2

        def along(past: Array, here: Array, following: Array) -> Array:
            return ahead * (following - here) + behind * (here - past)

        way = -step_length * (ahead * after.qvel + behind * fixed.qvel)
        rest = (
            integrate_position(scene.host, state.qpos, way, 1.0),
            state.qvel - along(previous.before.qvel, fixed.qvel, after.qvel),
            state.act - along(previous.before.act, fixed.act, after.act),
            control - along(previous.control, given, subsequent.control),
        )
        point = moving_values((fixed.qpos, fixed.qvel, fixed.act, given), rest)
        qvel, act = known_step(scene, model, point, after)
        qvel = qvel + along(fixed.qvel, after.qvel, subsequent.after.qvel)
        act = act + along(fixed.act, after.act, subsequent.after.act)
        return State(integrate_position(scene.host, state.qpos, qvel, timestep), qvel, act, after.warmstart), shift

    own = tuple(jnp.append(jnp.minimum(each[1:], len(events.used)), 0) for each in (found.before, found.after))
    at = jnp.arange(len(controls))

    def beside(number: int) -> Known:
        """What is known of the step before or after each; of the first or last step itself where there is none."""
        return jax.tree.map(lambda leaf: leaf[jnp.clip(at + number, 0, at[-1])], Known(before, controls, after))

    rows = own, by_model, beside(-1), beside(1), (at < at[-1]).astype(rate.dtype)
    nothing = jnp.zeros_like(rate)
    counts = events.counts(seen.past, valid, narrow, nothing, nothing > 0)
    return replay, jnp.zeros((), rate.dtype), rows, counts


class Crossing(NamedTuple):
    """A guard that passes zero.

    Attributes:
        normal: derivative of its distance.
        since: share of a step since then.
        valid: whether it does by motion.
        least: travel below which it grazes.
    """

    normal: Float[Array, "*slots nv"]
    since: Float[Array, "*slots"]
    valid: Bool[Array, "*slots"]
    least: Float[Array, "*slots"]


def _crossing_of(scene: Scene, model: mjx.Model, before: State, after: State, event: Events) -> Crossing:
    qpos, qvel = before.qpos[event.step], before.qvel[event.step]
    accelerations = jnp.stack([after.warmstart[event.step], after.warmstart[event.step - 1]])
    return entry_by_entry(_crossing, model, scene.template, qpos, qvel, accelerations, event)


def _crossing(
    model: mjx.Model, template: mjx.Data, qpos: Qpos, qvel: Qvel, accelerations: Float[Array, "2 nv"], event: Events
) -> Crossing:
    """An event's crossing, from the state before its step and the accelerations in it and in the one before."""
    touch = at_touch(None, model, template, qpos, qvel, event)
    positioned = fwd_position(model, template.replace(qpos=touch.qpos))
    found, own = guards.find_guards(model, positioned, qvel, event.ends), event.guard
    normal = found.slopes(own)
    rate = jnp.maximum(*guards.relaxation_rates(model, positioned.replace(qvel=qvel), found.weights[own]))
    least = least_travel(model, accelerations @ normal, event.ends | found.deep[own], rate)
    return Crossing(normal, jnp.clip(touch.share, 0, 1), touch.valid, least)


def _cells(
    crossings: Crossing, events: Events, qvel: Float[Array, "steps nv"], timestep: Scalar
) -> tuple[Array, Array, Flags, Flags]:
    """Cells that events' touches are spread over, from the velocities before every step.

    Returns D; 1 / D, of the cell's width, divided by the number of events in the step, 0 if the event is not valid;
    whether D has the event's sign; and whether the cell counts as wider.
    """
    at, sign = events.step - 1, jnp.where(events.ends, 1, -1)
    past, here, after = qvel[jnp.maximum(at - 1, 0)], qvel[at], qvel[events.step]
    between = (at > 0)[:, None]  # z before step k - 1, in which there is nothing behind the first
    moved = timestep * jnp.where(between, (here + after) / 2, after)
    sped = jnp.where(between, (after - past) / 2, after - here)
    path = moved + timestep * (1 - crossings.since)[:, None] * sped
    travel = jnp.sum(crossings.normal * path, axis=-1)
    valid = events.used & crossings.valid & (travel * sign > 0)
    width = jnp.where(valid, sign * jnp.maximum(jnp.abs(travel), crossings.least), 1.0)
    number = jnp.zeros(len(qvel), travel.dtype).at[at].add(valid)[at]
    rate = jnp.where(valid, 1 / (jnp.maximum(number, 1) * width), 0.0)
    return travel, rate, valid, valid & (jnp.abs(travel) < crossings.least)
