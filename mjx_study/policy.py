"""Policies: how parameters and state become a control.

    u_h = feedforward_h(theta) + feedback(theta, x_h) + w_h

Keeping the two parts apart lets an open loop skip its trivial derivative with respect to the state.
"""

import dataclasses
from typing import Protocol, runtime_checkable

from jaxtyping import Array, Float

from mjx_study.dynamics import State


@runtime_checkable
class Policy(Protocol):
    """A parametrised control law without its noise."""

    @property
    def num_params(self) -> int:
        """Length of theta."""
        ...

    def feedforward(self, theta: Float[Array, " params"]) -> Float[Array, "horizon nu"]:
        """The part of the control that depends on time alone."""
        ...

    def feedback(self, theta: Float[Array, " params"], state: State) -> Float[Array, " nu"] | None:
        """The part that depends on the state; None for an open loop."""
        ...

    def score(
        self, theta: Float[Array, " params"], states: State, noise_gradient: Float[Array, "horizon nu"]
    ) -> Float[Array, " params"]:
        """sum_h D_theta u_h(x_h)^T noise_gradient_h, with the states held fixed; never touches the dynamics."""
        ...


@dataclasses.dataclass(frozen=True)
class OpenLoop:
    """The control sequence itself: theta is (horizon, controls), flattened.

    Attributes:
        horizon: number of steps H.
        controls: number of controls m; theta has H m entries.
    """

    horizon: int
    controls: int

    @property
    def num_params(self) -> int:
        """H m."""
        return self.horizon * self.controls

    def feedforward(self, theta: Float[Array, " params"]) -> Float[Array, "horizon nu"]:
        """theta, reshaped."""
        return theta.reshape(self.horizon, self.controls)

    def feedback(self, theta: Float[Array, " params"], state: State) -> None:
        """None: an open loop does not look at the state."""
        return None

    def score(
        self, theta: Float[Array, " params"], states: State, noise_gradient: Float[Array, "horizon nu"]
    ) -> Float[Array, " params"]:
        """The noise gradient itself: D_theta u is the identity."""
        return noise_gradient.reshape(-1)
