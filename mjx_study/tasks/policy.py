"""Policies: map parameters, noise and state to an initial state and controls.

Noise w acts where exploration does: on each control, u_h = pi(x_h, theta) + w_h, or, for an initial-state policy, on
the parameters themselves, theta + w. Separating feedforward from feedback lets an open loop skip its trivial derivative
over the state.
"""

import dataclasses
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_study.simulation.dynamics import State

Theta = Float[Array, " params"]
Noise = Float[Array, "steps dimensions"]
Controls = Float[Array, "horizon nu"]
Control = Float[Array, " nu"]


@runtime_checkable
class Policy(Protocol):
    """A parametrised control law with its noise."""

    @property
    def num_params(self) -> int:
        """Length of theta."""
        ...

    @property
    def noise_shape(self) -> tuple[int, int]:
        """Number of steps with noise, and the noise dimension at each."""
        ...

    @property
    def additive(self) -> bool:
        """Whether the noise is added to theta entry by entry, so that the score is simply w / sigma^2."""
        ...

    @property
    def at_start(self) -> bool:
        """Whether theta and the noise act only on the initial state."""
        ...

    def place(self, theta: Theta, noise: Noise, start: State) -> State:
        """Return the initial state after theta and the noise have acted on it."""
        ...

    def feedforward(self, theta: Theta, noise: Noise) -> Controls:
        """State-independent part of the controls, noise included."""
        ...

    def feedback(self, theta: Theta, state: State) -> Control | None:
        """State-dependent part of the control; None if there is none."""
        ...

    def score(self, theta: Theta, states: State, noise_gradient: Noise) -> Theta:
        """sum_h D_theta u_h(x_h)^T noise_gradient_h, with the states held fixed; never touches the dynamics."""
        ...


@dataclasses.dataclass(frozen=True)
class NoisyControls:
    """Base of policies with noise on the controls, m of them in each of H steps."""

    horizon: int
    controls: int
    at_start: bool = dataclasses.field(default=False, init=False)

    @property
    def noise_shape(self) -> tuple[int, int]:
        return self.horizon, self.controls

    def place(self, theta: Theta, noise: Noise, start: State) -> State:
        return start


@dataclasses.dataclass(frozen=True)
class OpenLoop(NoisyControls):
    """Open-loop control sequence: theta is (horizon, controls), flattened; the noise is added to it entry by entry."""

    additive: bool = dataclasses.field(default=True, init=False)

    @property
    def num_params(self) -> int:
        return self.horizon * self.controls

    def feedforward(self, theta: Theta, noise: Noise) -> Controls:
        return theta.reshape(self.horizon, self.controls) + noise

    def feedback(self, theta: Theta, state: State) -> None:
        return None

    def score(self, theta: Theta, states: State, noise_gradient: Noise) -> Theta:
        return noise_gradient.reshape(-1)


@dataclasses.dataclass(frozen=True)
class Feedback(NoisyControls):
    """Base of feedback policies u_h = pi(phi(x_h), theta) + w_h with `num_features` features phi of the state."""

    num_features: int
    features: Callable[[State], Float[Array, " features"]]
    additive: bool = dataclasses.field(default=False, init=False)

    def feedforward(self, theta: Theta, noise: Noise) -> Controls:
        return noise


@dataclasses.dataclass(frozen=True)
class LinearFeedback(Feedback):
    """u_h = Theta phi(x_h) + w_h: theta is Theta (controls, features), flattened."""

    @property
    def num_params(self) -> int:
        return self.controls * self.num_features

    def feedback(self, theta: Theta, state: State) -> Control:
        return theta.reshape(self.controls, self.num_features) @ self.features(state)

    def score(self, theta: Theta, states: State, noise_gradient: Noise) -> Theta:
        """sum_h noise_gradient_h phi(x_h)^T."""

        def add(total: Float[Array, "controls features"], step: tuple[State, Control]):
            state, slope = step
            return total + slope[:, None] * self.features(state), None

        start = jnp.zeros((self.controls, self.num_features), theta.dtype)
        return jax.lax.scan(add, start, (states, noise_gradient))[0].reshape(-1)


@dataclasses.dataclass(frozen=True)
class InitialStatePolicy:
    """Policy that sets the initial state from theta + w, drawn once, and applies no controls.

    Attributes:
        num_params: length of theta and of the noise w.
        horizon, controls: numbers of steps H and of controls m, all zero.
        start_at: maps (start, theta + w) to the initial state of the simulation.
        unit: unit of theta; empty if unknown.
    """

    num_params: int
    horizon: int
    controls: int
    start_at: Callable[[State, Theta], State]
    unit: str = ""
    additive: bool = dataclasses.field(default=True, init=False)
    at_start: bool = dataclasses.field(default=True, init=False)

    @property
    def noise_shape(self) -> tuple[int, int]:
        return 1, self.num_params

    def place(self, theta: Theta, noise: Noise, start: State) -> State:
        return self.start_at(start, theta + noise[0])

    def feedforward(self, theta: Theta, noise: Noise) -> Controls:
        return jnp.zeros((self.horizon, self.controls), theta.dtype)

    def feedback(self, theta: Theta, state: State) -> None:
        return None

    def score(self, theta: Theta, states: State, noise_gradient: Noise) -> Theta:
        return noise_gradient[0]
