r"""Rollouts of an analytic system and their gradient by one adjoint sweep.

With A_h, B_h the Jacobians of a step,

    lambda_{H+1} = grad c_final,   lambda_h = c_x + A_h^T lambda_{h+1},   dV/du_h = c_u + B_h^T lambda_{h+1}.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_study.reference.system import System


@dataclasses.dataclass(frozen=True)
class Rollout:
    """States with the start first, and the total cost of each member of the batch."""

    states: Float[np.ndarray, "steps *batch states"]
    value: Float[np.ndarray, "*batch"]


def roll_out(
    system: System,
    start: Float[np.ndarray, " states"],
    controls: Float[np.ndarray, "*batch horizon controls"],
) -> Rollout:
    """Simulate an open-loop control sequence from `start`."""
    state = np.broadcast_to(np.asarray(start, float), (*controls.shape[:-2], system.num_states))
    states, value = [state], np.zeros(controls.shape[:-2])
    for step in range(controls.shape[-2]):
        value = value + system.cost(state, controls[..., step, :])
        state = system.step(state, controls[..., step, :])
        states.append(state)
    return Rollout(np.stack(states), np.asarray(value + system.final_cost(state)))


def value_and_gradient(
    system: System,
    start: Float[np.ndarray, " states"],
    controls: Float[np.ndarray, "*batch horizon controls"],
) -> tuple[Float[np.ndarray, "*batch"], Float[np.ndarray, "*batch horizon controls"]]:
    """Total cost and its exact gradient with respect to the controls."""
    rollout = roll_out(system, start, controls)
    adjoint = system.final_gradient(rollout.states[-1])
    gradient = np.empty(controls.shape)
    for step in reversed(range(controls.shape[-2])):
        state, control = rollout.states[step], controls[..., step, :]
        over_state, over_control = system.jacobians(state, control)
        cost_state, cost_control = system.cost_gradients(state, control)
        gradient[..., step, :] = cost_control + np.einsum("...ij,...i->...j", over_control, adjoint)
        adjoint = cost_state + np.einsum("...ij,...i->...j", over_state, adjoint)
    return rollout.value, gradient
