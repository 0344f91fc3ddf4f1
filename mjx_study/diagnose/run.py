"""Run all measurements of a diagnosis, in order."""

import dataclasses
from typing import Final

from mjx_study.choices import is_file, takes_stiffness
from mjx_study.diagnose.measurement import SAMPLES, chunk_of, estimators_of, measure
from mjx_study.diagnose.result import Diagnosis
from mjx_study.diagnose.setting import setting_of, touches_of
from mjx_study.experiment.memory import check_memory
from mjx_study.gradcheck import gradcheck, plan_gradcheck, plan_scene_gradcheck
from mjx_study.objective import Simulator
from mjx_study.options.option import OptionError
from mjx_study.progress import Progress, silent
from mjx_study.simulation.contact import has_mujoco_law
from mjx_study.tasks.contact_grid import single_contact
from mjx_study.tasks.soundness import check_soundness
from mjx_study.tasks.task import Task

STATES: Final = 2
"""Number of states in the gradient check."""
PARTS: Final = ("rollout without noise", "derivatives of steps", "estimators")
"""Names of the parts in progress."""


def diagnose_task(
    subject: str,
    task: Task,
    family: str | None = None,
    stiffness: float | None = None,
    *,
    damping: float | None = None,
    samples: int | None = None,
    seed: int = 0,
    options: str = "",
    progress: Progress = silent,
) -> Diagnosis:
    """Measure everything under one contact model.

    Args:
        subject: the model as named by the user; for a file, the gradient check covers single steps only.
        family: contact family; None for the task's main one.
        stiffness: contact stiffness [N/m]; None for the task's middle one.
        damping: contact damping [N s/m]; None for the family's.
        samples: samples per batch, and per node of the paths along which means are checked; None for `SAMPLES`, or as
            many as fit into `BUDGET_SECONDS`.
        options: contact options as command-line flags.
        progress: called before each part.

    Raises:
        ValueError: there is no such contact model, or the batches do not fit in memory.
    """
    check_soundness(task)
    cell, warnings = single_contact(task, family, stiffness, damping)
    if not has_mujoco_law(cell.contact):
        what = f"describes contacts in the terms of MuJoCo's law, which {cell.family} does not have"
        raise OptionError("contact", f"{what}: take compare and gradcheck")
    check_memory(task, estimators_of(task), samples or SAMPLES)
    progress(0, 4, PARTS[0])
    touches = tuple(touches_of(task, cell))
    common = {"seed": seed, "damping": damping, "states": STATES}
    if is_file(subject):
        plan = plan_scene_gradcheck(task.scene, [cell.family], None, horizon=task.horizon, **common)
    else:
        stiffnesses = [cell.stiffness_or_zero] if takes_stiffness([cell.family]) else None
        plan = plan_gradcheck(task, [cell.family], stiffnesses, **common)
    plan = dataclasses.replace(plan, parameters=False)  # on which no gradient over theta depends

    def part(at: int) -> Progress:
        return lambda done, total, what: progress(at, 4, f"{PARTS[at]}: {what}") if what != "done" else None

    derivatives = gradcheck(plan, part(1))
    simulator = Simulator(task, chunk_size=chunk_of(task, samples or SAMPLES))
    found = measure(simulator, cell.contact, samples, seed, part(2))
    progress(4, 4, "done")
    return Diagnosis(
        **vars(found),
        subject=subject,
        task=task,
        setting=setting_of(subject, task),
        contact=cell.label,
        touches=touches,
        derivatives=derivatives,
        warnings=tuple(warnings),
        options=options,
    )
