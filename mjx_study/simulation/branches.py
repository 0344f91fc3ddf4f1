r"""The onset term from rollouts in which contact does and does not begin: `--onset jump`.

As in `mjx_study.simulation.onset`, but with the jump of the cost itself instead of its linearisation: a rollout in
which contact begins at step k, with s = phi_k/D of its last step in penetration, adds

    ((1 - s) J_k n^T dq_k + s J_{k-1} n^T dq_{k-1}) / D,     J_j = V_{j+1}(on) - V_{j+1}(off),

to the derivative of its cost, where dq are the steps' own derivatives. Both J are evaluated at first touch: at the
position with phi = 0 between steps k - 1 and k, with the velocities of step k and of step k - 1. From there, step j is
taken once with the contact's rows at first touch and once without them, and each rollout continues to its end with the
same noise and feedback, later onsets included. Only the values of these four rollouts are needed.

The weights of neighbouring cells add up to 1, and first-order errors in the touch position and in the cell width cancel
between the two ends: the error is second order in the ratio of the cell width to the spread of phi. Unlike the error of
the linear term, it does not depend on the contact's damping or stiffness.
"""

from collections.abc import Callable
from typing import Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_study.simulation import constraint
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.dynamics import ControlLaw, State, force_stage, position_stage, step
from mjx_study.simulation.integration import difference_position, integrate_position
from mjx_study.simulation.onset import SLOTS, OnsetCounts, find_onsets, first_step, least_travel, on_and_off
from mjx_study.simulation.scene import Scene

WITHIN: Final = 0.1
"""Where the contact geometry is evaluated, as a share of the way from the touch to the penetrating state: MJX may not
report the contact at the touch itself."""
CostToGo = Callable[[Int[Array, ""], State], Float[Array, ""]]
RunningCost = Callable[[State, Float[Array, " nu"]], Float[Array, ""]]
FinalCost = Callable[[State], Float[Array, ""]]


def jump_term(
    scene: Scene,
    model: mjx.Model,
    states: State,
    controls: Float[Array, "horizon nu"],
    control_law: ControlLaw,
    running_cost: RunningCost,
    final_cost: FinalCost,
    slots: int = SLOTS,
) -> tuple[Float[Array, ""], OnsetCounts]:
    """Return zero, with the onset term as its derivative with respect to whatever the states depend on.

    Args:
        states: states from `dynamics.rollout`, `(horizon + 1, ...)`, with their derivatives.
        control_law: control law of the rollout, independent of the differentiated inputs.
        running_cost, final_cost: as in `tasks.Task`.
        slots: maximum number of onsets to correct, earliest first.

    Returns:
        The term, to be added to the cost, and the onset counts.
    """
    before, controls = jax.lax.stop_gradient((jax.tree.map(lambda leaf: leaf[:-1], states), controls))
    if not scene.has_constraints:
        return jnp.zeros_like(before.qpos, shape=()), OnsetCounts.none(before.qpos.dtype)

    def guards(qpos, qvel):
        return constraint.guards(model, position_stage(scene, model, qpos).replace(qvel=qvel))

    def cost_to_go(index, state):
        def advance(carry):
            index, state, total = carry
            control = control_law(index, state)
            following, _ = step(scene, model, state, control)
            return index + 1, following, total + running_cost(state, control)

        start = index, state, jnp.zeros_like(state.qpos, shape=())
        _, last, total = jax.lax.while_loop(lambda carry: carry[0] < len(controls), advance, start)
        return total + final_cost(last)

    distance, speed = jax.vmap(guards)(before.qpos, before.qvel)
    steps, chosen, used, found = find_onsets(distance, scene.timestep * speed, slots)
    filled = jnp.sum(used)
    weights = jnp.zeros((slots, 2, scene.host.nv), before.qpos.dtype)
    flags = jnp.zeros((slots, 2), int)

    def fill(carry):
        slot, weights, flags = carry
        place = steps[slot], chosen[slot]
        share = distance[place] / (scene.timestep * speed[place])
        weight, flag = _weights(scene, model, before, controls, cost_to_go, *place, share)
        return slot + 1, weights.at[slot].set(weight), flags.at[slot].set(flag)

    # not a scan: the loop over a batch ends with the last onset of any rollout
    _, weights, flags = jax.lax.while_loop(lambda carry: carry[0] < filled, fill, (jnp.zeros((), int), weights, flags))
    at = jnp.stack([steps, steps - 1], axis=1)
    moved = jax.vmap(jax.vmap(lambda fixed, here: difference_position(scene.host, fixed, here)))(
        before.qpos[at], states.qpos[at]
    )
    narrow, lost = jnp.sum(flags, axis=0)
    first = first_step(steps, used, weights.dtype)
    return jnp.sum(weights * moved), OnsetCounts(found, narrow, found - filled + lost, jnp.zeros_like(first), first)


def _weights(
    scene: Scene,
    model: mjx.Model,
    before: State,
    controls: Float[Array, "horizon nu"],
    cost_to_go: CostToGo,
    begins: Int[Array, ""],
    guard: Int[Array, ""],
    share: Float[Array, ""],
) -> tuple[Float[Array, "2 nv"], Bool[Array, " 2"]]:
    """(1 - s) J_k n / D and s J_{k-1} n / D of one onset; whether its cell is too narrow, and whether it is lost."""
    host, timestep = scene.host, scene.timestep
    qvel = before.qvel[begins]
    back = lambda part: integrate_position(host, before.qpos[begins], -qvel, timestep * share * part)  # noqa: E731
    touch, positioned = back(1.0), _in_touch(scene, model, back(1.0 - WITHIN), back(0.0), guard)
    normals, members = (jnp.asarray(rows, qvel.dtype)[guard] for rows in constraint.guard_rows(model, positioned))

    def jump(index):
        prepared = force_stage(model, positioned, before.qvel[index], before.act[index], controls[index])
        prepared = prepared.replace(qacc_warmstart=before.warmstart[index])
        (after, act), qacc = on_and_off(model, prepared, members)

        def go_on(qvel, act, qacc):
            return cost_to_go(index + 1, State(integrate_position(host, touch, qvel, timestep), qvel, act, qacc))

        on, off = jax.vmap(go_on)(after, act, qacc)
        return on - off, normals @ prepared._impl.efc_J, qacc[1]

    (here, previous), (normal, _), (free, _) = jax.vmap(jump)(jnp.stack([begins, begins - 1]))
    travel, least = timestep * (normal @ qvel), least_travel(model, positioned.replace(qvel=qvel), normals, free)
    lost = travel >= 0
    cell = jnp.where(lost, -1.0, jnp.minimum(travel, -least))
    weights = jnp.stack([(1 - share) * here, share * previous])[:, None] * normal / cell
    return jnp.where(lost, 0.0, weights), jnp.stack([~lost & (travel > -least), lost])


def _in_touch(scene: Scene, model: mjx.Model, near: Array, deep: Array, guard: Int[Array, ""]) -> mjx.Data:
    """Position stage near the touch, or deeper if MJX reports no contact there, since the contact's rows are needed."""
    first, second = (position_stage(scene, model, qpos) for qpos in (near, deep))
    meets = constraint.guards(model, first)[0][guard] < 0
    return jax.tree.map(lambda one, other: jnp.where(meets, one, other), first, second)
