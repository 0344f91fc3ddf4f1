"""Derivatives of rollouts that account for a change of the steps at which contact begins and ends.

The derivative of a rollout holds the indices of those steps fixed. The onset term is what their change adds to the
derivative of the mean, to first order (`mjx_study.simulation.saltation`) or by shifts in time
(`mjx_study.simulation.shift`).

Not covered: initial contact; features of a geom whose contact point jumps.
"""

from typing import Any, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_study.choices import ONSETS, unknown
from mjx_study.simulation import guards
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.constraint import Scalar
from mjx_study.simulation.dynamics import Control, ControlLaw, Controls, RunningCost, State, simulated
from mjx_study.simulation.observed import Known, moving_values, observed_rollout, without_derivative
from mjx_study.simulation.saltation import saltation
from mjx_study.simulation.scene import Scene
from mjx_study.simulation.shift import shifts
from mjx_study.simulation.touch import OnsetCounts, events_of

SLOTS: Final = 32
"""Minimum number of slots of a rollout for events to correct; later events are only counted."""
SLOTS_PER_GUARD: Final = 8  # slots per contact or limit of the scene
TERMS: Final = {"linear": (saltation, 1), "shift": (shifts, 2)}
"""Terms, and how many times as many slots they have; shifts cost little."""


def check_onset(onset: str) -> None:
    if onset not in ONSETS:
        raise ValueError(unknown("onset", onset, ONSETS))


def as_row(counts: OnsetCounts | None) -> Float[Array, "*batch 6"] | None:
    """Stack the counts in one array, as stored in batches."""
    return None if counts is None else jnp.stack(jax.tree.leaves(counts), axis=-1).astype(float)


def corrected(
    scene: Scene,
    model: mjx.Model,
    start: State,
    control_law: ControlLaw,
    inputs: Any,
    running_cost: RunningCost,
    onset: str = "linear",
    slots: int | None = None,
    weight: float | Scalar = 1.0,
) -> tuple[State, tuple[State, Controls, Float[Array, " horizon"], Any], OnsetCounts]:
    """`dynamics.simulated` with the same values, but derivatives that include the onset term.

    First derivatives with respect to initial state, controls and model, in forward and reverse mode.

    Args:
        model: the model to step; may be traced.
        onset: "linear" or "shift".
        slots: maximum number of events to correct, earliest first; by default as many as the scene may have.
        weight: factor of the term; 0 gives the derivatives of `dynamics.simulated`.
    """
    if not guards.num_guards(scene.template):
        found = simulated(scene, model, start, control_law, inputs, running_cost)
        return *found, OnsetCounts.none(start.qpos.dtype)
    fixed_model, (term, more) = without_derivative(model), TERMS[onset]

    def acted(given: Any, state: State) -> tuple[Control, Any]:
        control = control_law(given, state)
        return control, running_cost(state, control)

    seen = observed_rollout(scene, fixed_model, start, acted, inputs)
    slots = more * _slots_for(scene, len(seen.controls)) if slots is None else slots
    replay, memory, rows, counts = term(scene, model, fixed_model, seen, events_of(seen.found, slots), weight)

    def follow(carry: Any, given: tuple[Any, Known, Any, Any]):
        (state, memory), (inputs, known, cost, row) = carry, given
        state = moving_values(known.before, state)
        control, cost = moving_values((known.control, cost), acted(inputs, state))
        return replay(state, memory, control, known, row), (state, control, cost)

    known = inputs, Known(seen.before, seen.controls, seen.after), seen.costs, rows
    (moving, _), (states, controls, costs) = jax.lax.scan(follow, (start, memory), known)
    return moving_values(seen.last, moving), (states, controls, seen.residuals, costs), counts


def _slots_for(scene: Scene, horizon: int) -> int:
    """Number of events that can be corrected in a rollout; each slot takes memory and time, filled or not."""
    return max(SLOTS, min(SLOTS_PER_GUARD * guards.num_guards(scene.template), horizon))
