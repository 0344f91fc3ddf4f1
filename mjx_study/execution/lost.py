"""Why a study has no finite number: the step and the quantity that is the first not to be finite."""

import jax
import mujoco
import numpy as np
import xarray as xr

from mjx_study.experiment.sampling import cell_keys, sample_keys
from mjx_study.experiment.study import StudyPlan
from mjx_study.objective.batches import compiled_rollout
from mjx_study.objective.cost import before_each_step, last_of
from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.dynamics import State
from mjx_study.tasks.task import Task


def all_lost(plan: StudyPlan, dataset: xr.Dataset) -> str | None:
    """Why a study has no number at all, from the first sample of its first cell; None if it has some."""
    kind = plan.kind
    if not dataset.data_vars or bool(np.isfinite(dataset[kind.finite]).any()):
        return None
    if "start_cost" in dataset and bool(dataset["start_cost"].notnull().any()):
        return "no final cost is finite, although that at the start is: use a lower --learning-rate"
    cell = plan.cells[0]
    task = plan.task_of(cell).replace(sigma=cell.sigma)
    if cell.model.analytic:
        return f"all samples are lost: no cost of {task.name} is finite"
    key = sample_keys(cell_keys(plan.config.seed, 1)["order"][0][0], 0, 1)[0]
    states, controls, *_ = compiled_rollout(task)(task.theta, cell.model.contact, key, 1.0)
    return f"all samples are lost: {plan.label(cell)}: {first_nonfinite(task, states, controls, cell.model.contact)}"


def first_nonfinite(task: Task, states: State, controls: jax.Array, contact: ContactModel | None = None) -> str:
    """Name the step, the joint or cost, and the quantity that is the first not to be finite in a rollout."""
    host, kinds = task.scene.host, mujoco.mjtObj
    joints_of_qpos = np.repeat(np.arange(host.njnt), np.diff([*host.jnt_qposadr, host.nq]))
    for step in range(task.horizon + 1):
        for quantity, owners in (("qvel", host.dof_jntid), ("qpos", joints_of_qpos), ("act", None)):
            wrong = np.flatnonzero(~np.isfinite(np.asarray(getattr(states, quantity)[step])))
            if not len(wrong):
                continue
            if owners is None:
                return f"{quantity}[{wrong[0]}] is not finite after step {step} of {task.horizon}"
            joint = int(owners[wrong[0]])
            body = mujoco.mj_id2name(host, kinds.mjOBJ_BODY, int(host.jnt_bodyid[joint])) or host.jnt_bodyid[joint]
            name = mujoco.mj_id2name(host, kinds.mjOBJ_JOINT, joint) or joint
            return f"{quantity} of joint {name} (body {body}) is not finite after step {step} of {task.horizon}"
    running_cost, final_cost = task.costs(contact)
    running = np.asarray(jax.vmap(running_cost)(before_each_step(states), controls))
    if len(wrong := np.flatnonzero(~np.isfinite(running))):
        return (
            f"the running_cost is {running[wrong[0]]} in step {wrong[0]} of {task.horizon}, where the state is finite"
        )
    if not np.isfinite(final := float(final_cost(last_of(states)))):
        return f"the final_cost is {final} after step {task.horizon}, where the state is finite"
    return "the costs are finite, their derivatives are not; mjx-study gradcheck finds the step"
