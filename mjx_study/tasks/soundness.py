"""Whether a task can be studied at all: parameters to differentiate by, and a finite cost to differentiate."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

from mjx_study.simulation.dynamics import State
from mjx_study.simulation.engine import HostState, engine_model, host_data, quiet_engine
from mjx_study.tasks.task import Task


def check_soundness(task: Task) -> None:
    """Refuse a task without parameters, or whose cost is not finite at theta without noise.

    The C engine rolls it out with the MJCF's contact, so nothing but the cost and the policy is compiled. Steps from
    which a state is not finite are no evidence against the cost, and are left to the study.

    Raises:
        ValueError: theta has no entries, the initial state or theta is not finite, or a cost of finite states is not.
    """
    if task.theta.size == 0:
        why = "the MJCF has no actuators" if task.scene.host.nu == 0 else "the policy has no parameters"
        raise ValueError(f"{task.name}: theta has no entries ({why}), so there is no gradient to study")
    if not np.all(np.isfinite(task.theta)):
        raise ValueError(f"{task.name}: theta is not finite")
    states, controls = _rollout(task)
    if not all(np.all(np.isfinite(leaf[0])) for leaf in (states.qpos, states.qvel, states.act)):
        raise ValueError(f"{task.name}: the initial state is not finite")
    steps = len(controls)
    running_cost, final_cost = task.costs()
    running, final = jax.jit(
        lambda states, controls: (
            jax.vmap(running_cost)(jax.tree.map(lambda leaf: leaf[:-1], states), controls),
            final_cost(jax.tree.map(lambda leaf: leaf[-1], states)),
        )
    )(states, controls)
    wrong = np.flatnonzero(~np.isfinite(np.asarray(running)))
    if len(wrong):
        raise ValueError(
            f"{task.name}: the running_cost is {float(running[wrong[0]])} at theta without noise, in step "
            f"{wrong[0]} of {task.horizon}, where state and control are finite"
        )
    if steps == task.horizon and not np.isfinite(final):
        raise ValueError(
            f"{task.name}: the final_cost is {float(final)} at theta without noise, where the state is finite"
        )


def _rollout(task: Task) -> tuple[State, Float[np.ndarray, "steps nu"]]:
    """Finite states of a rollout without noise, the initial one included, and the controls between them."""
    dtype = task.scene.template.qpos.dtype
    noise = jnp.zeros(task.policy.noise_shape, dtype)
    state = task.policy.place(task.theta, noise, task.draw_start(jax.random.key(0)))
    feedforward = np.asarray(task.policy.feedforward(task.theta, noise), float)
    feedback = jax.jit(lambda state: task.policy.feedback(task.theta, state))
    host = engine_model(task.scene, None)
    host.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    qpos, qvel, act, warmstart = (np.asarray(leaf, float) for leaf in jax.tree.leaves(state))
    data = host_data(host, HostState(qpos, qvel, act, np.zeros(host.nu), warmstart))
    leaves, form = jax.tree.flatten(state)
    states, controls = [[np.asarray(leaf) for leaf in leaves]], []
    with quiet_engine():
        for control in feedforward:
            added = feedback(form.unflatten(states[-1]))
            control = control if added is None else control + np.asarray(added, float)
            data.ctrl[:] = control
            mujoco.mj_step(host, data)
            found = data.qpos, data.qvel, data.act, data.qacc_warmstart
            if not all(np.all(np.isfinite(leaf)) for leaf in (*found, control)):
                break
            states.append([np.array(leaf, dtype) for leaf in found])  # copies
            controls.append(control)
    stacked = form.unflatten([np.stack(column) for column in zip(*states, strict=True)])
    return stacked, np.asarray(controls, dtype).reshape(len(controls), host.nu)
