"""Neural-network policies for any task with controls."""

import dataclasses
from itertools import pairwise

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from mjx_study.limits import MOST_LAYERS, MOST_PARAMS, check_count
from mjx_study.simulation.dynamics import State
from mjx_study.tasks.policy import Control, Feedback, LinearFeedback, Noise, Theta
from mjx_study.tasks.task import Task


@dataclasses.dataclass(frozen=True)
class Network(Feedback):
    """u_h = net(phi(x_h)) + w_h with tanh layers and a linear output; theta is all weights and biases, flattened.

    Attributes:
        hidden: width of each hidden layer.
    """

    hidden: tuple[int, ...]

    def __post_init__(self) -> None:
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"a network needs hidden layers of at least 1 unit each, got {self.hidden}")

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """(inputs, outputs) of each layer."""
        return list(pairwise((self.num_features, *self.hidden, self.controls)))

    @property
    def num_params(self) -> int:
        return sum((inputs + 1) * outputs for inputs, outputs in self.shapes)

    def initial(self, key: Key[Array, ""], dtype) -> Theta:
        """Draw normal weights of variance 1 / inputs; biases and output layer are 0, so the initial control is zero."""
        parts = []
        for inputs, outputs in self.shapes:
            key, drawn = jax.random.split(key)
            scale = 0.0 if len(parts) == 2 * len(self.hidden) else inputs**-0.5
            weights = scale * jax.random.normal(drawn, (inputs, outputs), dtype)
            parts += [weights.reshape(-1), jnp.zeros(outputs, dtype)]
        return jnp.concatenate(parts)

    def feedback(self, theta: Theta, state: State) -> Control:
        signal, used = self.features(state), 0
        for index, (inputs, outputs) in enumerate(self.shapes):
            weights = theta[used : used + inputs * outputs].reshape(inputs, outputs)
            used += inputs * outputs
            signal = signal @ weights + theta[used : used + outputs]
            used += outputs
            signal = jnp.tanh(signal) if index < len(self.hidden) else signal
        return signal

    def score(self, theta: Theta, states: State, noise_gradient: Noise) -> Theta:
        """sum_h D_theta net(phi(x_h))^T noise_gradient_h, one backward pass through the network."""
        _, pull = jax.vjp(lambda at: jax.vmap(lambda state: self.feedback(at, state))(states), theta)
        return pull(noise_gradient)[0]


def with_network(task: Task, hidden: tuple[int, ...], key: Key[Array, ""]) -> Task:
    """Replace a task's policy with a network, its initial weights drawn with the key.

    Its input is that of the task's linear feedback, or else positions, velocities and activations. A ValueError if the
    task has an initial-state policy or no controls, or a layer has no units.
    """
    if task.policy.at_start or task.scene.host.nu == 0:
        raise ValueError(f"{task.name} has no control for a network to set: its policy chooses the initial state")
    host, dtype = task.scene.host, task.scene.template.qpos.dtype
    if isinstance(task.policy, LinearFeedback):
        size, features = task.policy.num_features, task.policy.features
    else:
        size = host.nq + host.nv + host.na
        features = lambda state: jnp.concatenate([state.qpos, state.qvel, state.act])  # noqa: E731
    check_count(len(hidden), "hidden layers", MOST_LAYERS, "give fewer")
    network = Network(task.horizon, host.nu, size, features, hidden)
    check_count(network.num_params, "parameters of a network", MOST_PARAMS, "give narrower layers")
    return task.replace(policy=network, theta=network.initial(key, dtype), reference=None)
