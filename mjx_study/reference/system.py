"""Interface of an analytic system: a step, a cost, and their hand-written derivatives."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float


@runtime_checkable
class System(Protocol):
    """x' = step(x, u) with cost c(x, u) per step and a final cost; leading axes are a batch."""

    @property
    def num_states(self) -> int:
        """Length of the state."""
        ...

    @property
    def num_controls(self) -> int:
        """Length of the control."""
        ...

    def step(
        self, state: Float[np.ndarray, "*batch states"], control: Float[np.ndarray, "*batch controls"]
    ) -> Float[np.ndarray, "*batch states"]:
        """The state after one timestep."""
        ...

    def jacobians(
        self, state: Float[np.ndarray, "*batch states"], control: Float[np.ndarray, "*batch controls"]
    ) -> tuple[Float[np.ndarray, "*batch states states"], Float[np.ndarray, "*batch states controls"]]:
        """Derivatives of `step` with respect to state and control."""
        ...

    def cost(
        self, state: Float[np.ndarray, "*batch states"], control: Float[np.ndarray, "*batch controls"]
    ) -> Float[np.ndarray, "*batch"]:
        """Running cost."""
        ...

    def cost_gradients(
        self, state: Float[np.ndarray, "*batch states"], control: Float[np.ndarray, "*batch controls"]
    ) -> tuple[Float[np.ndarray, "*batch states"], Float[np.ndarray, "*batch controls"]]:
        """Derivatives of `cost` with respect to state and control."""
        ...

    def final_cost(self, state: Float[np.ndarray, "*batch states"]) -> Float[np.ndarray, "*batch"]:
        """Cost of the final state."""
        ...

    def final_gradient(self, state: Float[np.ndarray, "*batch states"]) -> Float[np.ndarray, "*batch states"]:
        """Derivative of `final_cost`."""
        ...
