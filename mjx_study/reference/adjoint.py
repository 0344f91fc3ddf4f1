r"""Rollouts of an analytic system and their gradients by one adjoint sweep.

The control is u_h = c_h + K x_h, with an optional feedback matrix K. With A_h, B_h the Jacobians of a step,

    lambda_{H+1} = grad c_final,   mu_h = c_u + B_h^T lambda_{h+1},   lambda_h = c_x + A_h^T lambda_{h+1} + K^T mu_h,

    dV/dx_1 = lambda_1,   dV/dc_h = mu_h,   dV/dK = sum_h mu_h x_h^T.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from mjx_study.reference.system import System


@dataclasses.dataclass(frozen=True)
class Rollout:
    """A simulated batch.

    Attributes:
        controls: controls as applied, feedback included.
        costs: running costs, followed by the final cost.
    """

    states: Float[np.ndarray, "*batch steps states"]
    controls: Float[np.ndarray, "*batch horizon controls"]
    value: Float[np.ndarray, "*batch"]
    costs: Float[np.ndarray, "*batch steps"]

    @property
    def value_to_go(self) -> Float[np.ndarray, "*batch horizon"]:
        return np.cumsum(self.costs[..., ::-1], axis=-1)[..., :0:-1]


@dataclasses.dataclass(frozen=True)
class Gradients:
    """Gradients of the total cost of each rollout in a batch.

    Attributes:
        start: gradient with respect to the initial state.
        controls: gradient with respect to the control sequence c.
        feedback: gradient with respect to the feedback matrix K; None if there is none.
    """

    start: Float[np.ndarray, "*batch states"]
    controls: Float[np.ndarray, "*batch horizon controls"]
    feedback: Float[np.ndarray, "*batch controls states"] | None


def roll_out(
    system: System,
    start: Float[np.ndarray, "... states"],
    controls: Float[np.ndarray, "... horizon controls"],
    feedback: Float[np.ndarray, "*batch _ _"] | None = None,
) -> Rollout:
    """Simulate u_h = controls_h + feedback x_h from `start`; the batch axes of start and controls are broadcast.

    There is one feedback matrix, or one for each rollout.

    Raises:
        ValueError: the initial state, controls or feedback matrix do not fit the system.
    """
    start, controls = np.asarray(start, float), np.asarray(controls, float)
    _check(system, start, controls, feedback)
    each = () if feedback is None else feedback.shape[:-2]
    batch, horizon = np.broadcast_shapes(start.shape[:-1], controls.shape[:-2], each), controls.shape[-2]
    state = np.broadcast_to(start, (*batch, system.num_states))
    states = np.empty((*batch, horizon + 1, system.num_states))
    applied = np.array(np.broadcast_to(controls, (*batch, *controls.shape[-2:])))
    states[..., 0, :] = state
    for step in range(horizon):
        if feedback is not None:
            applied[..., step, :] += np.einsum("...ux,...x->...u", feedback, state)
        state = system.step(state, applied[..., step, :])
        states[..., step + 1, :] = state
    costs = np.empty((*batch, horizon + 1))
    costs[..., :-1] = system.cost(states[..., :-1, :], applied)
    costs[..., horizon] = system.final_cost(state)
    return Rollout(states, applied, np.asarray(np.sum(costs, axis=-1)), costs)


def value_and_gradients(
    system: System,
    start: Float[np.ndarray, "... states"],
    controls: Float[np.ndarray, "... horizon controls"],
    feedback: Float[np.ndarray, "*batch _ _"] | None = None,
) -> tuple[Float[np.ndarray, "..."], Gradients]:
    """Total cost and its exact gradients with respect to initial state, control sequence and feedback matrix.

    Raises:
        ValueError: as for `roll_out`.
    """
    rollout = roll_out(system, start, controls, feedback)
    return rollout.value, gradients_along(system, rollout, feedback)


def gradients_along(
    system: System, rollout: Rollout, feedback: Float[np.ndarray, "*batch _ _"] | None = None
) -> Gradients:
    """Compute the exact gradients of a rollout's total cost."""
    adjoint = system.final_gradient(rollout.states[..., -1, :])
    cost_states, cost_controls = system.cost_gradients(rollout.states[..., :-1, :], rollout.controls)
    gradient = np.empty(rollout.controls.shape)
    for step in reversed(range(rollout.controls.shape[-2])):
        over_state, over_control = system.jacobians(rollout.states[..., step, :], rollout.controls[..., step, :])
        gradient[..., step, :] = cost_controls[..., step, :] + np.einsum("...ij,...i->...j", over_control, adjoint)
        adjoint = cost_states[..., step, :] + np.einsum("...ij,...i->...j", over_state, adjoint)
        if feedback is not None:
            adjoint = adjoint + np.einsum("...ux,...u->...x", feedback, gradient[..., step, :])
    over_feedback = None
    if feedback is not None:
        over_feedback = np.einsum("...hu,...hx->...ux", gradient, rollout.states[..., :-1, :])
    return Gradients(adjoint, gradient, over_feedback)


def value_and_gradient(
    system: System, start: Float[np.ndarray, "... states"], controls: Float[np.ndarray, "... horizon controls"]
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "... horizon controls"]]:
    """Total cost of an open loop and its exact gradient with respect to the controls.

    Raises:
        ValueError: as for `roll_out`.
    """
    value, gradients = value_and_gradients(system, start, controls)
    return value, gradients.controls


def _check(system: System, start: np.ndarray, controls: np.ndarray, feedback: np.ndarray | None) -> None:
    states, inputs = system.num_states, system.num_controls
    if start.shape[-1:] != (states,):
        raise ValueError(f"the start must end in an axis of {states} states, got shape {start.shape}")
    if controls.ndim < 2 or controls.shape[-1] != inputs:
        raise ValueError(f"controls must be (..., horizon, {inputs}), got shape {controls.shape}")
    if feedback is not None and feedback.shape[-2:] != (inputs, states):
        raise ValueError(f"the feedback matrix must be ({inputs}, {states}), got shape {feedback.shape}")
