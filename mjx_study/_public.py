"""Public names of `mjx_study`, imported when one of them is first accessed."""

import mjx_study._matplotlib  # noqa: F401
from mjx_study.choices import FAMILIES
from mjx_study.execution.run import run_study
from mjx_study.experiment.plan import plan_study
from mjx_study.experiment.study import estimators_of
from mjx_study.objective import MjxObjective, Simulator, simulate
from mjx_study.options.configuration import StudyConfig
from mjx_study.plots.study import plot_study
from mjx_study.report import StudyAccessor
from mjx_study.runtime import configure
from mjx_study.simulation.contact import (
    ContactModel,
    ContactWarning,
    apply_contact,
    contact_model,
    effective_mass,
    family_model,
    solref_from_stiffness,
    stiffness_from_solref,
)
from mjx_study.simulation.drop_in import differentiable_mjx, solver_residual, step
from mjx_study.simulation.dynamics import State, initial_state, rollout, step_jacobian
from mjx_study.simulation.dynamics import step as scene_step
from mjx_study.simulation.observation import ObservedState, observed
from mjx_study.simulation.scene import Scene, SceneError, check_model, load_scene, put_scene
from mjx_study.storage.folder import load_study
from mjx_study.tasks import TASKS, make_task
from mjx_study.tasks.network import Network
from mjx_study.tasks.policy import InitialStatePolicy, LinearFeedback, OpenLoop, Policy
from mjx_study.tasks.task import Recipe, StudyDefaults, Task

__all__ = [
    "ContactModel", "ContactWarning", "FAMILIES", "InitialStatePolicy", "LinearFeedback", "MjxObjective", "Network",
    "ObservedState", "OpenLoop", "Policy", "Recipe", "Scene", "SceneError", "Simulator", "State", "StudyAccessor",
    "StudyConfig", "StudyDefaults", "TASKS", "Task", "apply_contact", "check_model", "configure", "contact_model",
    "differentiable_mjx", "effective_mass", "estimators_of", "family_model", "initial_state", "load_scene",
    "load_study", "make_task", "observed", "plan_study", "plot_study", "put_scene", "rollout", "run_study",
    "scene_step", "simulate", "solref_from_stiffness", "solver_residual", "step", "step_jacobian",
    "stiffness_from_solref",
]  # fmt: skip
