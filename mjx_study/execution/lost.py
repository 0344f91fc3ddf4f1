"""Samples that a study lost because they are not finite: where, and from which step on."""

from typing import Final

import jax
import mujoco
import numpy as np
import xarray as xr

from estimators.registry import label_of
from mjx_study.experiment.plan import StudyPlan
from mjx_study.experiment.sampling import cell_keys, sample_keys
from mjx_study.objective.batches import compiled_rollout
from mjx_study.objective.cost import before_each_step, last_of
from mjx_study.results.findings import onset_of
from mjx_study.simulation.dynamics import State
from mjx_study.tasks.task import Task

MOST_NAMED: Final = 3
"""Maximum number of contact models that a warning names."""
EXPLODED: Final = 1e30
"""Size of a gradient, variance or cost that no stable step reaches."""
SIZES: Final = ("gradient_norm", "variance", "cost", "final_cost")


def lost_samples(dataset: xr.Dataset) -> list[str]:
    """Warnings about samples left out, by contact model and estimator, and about contact models whose step explodes."""
    counts, messages = dataset.get("nonfinite"), []
    if counts is not None and (by_model := _per_model(counts, "sum")).max() > 0:
        estimators = counts.sum([name for name in counts.dims if name not in ("model", "estimator")])
        labels = [label_of(name, onset_of(dataset)) for name in dataset["estimator"].values.tolist()]
        told = []
        for index in np.argsort(-by_model, kind="stable")[: min(MOST_NAMED, np.count_nonzero(by_model))].tolist():
            each = estimators.isel(model=index).values.astype(int).tolist()
            shares = ", ".join(f"{label} {count}" for label, count in zip(labels, each, strict=True) if count)
            told.append(f"{_name(dataset, index)} ({shares})")
        more = np.count_nonzero(by_model) - len(told)
        told += [f"{more} more contact models"] if more else []
        messages.append(f"{total(counts)} samples overflowed or became NaN and were left out: {'; '.join(told)}")
    largest = np.max([_per_model(dataset[name], "max") for name in SIZES if name in dataset], axis=0, initial=0.0)
    for index in np.flatnonzero(largest > EXPLODED)[:MOST_NAMED].tolist():
        messages.append(
            f"{_name(dataset, index)}: the motion explodes (numbers up to {largest[index]:.0e}), as where the step in "
            "contact is unstable; use a smaller --timestep, or softer contact"
        )
    return messages


def all_lost(plan: StudyPlan, dataset: xr.Dataset) -> str | None:
    """Why a study has no number at all, from the first sample of its first cell; None if it has some."""
    kind = plan.settings.kind
    known = dataset["nonfinite" if kind == "gradients" else "final_cost" if kind == "descents" else "cost"]
    left = known < dataset["samples"] if kind == "gradients" else np.isfinite(known)
    if bool(left.any()) or not bool(dataset["residual"].notnull().any()):
        return None
    cell = plan.cells[0]
    task = plan.groups[cell.group].task.replace(sigma=cell.sigma)
    if cell.model.analytic:
        return f"all samples are lost: no cost of {task.name} is finite"
    key = sample_keys(cell_keys(plan.config.seed, 1)["order"][0][0], 0, 1)[0]
    states, controls, *_ = compiled_rollout(task)(task.theta, cell.model.contact, key, 1.0)
    return f"all samples are lost: {plan.label(cell)}: {first_nonfinite(task, states, controls)}"


def first_nonfinite(task: Task, states: State, controls: jax.Array) -> str:
    """Name the step, the joint or cost, and the quantity that is the first not to be finite in a rollout."""
    host, kinds = task.scene.host, mujoco.mjtObj
    for step in range(task.horizon + 1):
        for quantity, owners in (("qvel", host.dof_jntid), ("qpos", _joints_of_positions(host)), ("act", None)):
            wrong = np.flatnonzero(~np.isfinite(np.asarray(getattr(states, quantity)[step])))
            if not len(wrong):
                continue
            if owners is None:
                return f"{quantity}[{wrong[0]}] is not finite after step {step} of {task.horizon}"
            joint = int(owners[wrong[0]])
            body = mujoco.mj_id2name(host, kinds.mjOBJ_BODY, int(host.jnt_bodyid[joint])) or host.jnt_bodyid[joint]
            name = mujoco.mj_id2name(host, kinds.mjOBJ_JOINT, joint) or joint
            return f"{quantity} of joint {name} (body {body}) is not finite after step {step} of {task.horizon}"
    running = np.asarray(jax.vmap(task.running_cost)(before_each_step(states), controls))
    if len(wrong := np.flatnonzero(~np.isfinite(running))):
        return (
            f"the running_cost is {running[wrong[0]]} in step {wrong[0]} of {task.horizon}, where the state is finite"
        )
    if not np.isfinite(final := float(task.final_cost(last_of(states)))):
        return f"the final_cost is {final} after step {task.horizon}, where the state is finite"
    return "the costs are finite, their derivatives are not; mjx-study gradcheck finds the step"


def _joints_of_positions(host: mujoco.MjModel) -> np.ndarray:
    """Joint of each entry of qpos."""
    return np.repeat(np.arange(host.njnt), np.diff([*host.jnt_qposadr, host.nq]))


def total(counts: xr.DataArray) -> int:
    """Total count; where estimators share rollouts, the largest over estimators."""
    shared = "estimator" in counts.dims and not {"seed", "point"} & set(counts.dims)
    return int(counts.max("estimator").sum() if shared else counts.sum())


def _per_model(values: xr.DataArray, how: str) -> np.ndarray:
    """Sum or maximum of finite values for each contact model."""
    finite = values.where(np.isfinite(values))
    return getattr(finite, how)([name for name in values.dims if name != "model"]).fillna(0).values


def _name(dataset: xr.Dataset, index: int) -> str:
    stiffness = float(dataset["stiffness"][index])
    return f"{dataset['contact'].values[index]}" + (f", K = {stiffness:g} N/m" if stiffness > 0 else "")
