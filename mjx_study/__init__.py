"""Measure, with real contact physics, whether the gradients of a differentiable simulator are worth having.

A study of gradient estimators through MuJoCo MJX: scenes, contact models in physical units, a differentiable step,
tasks as objectives, and comparisons of estimators over them. Call `configure` first for float64 and all cores.
"""

from mjx_study import _matplotlib
from mjx_study.accessor import StudyAccessor
from mjx_study.objective import MjxObjective, Simulator, simulate
from mjx_study.plots.study import plot_study
from mjx_study.runtime import configure
from mjx_study.simulation.contact import (
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
from mjx_study.simulation.dynamics import State, initial_state, rollout, step, step_jacobian
from mjx_study.simulation.scene import Scene, SceneError, load_scene, put_scene
from mjx_study.study.configuration import StudyConfig
from mjx_study.study.plan import estimators_of, plan_study
from mjx_study.study.run import load_study, run_study
from mjx_study.tasks import TASKS, make_task
from mjx_study.tasks.policy import InitialStatePolicy, LinearFeedback, OpenLoop, Policy
from mjx_study.tasks.task import Recipe, StudyDefaults, Task

__all__ = [
    "_matplotlib",
    "ContactModel",
    "ContactWarning",
    "FAMILIES",
    "InitialStatePolicy",
    "LinearFeedback",
    "MjxObjective",
    "OpenLoop",
    "Policy",
    "Recipe",
    "Scene",
    "SceneError",
    "Simulator",
    "State",
    "StudyAccessor",
    "StudyConfig",
    "StudyDefaults",
    "TASKS",
    "Task",
    "apply_contact",
    "configure",
    "contact_model",
    "effective_mass",
    "estimators_of",
    "family_model",
    "initial_state",
    "load_scene",
    "load_study",
    "make_task",
    "plan_study",
    "plot_study",
    "put_scene",
    "rollout",
    "run_study",
    "simulate",
    "solref_from_stiffness",
    "step",
    "step_jacobian",
    "stiffness_from_solref",
]
