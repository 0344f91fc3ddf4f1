"""Measure, with real contact physics, whether the gradients of a differentiable simulator are worth having.

A study of gradient estimators through MuJoCo MJX: scenes, contact models in physical units, a differentiable step,
tasks as objectives, and comparisons of estimators over them. Call `configure` first for float64 and all cores.
"""

from mjx_study.comparison import CompareConfig, CompareResult
from mjx_study.contact import (
    FAMILIES,
    ContactModel,
    ContactWarning,
    apply_contact,
    contact_model,
    effective_mass,
    family_model,
    solref_from_stiffness,
    stiffness_from_solref,
)
from mjx_study.dynamics import State, initial_state, rollout, step, step_jacobian
from mjx_study.objective import MjxObjective, Simulator, simulate
from mjx_study.policy import Launch, LinearFeedback, OpenLoop, Policy
from mjx_study.runtime import configure
from mjx_study.scene import Scene, SceneError, load_scene, put_scene
from mjx_study.study import compare, plan_compare
from mjx_study.task import Task
from mjx_study.tasks import TASKS, make_task

__all__ = [
    "FAMILIES",
    "TASKS",
    "CompareConfig",
    "CompareResult",
    "ContactModel",
    "ContactWarning",
    "MjxObjective",
    "Launch",
    "LinearFeedback",
    "OpenLoop",
    "Policy",
    "Scene",
    "SceneError",
    "Simulator",
    "State",
    "Task",
    "apply_contact",
    "compare",
    "configure",
    "contact_model",
    "effective_mass",
    "family_model",
    "initial_state",
    "load_scene",
    "make_task",
    "plan_compare",
    "put_scene",
    "rollout",
    "simulate",
    "solref_from_stiffness",
    "step",
    "step_jacobian",
    "stiffness_from_solref",
]
