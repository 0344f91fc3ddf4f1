r"""The onset term to first order, from two steps per event: `--onset linear`.

Where a guard phi (the distance of a contact or limit minus its margin) passes zero, MuJoCo's force may jump. The
derivative of a rollout holds the index of that step fixed. For noise with a smooth density, the gradient of the mean
cost has a second part, from rollouts at which the index changes:

    grad F = E[grad f] - sum_k E[delta(phi_k) J_k grad phi_k],     J_k = V_{k+1}(on) - V_{k+1}(off) at phi_k = 0,

with V the cost to go. A rollout in which contact begins at step k has phi_k in (D, 0], where n = d phi / dq and
D = phi_k - phi_{k-1} = h n^T v_k. It lies between two others: one in which contact only just begins at step k
(phi_k = 0), and one in which it would have begun at step k - 1 (phi_{k-1} = 0). If phi is uniform over this cell,
linear interpolation gives the weights of both, and no extra rollout is needed. With s = phi_k/D and Delta the velocity
jump after a step from the touch,

    dx_{k+1} = A_k dx_k + (1 - s) Delta (n^T dq_k) / D + s A_k (h Delta, Delta) (n^T dq_{k-1}) / D,

where n^T dq_{k-1} = n^T (dq_k - h dv_k). This is the saltation matrix of a time-stepping scheme. The two jumps are
those from the velocities before steps k and k - 1; Delta is that from (1 - s) v_k + s v_{k-1}, so that the errors of
both terms cancel. What is left is O(h^2); the first weight alone (s = 0) leaves an error of h b, where b is the
contact's damping [1/s]. Where contact ends under force, phi_k lies in [0, D), and the terms have the other sign.
`touch.at_touch` finds s and the speed at touch where the normal turns within the step, and the weights of contacts
that are shorter.

Part of the jump is proportional to the acceleration a of the guard rather than its speed: at grazing speed, Delta/D and
with it the variance of the correction diverge. Cells narrower than h |a| / max(b, sqrt(k d)), with b and k the
contact's damping and stiffness and d its impedance, therefore count as that wide: slower bodies are pressed together
rather than colliding. The flux of onsets is proportional to their speed, so few are that slow; they are counted.

Reference: Kong, Payne, Zhu, Johnson, "Saltation Matrices: The Essential Tool for Linearizing Hybrid Dynamical Systems"
(arXiv 2306.06862), for the continuous-time limit.
"""

from collections.abc import Callable
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from mjx_study.simulation import constraint, guards
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Qvel, Rows, Scalar
from mjx_study.simulation.dynamics import (
    Act,
    Control,
    Qpos,
    State,
    advance_velocity,
    entry_by_entry,
    force_stage,
    fwd_position,
    with_solver,
)
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
from mjx_study.simulation.over_model import Moving, moved_by_model, slope_over
from mjx_study.simulation.scene import Scene
from mjx_study.simulation.touch import Events, OnsetCounts, Touch, at_touch


class Terms(NamedTuple):
    """Terms of events.

    Attributes:
        spread, shift: (1 - s) Delta / D and s Delta / D.
        slope: n, the derivative of the guard's distance.
    """

    spread: Float[Array, "*events nv"]
    shift: Float[Array, "*events nv"]
    slope: Float[Array, "*events changes"]


def saltation(
    scene: Scene, model: mjx.Model, fixed_model: mjx.Model, seen: Observed, events: Events, weight: float | Scalar
) -> tuple[Replay, tuple[()], Any, OnsetCounts]:
    """What `onset.corrected` needs of this term: how to derive a step again, with nothing from one to the next, the
    rows of that, and counts.

    Args:
        model: the model to step, which may have derivatives, and without them.
        seen: the rollout.
        events: its events.
        weight: factor of the term.
    """
    timestep = model.opt.timestep
    terms, counts = _terms_of(scene, fixed_model, seen, events)
    spread, shift, slope = jax.lax.stop_gradient((weight * terms.spread, weight * terms.shift, terms.slope))
    of_model = moved_by_model(scene, model, seen.before, events)[:, None]
    over_model = tuple(
        jnp.zeros_like(seen.before.qvel).at[events.step].add(of_model * each) for each in (shift, spread)
    )

    def replay(state: State, none: tuple[()], control: Control, known: Known, row: Any) -> tuple[State, tuple[()]]:
        own, (earlier, later) = row
        moved = difference_position(scene.host, known.before.qpos, state.qpos)
        velocity = tangent_of(along_events(shift, slope, own, moved - timestep * state.qvel) + earlier)
        shifted = integrate_position(scene.host, state.qpos, velocity, timestep), state.qvel + velocity
        qpos, qvel = moving_values((known.before.qpos, known.before.qvel), shifted)
        qvel, act = known_step(scene, model, (qpos, qvel, state.act, control), known.after)
        qvel = qvel + tangent_of(along_events(spread, slope, own, moved) + later)
        return State(integrate_position(scene.host, qpos, qvel, timestep), qvel, act, known.after.warmstart), none

    slots = len(events.used)
    own = jnp.minimum(seen.found.before, slots), jnp.minimum(seen.found.after, slots)
    return replay, (), (own, over_model), counts


def _terms_of(scene: Scene, model: mjx.Model, seen: Observed, events: Events) -> tuple[Terms, OnsetCounts]:
    """Terms of the events, and counts."""
    before, controls, after = seen.before, seen.controls, seen.after

    def term(event: Events):
        pick = lambda leaf: jnp.stack([leaf[event.step], leaf[event.step - 1]])  # noqa: E731
        qpos, qvel, act, inputs, solved = map(pick, (before.qpos, before.qvel, before.act, controls, after.warmstart))
        states = State(qpos, qvel, act, jnp.where(event.ends, solved[::-1], solved))
        whole, in_parts = partial(onset_term, with_newton), partial(onset_term, with_solver)
        return entry_by_entry(whole, model, scene.template, states, inputs, event, otherwise=in_parts)

    terms, strength, narrow, valid, rate = over_events(term, events)
    chatters = events.chattering(rate, model.opt.timestep)
    spread, shift = (jnp.where(chatters[:, None], 0.0, part) for part in (terms.spread, terms.shift))
    terms = terms._replace(spread=spread, shift=shift)
    return terms, events.counts(seen.past, valid, narrow, strength, chatters)


Call = Callable[..., Any]
"""Evaluates `function(solver, model, *arguments)` from (function, model, *arguments)."""


def onset_term(
    call: Call,
    model: mjx.Model,
    template: mjx.Data,
    states: State,
    controls: Float[Array, "cases nu"],
    event: Events,
    moving: Moving = MappingProxyType({}),
) -> tuple[Terms, Scalar, Bool[Array, ""], Bool[Array, ""], Scalar]:
    """Term of an event, share of the approach speed lost (see `OnsetCounts`), whether D was bounded, and whether the
    contact begins or ends by motion within the step; zeros and False otherwise. Last, its relaxation rate.

    Delta is v'(on) - v'(off) at first touch, and n the derivative of the guard's distance over the nv coordinates, then
    over the entries of the model's moving leaves.

    Args:
        call: how to evaluate the parts, functions of a solver, the model and arrays: `with_solver`, or plainly.
        template: everything but the position.
        states, controls: velocities and activations before steps k and k - 1, and their controls; or of k for both.
            The warm starts are those of steps with the contact and without, or one for both.
        event: the contact or limit, and whether it ends.
        moving: leaves of the model that change.
    """
    qpos, qvel = states.qpos[0], states.qvel[0]
    touch: Touch = call(at_touch, model, template, qpos, qvel, event)

    # between the two, as far from step k as the touch is
    since = jnp.clip(touch.share, 0, 1)
    at_once = lambda leaf: leaf[0] if len(leaf) == 1 else (1 - since) * leaf[0] + since * leaf[1]  # noqa: E731
    before = *map(at_once, (states.qvel, states.act, controls)), jnp.broadcast_to(states.warmstart, (2, len(qvel)))
    found: Passages = call(passages, model, template, touch.qpos, qvel, *before, event)
    jump, normal = found.qvel[0] - found.qvel[1], found.normal
    least = least_travel(model, found.qacc @ normal, event.ends | found.deep, found.rate)
    cell, valid = -jnp.maximum(jnp.abs(touch.travel), least), touch.valid
    last, earlier = touch.weights
    slope = normal
    if moving:
        positioned = fwd_position(model, template.replace(qpos=touch.qpos))
        slope = jnp.concatenate([normal, slope_over(moving, model, positioned, qvel, event)])
    strength = jnp.maximum(-model.opt.timestep * (normal @ jump) / cell, (model.opt.timestep * found.spring) ** 2)
    term = Terms(last * jump / cell, earlier * jump / cell, slope)
    term, strength = jax.tree.map(lambda each: jnp.where(valid, each, 0.0), (term, strength))
    return term, strength, valid & (jnp.abs(touch.travel) < least), valid, found.rate


def with_newton(function: Callable[..., Any], model: mjx.Model, *arguments: Any) -> Any:
    """Evaluate `function(solver, model, *arguments)` with Newton's method, as part of a graph."""
    return function(constraint.newton, model, *arguments)


class Passages(NamedTuple):
    """Two steps from the touch of a guard, first with its rows on, then with them off.

    Attributes:
        qvel: velocity after them.
        qacc: acceleration in them.
        normal: derivative of the guard's distance.
        rate, spring: the larger of `guards.relaxation_rates`, and the spring's.
        deep: as in `guards.Guards`.
    """

    qvel: Float[Array, "*cases 2 nv"]
    qacc: Float[Array, "*cases 2 nv"]
    normal: Float[Array, "*cases nv"]
    rate: Float[Array, "*cases"]
    spring: Float[Array, "*cases"]
    deep: Bool[Array, "*cases"]


def passages(
    solver: constraint.Solver,
    model: mjx.Model,
    template: mjx.Data,
    qpos: Qpos,
    closing: Qvel,
    qvel: Qvel,
    act: Act,
    control: Control,
    warmstart: Float[Array, "2 nv"],
    event: Events,
) -> Passages:
    """The steps from a touch at `qpos`, with the rows of the event's guard and without.

    The guard moves at velocity `closing`; velocity, activation and control are those of the step. Each of the two
    steps has its warm start.
    """
    positioned = fwd_position(model, template.replace(qpos=qpos))
    found, own = guards.find_guards(model, positioned, closing, event.ends), event.guard
    flags = (event.absent, event.touching & ~found.deep)
    absent, touching = (each.astype(found.members.dtype) @ found.members for each in flags)
    forced = guards.at_first_touch(model, force_stage(model, positioned, qvel, act, control), touching)

    def step(removed: Rows, warmstart: Qvel) -> tuple[Qvel, Qvel]:
        prepared = guards.without(forced, removed)
        qacc = solver(model, prepared.replace(qacc_warmstart=warmstart))
        return advance_velocity(model, prepared, qacc)[0], qacc

    on, off = step(absent, warmstart[0]), step(absent + found.members[own], warmstart[1])
    qvel, qacc = (jnp.stack(each) for each in zip(on, off, strict=True))
    damper, spring = guards.relaxation_rates(model, positioned.replace(qvel=closing), found.weights[own])
    return Passages(qvel, qacc, found.slopes(own), jnp.maximum(damper, spring), spring, found.deep[own])
