r"""Derivatives of rollouts that account for a change of the steps at which contact begins and ends.

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

Not covered: initial contact; features of a geom whose contact point jumps.

Part of the jump is proportional to the acceleration a of the guard rather than its speed: at grazing speed, Delta/D and
with it the variance of the correction diverge. Cells narrower than h |a| / max(b, sqrt(k d)), with b and k the
contact's damping and stiffness and d its impedance, therefore count as that wide: slower bodies are pressed together
rather than colliding. The flux of onsets is proportional to their speed, so few are that slow; they are counted.

Reference: Kong, Payne, Zhu, Johnson, "Saltation Matrices: The Essential Tool for Linearizing Hybrid Dynamical Systems"
(arXiv 2306.06862), for the continuous-time limit.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from mjx_study.choices import ONSETS, unknown
from mjx_study.graph.derivative_rule import flat_with_rule, refusing, with_rule
from mjx_study.graph.native import native_identity
from mjx_study.graph.scalars import traced_part, unrolled
from mjx_study.simulation import constraint, guards
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Qvel, Rows, Scalar
from mjx_study.simulation.dynamics import (
    Act,
    Control,
    ControlLaw,
    Controls,
    Point,
    Qpos,
    RunningCost,
    State,
    advance_velocity,
    change_over,
    entry_by_entry,
    force_stage,
    fwd_position,
    observed_step,
    simulated,
    trajectory,
    with_solver,
)
from mjx_study.simulation.integration import difference_position, integrate_position
from mjx_study.simulation.linear_algebra import MOST_UNROLLED
from mjx_study.simulation.over_model import Moving, moved_by_model, slope_over
from mjx_study.simulation.scene import Scene
from mjx_study.simulation.touch import Changes, Events, OnsetCounts, Past, Touch, at_touch, changes, events_of

SLOTS: Final = 32
"""Minimum number of slots of a rollout for events to correct; later events are only counted."""
SLOTS_PER_GUARD: Final = 8  # slots per contact or limit of the scene
TOGETHER: Final = 8
"""Number of events that an accelerator computes in the time of one."""


def check_onset(onset: str) -> None:
    if onset not in ONSETS:
        raise ValueError(unknown("onset", onset, ONSETS))


def as_row(counts: OnsetCounts | None) -> Float[Array, "*batch 6"] | None:
    """Stack the counts in one array, as stored in batches."""
    return None if counts is None else jnp.stack(jax.tree.leaves(counts), axis=-1).astype(float)


def corrected_rollout(
    scene: Scene,
    model: mjx.Model,
    start: State,
    control_law: ControlLaw,
    horizon: int,
    simulate: Callable[..., Any] | None = None,
    **options: Any,
) -> tuple[State, Controls, Float[Array, " horizon"], OnsetCounts]:
    """`dynamics.rollout` with the same values, but derivatives that include the onset term, of `corrected` or alike."""
    law = control_law, jnp.arange(horizon)
    last, found, counts = (simulate or corrected)(scene, model, start, *law, lambda *_: None, **options)
    states, controls, residuals, _ = found
    return trajectory(states, last), controls, residuals, counts


def corrected(
    scene: Scene,
    model: mjx.Model,
    start: State,
    control_law: ControlLaw,
    inputs: Any,
    running_cost: RunningCost,
    slots: int | None = None,
    weight: float | Scalar = 1.0,
) -> tuple[State, tuple[State, Controls, Float[Array, " horizon"], Any], OnsetCounts]:
    """`dynamics.simulated` with the same values, but derivatives that include the onset term.

    First derivatives with respect to initial state, controls and model, in forward and reverse mode.

    Args:
        model: the model to step; may be traced.
        slots: maximum number of events to correct, earliest first; by default `slots_for` the scene.
        weight: factor of the term; 0 gives the derivatives of `dynamics.simulated`.
    """
    if not guards.num_guards(scene.template):
        found = simulated(scene, model, start, control_law, inputs, running_cost)
        return *found, OnsetCounts.none(start.qpos.dtype)
    fixed_model, timestep = without_derivative(model), timestep_of(scene, model)
    slots = slots_for(scene, len(jax.tree.leaves(inputs)[0])) if slots is None else slots
    acted = acting(control_law, running_cost)
    last, past, known = observed_rollout(scene, fixed_model, start, acted, inputs)
    before, controls, after, residuals, costs, found = known
    terms, events, counts = _corrections(scene, fixed_model, before, controls, after, found, past, slots)
    spread, shift, slope = jax.lax.stop_gradient((weight * terms.spread, weight * terms.shift, terms.slope))
    of_model = moved_by_model(scene, model, before, events)[:, None]
    over_model = tuple(jnp.zeros_like(before.qvel).at[events.step].add(of_model * each) for each in (shift, spread))

    def follow(state: State, known):
        given, fixed, values, after, own, (earlier, later) = known
        state = moving_values(fixed, state)
        control, cost = moving_values(values, acted(given, state))
        moved = difference_position(scene.host, fixed.qpos, state.qpos)
        velocity = tangent_of(along_events(shift, slope, own, moved - timestep * state.qvel) + earlier)
        shifted = integrate_position(scene.host, state.qpos, velocity, timestep), state.qvel + velocity
        qpos, qvel = moving_values((fixed.qpos, fixed.qvel), shifted)
        qvel, act = known_step(scene, model, (qpos, qvel, state.act, control), after)
        qvel = qvel + tangent_of(along_events(spread, slope, own, moved) + later)
        following = State(integrate_position(scene.host, qpos, qvel, timestep), qvel, act, after.warmstart)
        return following, (state, control, cost)

    own = jnp.minimum(found.before, slots), jnp.minimum(found.after, slots)
    known = inputs, before, (controls, costs), after, own, over_model
    moving, (states, controls, costs) = jax.lax.scan(follow, start, known)
    return moving_values(last, moving), (states, controls, residuals, costs), counts


Acted = Callable[[Any, State], tuple[Control, Any]]
"""The control of a step and its cost, from its input and the state before it."""


def acting(control_law: ControlLaw, running_cost: RunningCost) -> Acted:
    """Return the two of a rollout as one function."""

    def acted(given: Any, state: State) -> tuple[Control, Any]:
        control = control_law(given, state)
        return control, running_cost(state, control)

    return acted


def observed_rollout(scene: Scene, model: mjx.Model, start: State, acted: Acted, inputs: Any) -> tuple[Any, ...]:
    """A rollout without derivatives.

    Args:
        model: the model to step, without derivatives.
        inputs: of every step.

    Returns:
        The state after it, what its guards did, and of every step the state before it, its control, the state after it,
        its residual and cost, and its `Changes`.
    """

    def observe(carry: tuple[State, Past], given: Any):
        state, past = carry
        control, cost = jax.lax.stop_gradient(acted(given, state))
        following, residual, past, found = with_solver(partial(_observed, scene), model, state, control, past)
        return (following, past), (state, control, following, residual, cost, found)

    begin = jax.lax.stop_gradient(start)
    step = partial(observed_step, scene, constraint.run_solver, model)
    course = lambda given: step(begin, acted(given, begin)[0])[2]  # noqa: E731
    like = jax.eval_shape(course, jax.tree.map(lambda leaf: leaf[0], inputs))
    (last, past), known = jax.lax.scan(observe, (begin, Past.none(like)), inputs)
    return last, past, known


def timestep_of(scene: Scene, model: mjx.Model) -> float | Scalar:
    """Timestep h [s] of a model, with its derivative; a number where it is the scene's."""
    return model.opt.timestep if isinstance(model.opt.timestep, Tracer) else scene.timestep


def slots_for(scene: Scene, horizon: int) -> int:
    """Number of events that can be corrected in a rollout; each slot takes memory and time, filled or not."""
    return max(SLOTS, min(SLOTS_PER_GUARD * guards.num_guards(scene.template), horizon))


def _observed(scene: Scene, solver: constraint.Solver, model: mjx.Model, state: State, control: Control, past: Past):
    after, residual, course = observed_step(scene, solver, model, state, control)
    return after, residual, *changes(course, past, timestep_of(scene, model))


def moving_values(known: Any, moving: Any) -> Any:
    """Known values, with the derivatives of others."""
    return jax.tree.map(_with_tangent, known, moving)


def known_step(scene: Scene, model: mjx.Model, point: Point, after: State) -> tuple[Qvel, Act]:
    """Velocity and activations after a step, which are known, with their derivatives over what precedes it."""
    traced, whole = traced_part(model)

    def known(traced: Any, point: Point, after: State) -> tuple[Qvel, Act]:
        return after.qvel, after.act

    def rule(primals: Any, changes: Any) -> Any:
        traced, point, after = primals
        inputs = traced, *differentiated_once(point)
        return step(*primals), change_over(scene, whole, inputs, after.warmstart, (changes[0], *changes[1]))[1:3]

    step = with_rule(known, rule)
    return step(traced, point, after)


class Terms(NamedTuple):
    """Terms of events.

    Attributes:
        spread, shift: (1 - s) Delta / D and s Delta / D.
        slope: n, the derivative of the guard's distance.
    """

    spread: Float[Array, "*events nv"]
    shift: Float[Array, "*events nv"]
    slope: Float[Array, "*events changes"]


def _corrections(
    scene: Scene,
    model: mjx.Model,
    before: State,
    controls: Controls,
    after: State,
    found: Changes,
    past: Past,
    slots: int,
) -> tuple[Terms, Events, OnsetCounts]:
    """Terms of the events, the events, and counts."""
    events = events_of(found, slots)

    def term(event: Events):
        pick = lambda leaf: jnp.stack([leaf[event.step], leaf[event.step - 1]])  # noqa: E731
        qpos, qvel, act, inputs, solved = map(pick, (before.qpos, before.qvel, before.act, controls, after.warmstart))
        states = State(qpos, qvel, act, jnp.where(event.ends, solved[::-1], solved))
        given, in_parts = (model, scene.template, states, inputs, event), partial(onset_term, with_solver)
        if model.nv <= MOST_UNROLLED:
            return entry_by_entry(partial(onset_term, with_run_solver), *given)
        if native_identity() is None or isinstance(model.body_mass, Tracer):
            return in_parts(*given)
        return unrolled(partial(onset_term, with_newton), *given, otherwise=in_parts)

    terms, strength, narrow, valid, rate = over_events(term, events)
    chatters = events.chattering(rate, timestep_of(scene, model))
    spread, shift = (jnp.where(chatters[:, None], 0.0, part) for part in (terms.spread, terms.shift))
    terms = terms._replace(spread=spread, shift=shift)
    return terms, events, events.counts(past, valid, narrow, strength, chatters)


def over_events(function: Callable[[Events], Any], events: Events) -> Any:
    """A function of every event, zeros for those slots that no sample of a batch uses."""

    def fill(_: None, some: Events):
        """Of a few events; a loop, which ends at once where no sample has any.

        It carries the events, and clears them, since what depends on nothing that changes is computed before it.
        """
        none = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(every, some))
        once = lambda carry: (jnp.zeros((), bool), jax.tree.map(jnp.zeros_like, carry[1]), every(carry[1]))  # noqa: E731
        return None, jax.lax.while_loop(lambda carry: carry[0], once, (jnp.any(some.used), some, none))[2]

    every, few = (function, ()) if jax.default_backend() == "cpu" else (jax.vmap(function), (TOGETHER,))
    slots = len(events.used)
    grouped = jax.tree.map(lambda leaf: jnp.resize(leaf, (-(-slots // math.prod(few)), *few, *leaf.shape[1:])), events)
    _, each = jax.lax.scan(fill, None, grouped)
    return jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[1 + len(few) :])[:slots], each)


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


def with_run_solver(function: Callable[..., Any], model: mjx.Model, *arguments: Any) -> Any:
    """Evaluate `function(solver, model, *arguments)` in MJX's operations."""
    return function(constraint.run_solver, model, *arguments)


def with_newton(function: Callable[..., Any], model: mjx.Model, *arguments: Any) -> Any:
    """The same with Newton's method, for native code."""
    return function(constraint.newton, model, *arguments)


class GuardAtTouch(NamedTuple):
    """A guard that passes zero.

    Attributes:
        normal: derivative of its distance.
        weights, deep: as in `guards.Guards`.
        members: the rows that begin or end with it.
        absent: rows of the event's `absent` guards.
        touching: rows without penetration.
    """

    normal: Qvel
    weights: Rows
    deep: Bool[Array, ""]
    members: Rows
    absent: Rows
    touching: Rows


def guard_at(model: mjx.Model, positioned: mjx.Data, qvel: Qvel, event: Events) -> GuardAtTouch:
    """The guard of an event, at the position stage of its touch and the velocity with which it moves there."""
    found = guards.find_guards(model, positioned, qvel, event.ends)
    flags, members = (event.absent, event.touching & ~found.deep), found.members
    absent, touching = (each.astype(members.dtype) @ members for each in flags)
    weights, deep = found.weights[event.guard], found.deep[event.guard]
    return GuardAtTouch(found.slopes(event.guard), weights, deep, members[event.guard], absent, touching)


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
    guard = guard_at(model, positioned, closing, event)
    forced = force_stage(model, positioned, qvel, act, control)
    touching = guards.at_first_touch(model, forced, guard.touching)

    def step(removed: Rows, warmstart: Qvel) -> tuple[Qvel, Qvel]:
        prepared = guards.without(touching, removed)
        qacc = solver(model, prepared.replace(qacc_warmstart=warmstart))
        return advance_velocity(model, prepared, qacc)[0], qacc

    on, off = step(guard.absent, warmstart[0]), step(guard.absent + guard.members, warmstart[1])
    qvel, qacc = (jnp.stack(each) for each in zip(on, off, strict=True))
    damper, spring = guards.relaxation_rates(model, positioned.replace(qvel=closing), guard.weights)
    rate = jnp.maximum(damper, spring)
    return Passages(qvel, qacc, guard.normal, rate, spring, guard.deep)


def least_travel(model: mjx.Model, across: Float[Array, " 2"], either: Bool[Array, ""], rate: Scalar) -> Scalar:
    """Travel of a guard in a step [m or rad] below which its onset counts as grazing: h |a| / max(b, sqrt(k d)).

    Args:
        across: acceleration of the guard with the contact and without [m/s^2 or rad/s^2].
        either: whether both count, as where contact ends or begins in penetration, or that without alone.
        rate: the larger of `guards.relaxation_rates`.
    """
    on, off = jnp.abs(across)
    return model.opt.timestep * jnp.where(either, jnp.maximum(on, off), off) / rate


def tangent_of(value: Float[Array, "..."]) -> Float[Array, "..."]:
    """Zero, with the derivative of `value`; differentiating it again raises TypeError."""
    return _with_tangent(jnp.zeros_like(value), value)


def _of_second(primals: Any, changes: Any) -> Any:
    return _with_tangent(primals[0], differentiated_once(primals[1])), changes[1]


_with_tangent = with_rule(lambda value, moving: value, _of_second)
"""A value without its own derivative, with that of another; differentiating it again raises TypeError."""
differentiated_once = refusing("derivatives with the onset term are of first order: it has no second derivative")


def along_events(
    jumps: Float[Array, "slots after"],
    slopes: Float[Array, "slots before"],
    own: tuple[Int[Array, ""], Int[Array, ""]],
    moved: Float[Array, " before"],
) -> Float[Array, " after"]:
    """Sum of some events' jumps times their slopes' products with a motion, linear in the latter.

    Args:
        own: the first of the events, and the one after the last.
    """

    def total(jumps: Array, slopes: Array, first: Array, last: Array, moved: Array) -> list[Array]:
        none = jnp.zeros(jumps.shape[1:], moved.dtype)
        add = lambda carry: (carry[0] + 1, carry[1] + jumps[carry[0]] * jnp.sum(slopes[carry[0]] * moved))  # noqa: E731
        return [jax.lax.while_loop(lambda carry: carry[0] < last, add, (first, none))[1]]

    def rule(primals: Sequence[Any], changes: Sequence[Any]) -> Any:
        return linear(*primals), linear(*primals[:-1], changes[-1])

    def transpose(fixed: Sequence[Any], adjoints: Sequence[Any]) -> list[Any]:
        jumps, slopes, first, last, _ = fixed
        return [*[None] * 4, along_events(slopes, jumps, (first, last), adjoints[0])]

    def linear(*arguments: Array) -> list[Array]:
        return flat_with_rule(total, arguments, rule, transpose)

    (found,) = linear(jumps, slopes, *own, moved)
    return found


def without_derivative(tree: Any) -> Any:
    """Return the pytree, without the derivatives of its traced leaves."""
    traced, whole = traced_part(tree)
    return whole(jax.lax.stop_gradient(traced))
