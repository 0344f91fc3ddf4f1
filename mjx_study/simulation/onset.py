r"""Derivatives of rollouts that account for a change of the steps at which contact begins and ends.

Where a guard phi (the distance of a contact or limit minus its margin) passes zero, MuJoCo's force may jump. The
derivative of a rollout holds the index of that step fixed. For noise with a smooth density, the gradient of the mean
cost has a second part, from rollouts at which the index changes:

    grad F = E[grad f] - sum_k E[delta(phi_k) J_k grad phi_k],     J_k = V_{k+1}(on) - V_{k+1}(off) at phi_k = 0,

with V the cost to go. A rollout in which contact begins at step k has phi_k in (D, 0], where n = d phi / dq and
D = phi_k - phi_{k-1} = h n^T v_k. It lies between two others: one in which contact only just begins at step k
(phi_k = 0), and one in which it would have begun at step k - 1 (phi_{k-1} = 0). If phi is uniform over this cell,
linear interpolation gives the weights of both, and no extra rollout is needed. With s = phi_k/D and Delta_k the
velocity jump after step k,

    dx_{k+1} = A_k dx_k + (1 - s) Delta_k (n^T dq_k) / D + s A_k (h Delta_{k-1}, Delta_{k-1}) (n^T dq_{k-1}) / D,

where n^T dq_{k-1} = n^T (dq_k - h dv_k). This is the saltation matrix of a time-stepping scheme. Its error is O(h^2);
the first weight alone (s = 0) leaves an error of h b, where b is the contact's damping [1/s]. Where contact ends under
force, phi_k lies in [0, D), and the terms have the other sign. `touch.at_touch` finds s and the speed at touch where
the normal turns within the step, and the weights of contacts that are shorter.

Not covered: initial contact; features of a geom whose contact point jumps.

Part of the jump is proportional to the acceleration a of the guard rather than its speed: at grazing speed, Delta/D and
with it the variance of the correction diverge. Cells narrower than h |a| / max(b, sqrt(k d)), with b and k the
contact's damping and stiffness and d its impedance, therefore count as that wide: slower bodies are pressed together
rather than colliding. The flux of onsets is proportional to their speed, so few are that slow; they are counted.

Reference: Kong, Payne, Zhu, Johnson, "Saltation Matrices: The Essential Tool for Linearizing Hybrid Dynamical Systems"
(arXiv 2306.06862), for the continuous-time limit.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from mjx_study.choices import ONSETS, unknown
from mjx_study.graph.derivative_rule import refusing, with_rule
from mjx_study.graph.scalars import traced_part
from mjx_study.simulation import constraint, guards
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Qvel, Rows, Scalar
from mjx_study.simulation.dynamics import (
    ControlLaw,
    Controls,
    State,
    advance_velocity,
    entry_by_entry,
    force_stage,
    fwd_position,
    simulated,
    solved_step,
    step_change,
    trajectory,
)
from mjx_study.simulation.guards import Course
from mjx_study.simulation.integration import difference_position, integrate_position
from mjx_study.simulation.linear_algebra import product
from mjx_study.simulation.scene import Scene
from mjx_study.simulation.touch import Events, OnsetCounts, at_touch, find_events

SLOTS: Final = 8
"""Number of onsets corrected per rollout; later ones are only counted."""


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
    slots: int = SLOTS,
    weight: float | Scalar = 1.0,
    inputs: Any = None,
) -> tuple[State, Controls, Float[Array, " horizon"], OnsetCounts]:
    """`dynamics.rollout` with the same values, but derivatives that include the onset term.

    First derivatives with respect to initial state and controls, in forward and reverse mode.

    Args:
        model: the model to step; may be traced, but not differentiated (TypeError).
        slots: maximum number of onsets to correct, earliest first.
        weight: factor of the term; 0 gives the derivatives of `dynamics.rollout`.
        inputs: inputs of the control law, as for `dynamics.simulated`; None for the steps' indices.
    """
    inputs = jnp.arange(horizon) if inputs is None else inputs
    if not scene.has_constraints:
        last, (states, controls, residuals, _) = simulated(scene, model, start, control_law, inputs, lambda *_: None)
        return trajectory(states, last), controls, residuals, OnsetCounts.none(start.qpos.dtype)
    model = without_derivative(model)

    def observe(state: State, given: Any):
        control = jax.lax.stop_gradient(control_law(given, state))
        following, residual, course = solved_step(scene, model, state, control)
        return following, (state, control, following, residual, course)

    _, (before, controls, after, residuals, course) = jax.lax.scan(observe, jax.lax.stop_gradient(start), inputs)
    spread, shift, counts = _corrections(scene, model, before, controls, course, slots)
    spread, shift = weight * spread, weight * shift

    def follow(change: State, known):
        given, fixed, fixed_control, fixed_after, spread, shift = known
        state = jax.tree.map(lambda value, moved: value + tangent_of(moved), fixed, change)
        control = control_law(given, state)
        moved = tangent_of(difference_position(scene.host, fixed.qpos, state.qpos))
        velocity = tangent_along(shift, moved - scene.timestep * change.qvel)
        carried = tangent_of(integrate_position(scene.host, fixed.qpos, velocity, scene.timestep))
        point = fixed.qpos, fixed.qvel, fixed.act, fixed_control
        moving = change.qpos + carried, change.qvel + velocity, change.act, tangent_of(control)
        _, qvel, act, _ = map(tangent_of, step_change(scene, model, point, fixed_after.warmstart, moving))
        qvel = qvel + tangent_along(spread, moved)
        qpos = integrate_position(
            scene.host, fixed.qpos + change.qpos + carried, fixed_after.qvel + qvel, scene.timestep
        )
        following = State(tangent_of(qpos), qvel, act, jnp.zeros_like(qvel))
        return following, (following, tangent_of(control))

    known = (inputs, before, controls, after, spread, shift)
    _, (changes, over_controls) = jax.lax.scan(follow, jax.tree.map(tangent_of, start), known)
    states = jax.tree.map(jnp.add, after, changes)
    whole = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)
    return whole, controls + over_controls, residuals, counts


def _corrections(
    scene: Scene, model: mjx.Model, before: State, controls: Controls, course: Course, slots: int
) -> tuple[Float[Array, "horizon nv nv"], Float[Array, "horizon nv nv"], OnsetCounts]:
    """(1 - s) Delta_k n^T / D and s Delta_{k-1} n^T / D of every step, zero without events, and counts."""
    events, without = find_events(course, scene.timestep, slots)

    def term(event: Events):
        pick = lambda leaf: jnp.stack([leaf[event.step], leaf[event.step - 1]])  # noqa: E731
        states, inputs = jax.tree.map(pick, before), pick(controls)
        return entry_by_entry(onset_term, model, scene.template, states, inputs, event)

    def fill(carry):
        slot, terms = carry
        some = jnp.minimum(slot + jnp.arange(together), slots - 1)
        found = jax.vmap(term)(jax.tree.map(lambda leaf: leaf[some], events))
        return slot + together, jax.tree.map(lambda every, one: every.at[some].set(one), terms, found)

    # Most rollouts have fewer events than slots; an accelerator computes all slots in the time of one.
    together = 1 if jax.default_backend() == "cpu" else slots
    filled, (size, dtype) = jnp.sum(events.used), (scene.host.nv, course.distance.dtype)
    matrix, flag = jnp.zeros((slots, size, size), dtype), jnp.zeros(slots, bool)
    terms = matrix, matrix, jnp.zeros(slots, dtype), flag, flag
    if slots:
        _, terms = jax.lax.while_loop(lambda carry: carry[0] < filled, fill, (jnp.zeros_like(filled), terms))
    here, previous, strength, narrow, valid = terms
    empty = jnp.zeros((len(before.qpos), size, size), dtype)
    spread, shift = (empty.at[events.step].add(terms) for terms in (here, previous))
    return spread, shift, events.counts(without, valid, narrow, strength)


Moving = Mapping[int, Array]
"""Leaves of a model that change, by their places in it."""


def onset_term(
    model: mjx.Model,
    template: mjx.Data,
    states: State,
    controls: Float[Array, "cases nu"],
    event: Events,
    moving: Moving = MappingProxyType({}),
) -> tuple[Float[Array, "nv changes"], Float[Array, "nv changes"], Scalar, Bool[Array, ""], Bool[Array, ""]]:
    """(1 - s) Delta_k n^T / D, s Delta_{k-1} n^T / D, share of the approach speed lost, whether D was bounded, and
    whether the contact begins or ends by motion within the step; zeros and False otherwise.

    Delta is v'(on) - v'(off) at first touch, and n the derivative of the guard's distance over the nv coordinates, then
    over the entries of the model's moving leaves.

    Args:
        template: everything but the position.
        states, controls: velocities and activations before steps k and k - 1, and their controls; or of k for both.
        event: the contact or limit, and whether it ends.
        moving: leaves of the model that change.
    """
    touch = at_touch(model, template, states.qpos[0], states.qvel[0], event)
    positioned = touch.positioned
    rows: Any = positioned._impl
    guard = guard_at(model, positioned, states.qvel[0], event)

    def jump(qvel, act, control, warmstart):
        forced = force_stage(model, positioned, qvel, act, control).replace(qacc_warmstart=warmstart)
        (after, _), qacc = on_and_off(model, forced, guard)
        return after[0] - after[1], qacc

    jumps, qacc = jax.vmap(jump)(states.qvel, states.act, controls, states.warmstart)
    least = least_travel(model, positioned.replace(qvel=states.qvel[0]), guard, qacc[0], event.ends)
    normal = guard.weights @ rows.efc_J
    cell, valid = -jnp.maximum(jnp.abs(touch.travel), least), touch.valid
    last, before = touch.weights
    slope = jnp.concatenate([normal, _slope_over(moving, model, positioned, states.qvel[0], event)])
    here, previous = (jnp.outer(jump, slope) / cell for jump in (last * jumps[0], before * jumps[-1]))
    strength = -model.opt.timestep * (normal @ jumps[0]) / cell
    here, previous, strength = (jnp.where(valid, each, jnp.zeros_like(each)) for each in (here, previous, strength))
    return here, previous, strength, valid & (jnp.abs(touch.travel) < least), valid


def _slope_over(
    moving: Moving, model: mjx.Model, positioned: mjx.Data, qvel: Qvel, event: Events
) -> Float[Array, " entries"]:
    """Derivative of a guard's distance with respect to leaves of the model, at constant position."""
    leaves, structure = jax.tree.flatten(model)

    def distance(moving: Moving) -> Scalar:
        moved = structure.unflatten([moving.get(place, leaf) for place, leaf in enumerate(leaves)])
        return guards.motion(moved, fwd_position(moved, positioned), qvel, event.ends)[0][event.guard]

    return ravel_pytree(jax.grad(distance)(dict(moving)))[0].astype(qvel.dtype)


class GuardAtTouch(NamedTuple):
    """A guard that passes zero.

    Attributes:
        weights, deep: as in `guards.Guards`.
        members: the rows that begin or end with it.
        absent: rows of the event's `absent` guards.
        touching: rows without penetration.
    """

    weights: Rows
    deep: Bool[Array, ""]
    members: Rows
    absent: Rows
    touching: Rows


def guard_at(model: mjx.Model, positioned: mjx.Data, qvel: Qvel, event: Events) -> GuardAtTouch:
    """The guard of an event, at the position stage of its touch and the velocity with which it moves there."""
    found = guards.find_guards(model, positioned, qvel, event.ends)
    _, members = guards.guard_rows(model, positioned)
    members = jnp.asarray(members, found.weights.dtype)
    absent, touching = (each.astype(members.dtype) @ members for each in (event.absent, event.touching & ~found.deep))
    weights, deep = found.weights[event.guard], found.deep[event.guard]
    return GuardAtTouch(weights, deep, members[event.guard], absent, touching)


def least_travel(
    model: mjx.Model, data: mjx.Data, guard: GuardAtTouch, qacc: Float[Array, "2 nv"], ends: Bool[Array, ""]
) -> Scalar:
    """Travel of a guard in a step [m or rad] below which its onset counts as grazing: h |a| / max(b, sqrt(k d)).

    Arguments as for `guards.relaxation_rate`; the acceleration with and without the contact; whether contact ends.
    """
    rows: Any = data._impl
    on, off = jnp.abs((qacc @ rows.efc_J.T) @ guard.weights)
    fastest = jnp.where(ends | guard.deep, jnp.maximum(on, off), off)
    return model.opt.timestep * fastest / guards.relaxation_rate(model, data, guard.weights)


def on_and_off(
    model: mjx.Model, data: mjx.Data, guard: GuardAtTouch
) -> tuple[tuple[Float[Array, "2 nv"], Float[Array, "2 na"]], Float[Array, "2 nv"]]:
    """Velocities and activations after a step, and its accelerations, with the rows of a guard on or off.

    The data are those of `force_stage`, with the solver's warm start.
    """
    touching = guards.at_first_touch(model, data, guard.touching)

    def advanced(off):
        prepared = guards.without(touching, guard.absent + off * guard.members)
        qacc = constraint.run_solver(model, prepared)
        return advance_velocity(model, prepared, qacc), qacc

    return jax.vmap(advanced)(jnp.array([0.0, 1.0], guard.members.dtype))


def tangent_of(value: Float[Array, "..."]) -> Float[Array, "..."]:
    """Zero, with the derivative of `value`; differentiating it again raises TypeError."""
    return _tangent_of(value)


_tangent_of = with_rule(
    jnp.zeros_like, lambda primals, changes: (_tangent_of(differentiated_once(*primals)), changes[0])
)
differentiated_once = refusing("derivatives with the onset term are of first order: it has no second derivative")


def tangent_along(matrix: Float[Array, "outputs inputs"], inputs: Float[Array, " inputs"]) -> Float[Array, " outputs"]:
    """Zero, whose derivative is the matrix times that of the inputs."""
    return tangent_of(product(jax.lax.stop_gradient(matrix), inputs))


def without_derivative(model: mjx.Model) -> mjx.Model:
    """Return the model; differentiating with respect to it raises TypeError."""
    traced, whole = traced_part(model)
    return whole(_of_states_only(traced))


_of_states_only = refusing("the onset term has derivatives over states and controls, but not over the model")
