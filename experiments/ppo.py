"""Proximal policy optimisation of a task by stable-baselines3: what people would do instead of `experiments.learning`.

It has the same starts, initial noise, networks, costs and number of steps, and learns a value function beside.
"""

# pyright: reportMissingImports=false

import math
import time
from collections.abc import Sequence
from typing import Any, Final

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import torch
from jaxtyping import Array, Float
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

import mjx_study
from mjx_study.simulation.dynamics import step
from mjx_study.tasks.network import Network
from mjx_study.tasks.task import Task

ENVIRONMENTS: Final = 1024
STEPS: Final = 32  # steps of every environment between updates
MOST_ACTION: Final = 10.0  # bound that the library needs on the network's outputs, ten times those met


class Environments(VecEnv):
    """Rollouts of a task side by side on one device, all in the same step; the reward is minus the cost.

    Actions are what the task's network returns, in place of it.
    """

    def __init__(self, task: Task, seed: int):
        self.task, self._key = task, jax.random.key(seed)
        self.began, self.costs = 0.0, list[tuple[float, float]]()
        policy: Any = task.policy
        box = lambda size, most: gymnasium.spaces.Box(-most, most, (size,), np.float32)  # noqa: E731
        super().__init__(ENVIRONMENTS, box(policy.num_features, math.inf), box(policy.controls, MOST_ACTION))
        running_cost, final_cost = task.costs()

        def control_of(action: Array, state: mjx_study.State) -> Array:
            at_rest = policy.feedback(jnp.zeros(policy.num_params), state)
            return at_rest + getattr(policy, "scale", 1.0) * action

        def advance(state: mjx_study.State, action: Float[Array, " nu"]):
            control = control_of(action, state)
            following = step(task.scene, task.scene.model, state, control)[0]
            return following, -running_cost(state, control), policy.features(following), -final_cost(following)

        def begin(key):
            start = task.draw_start(key)
            return start, policy.features(start)

        self._advance, self._begin = jax.jit(jax.vmap(advance)), jax.jit(jax.vmap(begin))

    def reset(self):
        self._key, drawn = jax.random.split(self._key)
        self._state, seen = self._begin(jax.random.split(drawn, self.num_envs))
        self._elapsed, self._total = 0, 0.0
        return np.asarray(seen, np.float32)

    def step_async(self, actions):
        self._actions = actions

    def step_wait(self):
        self._state, reward, seen, final = self._advance(self._state, jnp.asarray(self._actions, float))
        reward, seen, final = (np.asarray(each, np.float32) for each in (reward, seen, final))
        self._elapsed += 1
        over = self._elapsed == self.task.horizon
        self._total -= float(np.mean(reward + final if over else reward))
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if over:
            self.costs.append((time.perf_counter() - self.began, self._total))
            reward = reward + final
            infos = [{"terminal_observation": each, "TimeLimit.truncated": True} for each in seen]
            seen = self.reset()
        return seen, reward, np.full(self.num_envs, over), infos

    def close(self):
        pass

    def get_attr(self, attr_name, indices=None):
        return [getattr(self, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name, value, indices=None):
        raise NotImplementedError

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs


def theta_of(model: PPO, network: Network) -> Float[np.ndarray, " params"]:
    """The mean of a trained policy as parameters of the task's network."""
    policy: Any = model.policy
    layers = [
        *(each for each in policy.mlp_extractor.policy_net if isinstance(each, torch.nn.Linear)),
        policy.action_net,
    ]
    parts = [part.detach().cpu().numpy() for layer in layers for part in (layer.weight.T, layer.bias)]
    assert [layer.weight.shape[::-1] for layer in layers] == network.shapes
    return np.concatenate([part.reshape(-1) for part in parts]).astype(float)


def train(task: Task, rate: float, seed: int, total: int) -> tuple[np.ndarray, Sequence[float], Sequence[float], float]:
    """Train with a learning rate on a number of steps.

    Returns:
        theta; the mean cost of each round of rollouts, with noise; its end in seconds; and those before the first.
    """
    torch.set_num_threads(2)
    began = time.perf_counter()
    network: Any = task.policy
    environments = Environments(task, seed)
    environments.reset()
    environments.step_async(np.zeros((ENVIRONMENTS, network.controls)))
    environments.step_wait()
    model = PPO(
        "MlpPolicy",
        environments,
        learning_rate=rate,
        n_steps=STEPS,
        batch_size=4096,
        n_epochs=5,
        gae_lambda=0.95,
        gamma=0.99,
        policy_kwargs={
            "net_arch": {"pi": list(network.hidden), "vf": [64, 64]},
            "activation_fn": torch.nn.Tanh,
            "log_std_init": math.log(task.sigma / getattr(network, "scale", 1.0)),
        },
        seed=seed,
        device="cpu",
    )
    built = time.perf_counter() - began
    environments.costs.clear()
    environments.began = time.perf_counter()
    model.learn(total)
    seconds, costs = zip(*environments.costs, strict=True)
    return theta_of(model, network), costs, seconds, built
