r"""The onset term from rollouts in which contact does and does not act at first touch: `--onset jump`.

As in `mjx_study.simulation.onset`, but with the jump of the cost itself instead of its linearisation: a rollout in
which contact begins or ends at step k, the part s of a step after touch, adds

    ((1 - s) J_k n^T dq_k + s J_{k-1} n^T dq_{k-1}) / D,     J_j = V_{j+1}(on) - V_{j+1}(off),

to the derivative of its cost (with -|D| for D), where dq are the steps' own derivatives. Both J are evaluated at touch:
at the position with phi = 0 between steps k - 1 and k, with the velocities of step k and of step k - 1. From there,
step j is taken once with the contact's rows at first touch and once without them, and each rollout continues to its end
with the same noise and feedback, later onsets included. Only the values of these four rollouts are needed.

The weights of neighbouring cells add up to 1, and first-order errors in the touch position and in the cell width cancel
between the two ends: the error is second order in the ratio of the cell width to the spread of phi. Unlike the error of
the linear term, it does not depend on the contact's damping or stiffness.
"""

from collections.abc import Callable
from typing import Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_study.simulation import guards
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Scalar
from mjx_study.simulation.corners import corner_pairs
from mjx_study.simulation.dynamics import Control, ControlLaw, Controls, State, solved_step, step, with_solver
from mjx_study.simulation.integration import difference_position, integrate_position
from mjx_study.simulation.onset import Passages, least_travel, passages, slots_for, timestep_of, without_derivative
from mjx_study.simulation.over_model import moved_by_model
from mjx_study.simulation.scene import Scene
from mjx_study.simulation.touch import Events, OnsetCounts, Past, at_touch, changes, events_of

SLOTS: Final = 8
"""Number of events with branches of their own per rollout, more where corners meet planes; later ones are counted."""
CostToGo = Callable[[Int[Array, ""], State], Scalar]


def jump_term(
    scene: Scene,
    model: mjx.Model,
    states: State,
    controls: Controls,
    control_law: ControlLaw,
    running_cost: Callable[[State, Control], Scalar],
    final_cost: Callable[[State], Scalar],
    slots: int | None = None,
) -> tuple[Scalar, OnsetCounts]:
    """Return zero, with the onset term as its derivative with respect to the model and whatever the states depend on.

    Args:
        model: the model that was stepped, which may have derivatives.
        states: states from `dynamics.rollout`, `(horizon + 1, ...)`, with their derivatives.
        control_law: control law of the rollout, independent of the differentiated inputs.
        running_cost, final_cost: as in `tasks.Task`, likewise.
        slots: maximum number of events to correct, earliest first.
    """
    before, controls = jax.lax.stop_gradient((jax.tree.map(lambda leaf: leaf[:-1], states), controls))
    if not guards.num_guards(scene.template):
        return jnp.zeros_like(before.qpos, shape=()), OnsetCounts.none(before.qpos.dtype)
    moving_model, model = model, without_derivative(model)
    timestep = timestep_of(scene, model)

    def cost_to_go(index, state):
        def advance(carry):
            index, state, total = carry
            control = control_law(index, state)
            following, _ = step(scene, model, state, control)
            return index + 1, following, total + running_cost(state, control)

        start = index, state, jnp.zeros_like(state.qpos, shape=())
        _, last, total = jax.lax.while_loop(lambda carry: carry[0] < len(controls), advance, start)
        return total + final_cost(last)

    course = jax.vmap(lambda state, control: solved_step(scene, model, state, control)[-1])(before, controls)
    past = Past.none(jax.tree.map(lambda leaf: leaf[0], course))
    past, found = jax.lax.scan(lambda past, here: changes(here, past, timestep), past, course)
    if slots is None:
        slots = slots_for(scene, len(controls)) if corner_pairs(model) else SLOTS
    events = events_of(found, slots)
    slots = len(events.used)
    filled = jnp.sum(events.used)
    weights, normals = jnp.zeros((slots, 2), before.qpos.dtype), jnp.zeros((slots, scene.host.nv), before.qpos.dtype)
    flags, rates = jnp.zeros((slots, 2), bool), jnp.zeros(slots, before.qpos.dtype)

    def fill(carry):
        slot, *found = carry
        event = jax.tree.map(lambda leaf: leaf[slot], events)
        own = _weights(scene, model, before, controls, cost_to_go, event)
        return slot + 1, *(every.at[slot].set(one) for every, one in zip(found, own, strict=True))

    # not a scan: the loop over a batch ends with the last event of any rollout
    start = jnp.zeros((), int), weights, normals, flags, rates
    _, weights, normals, flags, rates = jax.lax.while_loop(lambda carry: carry[0] < filled, fill, start)
    chatters = events.chattering(rates, timestep)
    weights = jnp.where(chatters[:, None], 0.0, weights)
    at = jnp.stack([events.step, events.step - 1], axis=1)
    moved = jax.vmap(jax.vmap(lambda fixed, here: difference_position(scene.host, fixed, here)))(
        before.qpos[at], states.qpos[at]
    )
    narrow, valid = flags.T
    closer = jnp.einsum("ev,etv->et", normals, moved) + moved_by_model(scene, moving_model, before, events)[:, None]
    return jnp.sum(weights * closer), events.counts(past, valid, narrow, jnp.zeros(slots, weights.dtype), chatters)


def _weights(
    scene: Scene, model: mjx.Model, before: State, controls: Controls, cost_to_go: CostToGo, event: Events
) -> tuple[Float[Array, " 2"], Float[Array, " nv"], Bool[Array, " 2"], Scalar]:
    """(1 - s) J_k / D and s J_{k-1} / D of one event; n; whether its cell is too narrow, and whether it is valid; and
    its relaxation rate."""
    host, timestep = scene.host, timestep_of(scene, model)
    qpos, qvel = before.qpos[event.step], before.qvel[event.step]
    touch = with_solver(at_touch, model, scene.template, qpos, qvel, event)
    start = integrate_position(host, qpos, -qvel, timestep * touch.share)

    def jump(index):
        state = before.qvel[index], before.act[index], controls[index], jnp.tile(before.warmstart[index], (2, 1))

        def go_on(qvel, act, qacc):
            return cost_to_go(index + 1, State(integrate_position(host, start, qvel, timestep), qvel, act, qacc))

        found = with_solver(passages, model, scene.template, touch.qpos, qvel, *state, event)
        on, off = jax.vmap(go_on)(found.qvel, found.act, found.qacc)
        return on - off, found

    (here, previous), found = jax.vmap(jump)(jnp.stack([event.step, event.step - 1]))
    first: Passages = jax.tree.map(lambda leaf: leaf[0], found)
    normal, least = first.normal, least_travel(model, first, event.ends)
    cell, (last, earlier) = -jnp.maximum(jnp.abs(touch.travel), least), touch.weights
    weights = jnp.stack([last * here, earlier * previous]) / cell
    flags = jnp.stack([touch.valid & (jnp.abs(touch.travel) < least), touch.valid])
    return jnp.where(touch.valid, weights, 0.0), normal, flags, first.rate
