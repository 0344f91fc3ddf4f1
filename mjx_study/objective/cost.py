"""The cost of one rollout as a pure function, for tracing and differentiation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from estimators.noise import split_sample_key, standard_noise
from mjx_study.graph.random import normal
from mjx_study.simulation._mjx import mjx
from mjx_study.simulation.contact import ContactModel, apply_contact, has_mujoco_law
from mjx_study.simulation.dynamics import State, simulated, trajectory
from mjx_study.simulation.onset import corrected
from mjx_study.simulation.touch import OnsetCounts
from mjx_study.tasks.task import Task


def rollout_cost(
    task: Task,
    theta: Float[Array, " params"],
    contact: ContactModel | None,
    start: State,
    noise: Float[Array, "steps dimensions"],
    onset: str = "none",
    weight: float | Float[Array, ""] = 1.0,
) -> tuple[Float[Array, ""], tuple[State, Float[Array, "horizon nu"], Float[Array, ""], OnsetCounts | None]]:
    """Compute the total cost V_1 of one rollout; everything that may be traced or differentiated is an argument.

    Args:
        contact: None for the MJCF's own.
        start: the initial state, before the policy acts on it.
        onset: "none", or "linear" or "shift" for a derivative with the onset term (see `mjx_study.simulation.onset`).
        weight: factor of the onset term; 0 for a derivative without it.

    Returns:
        The cost; and the states `(horizon + 1, ...)` including the initial one, the controls, the largest relative
        solver residual, and the onset counts (None without the onset term).

    Raises:
        ValueError: the policy is for another number of steps or controls, or the onset term does not go with the
            contact.
    """
    feedforward, needed = task.policy.feedforward(theta, noise), (task.horizon, task.scene.host.nu)
    if feedforward.shape != needed:
        raise ValueError(
            f"{task.name}: the policy's feedforward has shape {feedforward.shape}; {needed[0]} steps and {needed[1]} "
            f"controls need {needed}"
        )

    def control_law(feedforward, state):
        feedback = task.policy.feedback(theta, state)
        return feedforward if feedback is None else feedforward + feedback

    model = apply_contact(task.scene.model, contact)
    backward = derivative_model(task, contact)
    if backward is not None and onset != "none":
        raise ValueError("the onset term requires exact derivatives: omit onset, or the contact's backward model")
    if onset != "none" and not has_mujoco_law(contact):
        raise ValueError("the onset term is that of MuJoCo's law: omit onset, or the contact's law")
    running_cost, final_cost = task.costs(contact)
    first = task.policy.place(theta, noise, start)
    moved, counts = (task.scene, model, first, control_law, feedforward, running_cost), None
    if onset == "none":
        last, found = simulated(*moved, backward)
    else:
        last, found, counts = corrected(*moved, onset, weight=weight)
    before, controls, residuals, costs = found
    cost = jnp.sum(costs) + final_cost(last)
    return cost, (trajectory(before, last), controls, jnp.max(residuals), counts)


def derivative_model(task: Task, contact: ContactModel | None) -> mjx.Model | None:
    """Return the model whose derivatives replace those of the contact model; None to keep its own."""
    other = None if contact is None else contact.backward
    return None if other is None else apply_contact(task.scene.model, other)


def simulate(
    task: Task,
    theta: Float[Array, " params"],
    contact: ContactModel | None,
    key: Key[Array, ""],
    noise_scale: float | Float[Array, ""],
) -> tuple[State, Float[Array, "horizon nu"], Float[Array, ""], Float[Array, ""]]:
    """Roll out one sample: states including the initial one, controls, cost and largest solver residual.

    Args:
        task: the task, with the noise's density and standard deviation.
        theta: policy parameters, (params,).
        contact: the contact model; None for the MJCF's own.
        key: key of the sample; draws the initial state and noise as in a batch.
        noise_scale: factor of the noise; 0 for a zero-noise rollout.
    """
    start, noise = drawn(task, key, task.sigma, noise_scale)
    cost, (states, controls, residual, _) = rollout_cost(task, theta, contact, start, noise)
    return states, controls, cost, residual


def drawn(
    task: Task, key: Key[Array, ""], sigma: float | Float[Array, ""], noise_scale: float | Float[Array, ""]
) -> tuple[State, Float[Array, "steps dimensions"]]:
    """Initial state and noise of a sample, from its key, the noise's standard deviation and a factor."""
    start_key, noise_key = split_sample_key(key)
    dtype = task.scene.template.qpos.dtype
    standard = standard_noise(noise_key, task.policy.noise_shape, dtype, task.noise, normal)
    return task.draw_start(start_key), noise_scale * sigma * standard


def before_each_step(states: State) -> State:
    return jax.tree.map(lambda leaf: leaf[:-1], states)


def last_of(states: State) -> State:
    return jax.tree.map(lambda leaf: leaf[-1], states)
