"""Refuse options that were given and that nothing in a study reads."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Final

from estimators import ESTIMATORS, ORACLES, Estimator, find_estimator
from mjx_study.choices import REFERENCE, takes_stiffness
from mjx_study.experiment.resolution import OF_ESTIMATORS
from mjx_study.options.configuration import StudyConfig
from mjx_study.options.option import SCENE_OPTIONS
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Task

CORRECTED: Final = "corrected"
"""Oracle with an onset term, linear unless `onset` asks for another."""


def reject_unread(chosen: Sequence[str | Estimator], given: Iterable[str]) -> None:
    """Raise ValueError for an option of estimators that none of the chosen ones reads; objects have options of their
    own."""
    found = [find_estimator(each) for each in chosen]
    read = {name for each in found if isinstance(each, type) for name in _fields(each)}
    for option in given:
        name = "gamma" if option == "published" else option
        if name not in read:
            names = ", ".join(each.name for each in found)
            able = ", ".join(each for each in ESTIMATORS if name in _fields(ESTIMATORS[each]))
            raise ValueError(f"`{option}` has no effect on {names}: omit it, or name one that it acts on: {able}")


def reads_onset(chosen: Iterable[str | Estimator], onset: str = "jump") -> bool:
    """Whether an onset term changes any of the estimators; those named for it have the linear one anyway."""
    needed = {oracle for each in map(find_estimator, chosen) for oracle in each.needs if ORACLES[oracle].order}
    return bool(needed - {CORRECTED} if onset == "linear" else needed)


def reject_unused(
    config: StudyConfig, grids: Sequence[tuple[Task, Sequence[ContactPoint]]], *, first_order: bool = False
) -> None:
    """Raise ValueError for what was given and has no effect in any cell: an option that differs from its default, or an
    onset estimator.

    Args:
        grids: tasks, each with its contact models.
        first_order: whether cells have means of first-order gradients whatever the estimators are.
    """
    reject_unread(config.estimators, [name for name in (*OF_ESTIMATORS, "published") if config.given(name)])
    simulated = [task for task, models in grids if not all(each.analytic for each in models)]
    touching = any(task.scene.has_constraints for task in simulated)
    families = [
        family
        for task, _ in grids
        for family in (task.defaults.families if config.contact is None else config.contact)
        if family != REFERENCE or task.contact_pair is not None
    ]
    chosen = any(config.stiffness == (task.defaults.middle_stiffness,) for task, _ in grids)  # by the command
    such = "no contact model takes one; add a family that does, such as mujoco"
    if not any(task.contact_pair for task, _ in grids):
        such = f"{grids[0][0].name} names no contact whose stiffness could be set (docs/extending.md: contact_pair)"
    needed = "it changes first-order gradients through simulated contact, and there are none here"
    corrected = f"{needed} (estimators named _onset have the linear term anyway)"
    for name, effective, reason in (
        ("stiffness", chosen or takes_stiffness(families), such),
        ("damping", takes_stiffness(set(families) - {REFERENCE}), such),
        ("cone", touching, "nothing that is simulated has contact"),
        ("onset", touching and (first_order or reads_onset(config.estimators, config.onset)), corrected),
        ("backward", touching and (first_order or reads_onset(config.estimators)), needed),
        ("backward_stiffness", takes_stiffness(set(config.backward) - {"none"}), "no family of `backward` takes one"),
        *((name, simulated, "nothing is simulated") for name in SCENE_OPTIONS),
    ):
        if config.given(name) and not effective:
            raise ValueError(f"`{name}` has no effect: {reason}")
    for each in map(find_estimator, config.estimators):
        if CORRECTED in each.needs and not simulated:
            raise ValueError(
                f"{each.name} corrects gradients through simulated contact, and nothing is simulated: omit it"
            )


def _fields(estimator: type[Estimator]) -> set[str]:
    return {field.name for field in dataclasses.fields(estimator)}
