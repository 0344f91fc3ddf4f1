r"""Analytic systems, their rollouts, and the rollouts' gradients by one adjoint sweep.

The control is u_h = c_h + K x_h, with an optional feedback matrix K. With A_h, B_h the Jacobians of a step,

    lambda_{H+1} = grad c_final,   mu_h = c_u + B_h^T lambda_{h+1},   lambda_h = c_x + A_h^T lambda_{h+1} + K^T mu_h,

    dV/dx_1 = lambda_1,   dV/dc_h = mu_h,   dV/dK = sum_h mu_h x_h^T.
"""

import dataclasses
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

Costs = Float[np.ndarray, "*batch"]
States = Float[np.ndarray, "*batch states"]
Controls = Float[np.ndarray, "*batch controls"]
StateJacobians = Float[np.ndarray, "*batch states states"]
ControlJacobians = Float[np.ndarray, "*batch states controls"]

Start = Float[np.ndarray, "... states"]
OpenLoopControls = Float[np.ndarray, "... horizon controls"]
FeedbackMatrix = Float[np.ndarray, "*batch _ _"]


@runtime_checkable
class System(Protocol):
    """x' = step(x, u) with cost c(x, u) per step and a final cost, and their derivatives; leading axes are a batch."""

    @property
    def num_states(self) -> int: ...
    @property
    def num_controls(self) -> int: ...
    def step(self, state: States, control: Controls) -> States: ...
    def jacobians(self, state: States, control: Controls) -> tuple[StateJacobians, ControlJacobians]: ...
    def cost(self, state: States, control: Controls) -> Costs: ...
    def cost_gradients(self, state: States, control: Controls) -> tuple[States, Controls]: ...
    def final_cost(self, state: States) -> Costs: ...
    def final_gradient(self, state: States) -> States: ...


class QuadraticCost:
    """c(x, u) = e^T Q e + R |u|^2 with e = x - goal, and final cost e^T Q e.

    Attributes:
        goal: target state.
        state_weight: diagonal of Q.
        control_weight: R.
    """

    goal: tuple[float, ...]
    state_weight: tuple[float, ...]
    control_weight: float

    def cost(self, state: States, control: Controls) -> Costs:
        return np.asarray(self.final_cost(state) + self.control_weight * np.sum(control**2, axis=-1))

    def cost_gradients(self, state: States, control: Controls) -> tuple[States, Controls]:
        return self.final_gradient(state), 2 * self.control_weight * control

    def final_cost(self, state: States) -> Costs:
        return np.asarray(np.sum(np.array(self.state_weight) * (state - np.array(self.goal)) ** 2, axis=-1))

    def final_gradient(self, state: States) -> States:
        return 2 * np.array(self.state_weight) * (state - np.array(self.goal))


class FinalQuadraticCost(QuadraticCost):
    """c(x, u) = R |u|^2, and the final cost of `QuadraticCost`."""

    def cost(self, state: States, control: Controls) -> Costs:
        return np.asarray(self.control_weight * np.sum(control**2, axis=-1))

    def cost_gradients(self, state: States, control: Controls) -> tuple[States, Controls]:
        return np.zeros(state.shape), 2 * self.control_weight * control


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
    """Gradients of the total cost of each rollout over initial state, control sequence c, and feedback matrix K."""

    start: Float[np.ndarray, "*batch states"]
    controls: Float[np.ndarray, "*batch horizon controls"]
    feedback: Float[np.ndarray, "*batch controls states"] | None


def roll_out(
    system: System, start: Start, controls: OpenLoopControls, feedback: FeedbackMatrix | None = None
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
    system: System, start: Start, controls: OpenLoopControls, feedback: FeedbackMatrix | None = None
) -> tuple[Float[np.ndarray, "..."], Gradients]:
    """Total cost and its exact gradients; arguments and errors as for `roll_out`."""
    rollout = roll_out(system, start, controls, feedback)
    return rollout.value, gradients_along(system, rollout, feedback)


def gradients_along(system: System, rollout: Rollout, feedback: FeedbackMatrix | None = None) -> Gradients:
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


def _check(system: System, start: np.ndarray, controls: np.ndarray, feedback: np.ndarray | None) -> None:
    states, inputs = system.num_states, system.num_controls
    if start.shape[-1:] != (states,):
        raise ValueError(f"the start must end in an axis of {states} states, got shape {start.shape}")
    if controls.ndim < 2 or controls.shape[-1] != inputs:
        raise ValueError(f"controls must be (..., horizon, {inputs}), got shape {controls.shape}")
    if feedback is not None and feedback.shape[-2:] != (inputs, states):
        raise ValueError(f"the feedback matrix must be ({inputs}, {states}), got shape {feedback.shape}")
