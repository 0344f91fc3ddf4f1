"""Check that the parts of a task fit together, with one-line errors."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from estimators.places import described
from mjx_study.tasks.task import Task


def check_shapes(task: Task, name: str = "") -> None:
    """Reject mismatches that broadcasting and clamped indices would hide; traces only, computes nothing.

    Args:
        name: prefix of messages; by default the task's name.

    Raises:
        ValueError: a part raises, or its shape or dtype is not what the simulation needs.
    """
    name = name or task.name
    policy, dtype = task.policy, task.scene.template.qpos.dtype
    steps, controls = task.horizon, task.scene.host.nu
    if jnp.asarray(task.theta).dtype != dtype:
        raise ValueError(f"{name}: theta is {task.theta.dtype}, and the simulation {dtype}")
    start = _traced(name, "start", lambda: task.draw_start(jax.random.key(0)))
    noise = jax.ShapeDtypeStruct(policy.noise_shape, dtype)
    control = jax.ShapeDtypeStruct((controls,), dtype)
    placed = _traced(name, "policy's place", policy.place, task.theta, noise, start)
    for leaf in ("qpos", "qvel", "act"):
        found, needed = getattr(placed, leaf).shape, getattr(task.scene.template, leaf).shape
        if found != needed:
            raise ValueError(f"{name}: {leaf} of the start has shape {found}; the scene needs {needed}")
    parts = {
        "policy's feedforward": (policy.feedforward, (task.theta, noise), (steps, controls)),
        "policy's feedback": (policy.feedback, (task.theta, start), (controls,)),
        "running_cost": (task.running_cost, (start, control), ()),
        "final_cost": (task.final_cost, (start,), ()),
    }
    for part, (function, arguments, needed) in parts.items():
        found = _traced(name, part, function, *arguments)
        if found is not None and found.shape != needed:
            fitting = f"; {steps} steps and {controls} controls need {needed}" if needed else ", and a cost is a scalar"
            raise ValueError(f"{name}: the {part} has shape {found.shape}{fitting}")


def _traced(name: str, part: str, function: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return jax.eval_shape(function, *arguments)
    except (Exception, SystemExit) as error:
        raise ValueError(f"{name}: the {part} raised {described(error)}") from error
