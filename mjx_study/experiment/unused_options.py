"""Reject options of a study that were given and that nothing in it reads."""

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Final

from estimators import ESTIMATORS, ORACLES, Estimator, find_estimator
from mjx_study.choices import REFERENCE, takes_stiffness
from mjx_study.options.configuration import SCENE_OPTIONS, StudyConfig
from mjx_study.options.estimator_options import ESTIMATOR_OPTIONS
from mjx_study.options.rules import reject_unused
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Task

CORRECTED: Final = "corrected"
"""Oracle with an onset term, linear unless `onset` asks for another."""
FIRST_ORDER: Final = (
    "has no effect: it changes first-order gradients through simulated contact, and there are none here"
)


def reject_unread(chosen: Sequence[str | Estimator], given: Iterable[str]) -> None:
    """Raise OptionError for an estimators' option that none of the chosen ones reads; objects read none."""
    found = [find_estimator(each) for each in chosen]
    read = {name for each in found if isinstance(each, type) for name in _fields(each)}
    names = ", ".join(each.name for each in found)
    for option in given:
        name = "gamma" if option == "published" else option
        able = ", ".join(each for each in ESTIMATORS if name in _fields(ESTIMATORS[each]))
        reason = f"has no effect on {names}: omit it, or choose an estimator that it acts on: {able}"
        reject_unused([option], ([option], name in read, reason))


def reads_onset(chosen: Iterable[str | Estimator], onset: str = "jump") -> bool:
    """Whether an onset term changes any of the estimators; those named for it have the linear one anyway."""
    needed = {oracle for each in map(find_estimator, chosen) for oracle in each.needs if ORACLES[oracle].order}
    return bool(needed - {CORRECTED} if onset == "linear" else needed)


def reject_unused_options(
    config: StudyConfig,
    given: Sequence[str],
    grids: Sequence[tuple[Task, Sequence[ContactPoint]]],
    *,
    first_order: bool = False,
) -> None:
    """Raise OptionError for an option that was given and has no effect in any cell, and ValueError for an onset
    estimator without one; `first_order` says whether cells have means of first-order gradients with any estimators."""
    reject_unread(config.estimators, [name for name in (*ESTIMATOR_OPTIONS, "published") if name in given])
    simulated = [task for task, models in grids if not all(each.analytic for each in models)]
    touching = any(task.scene.has_constraints for task in simulated)
    families = {
        family
        for task, _ in grids
        for family in (task.defaults.families if config.contact is None else config.contact)
        if family != REFERENCE or task.contact_pair is not None
    }
    rigid = "has no effect: no contact model takes one; add a family that does, such as mujoco"
    if not any(task.contact_pair for task, _ in grids):
        lacking = "names no contact whose stiffness could be set (docs/extending.md: contact_pair)"
        rigid = f"has no effect: {grids[0][0].name} {lacking}"
    surrogates = set(config.backward) - {"none"}
    reject_unused(
        given,
        (["stiffness"], takes_stiffness(families), rigid),
        (["damping"], takes_stiffness(families - {REFERENCE}), rigid),
        (["cone"], touching, "has no effect: nothing that is simulated has contact"),
        (
            ["onset"],
            touching and (first_order or reads_onset(config.estimators, config.onset)),
            f"{FIRST_ORDER} (estimators named _onset have the linear term anyway)",
        ),
        (["backward"], touching and (first_order or reads_onset(config.estimators)), FIRST_ORDER),
        (["backward_stiffness"], takes_stiffness(surrogates), "has no effect: no surrogate family takes one"),
        (SCENE_OPTIONS, bool(simulated), "has no effect: nothing is simulated"),
    )
    for each in map(find_estimator, config.estimators):
        if CORRECTED in each.needs and not simulated:
            raise ValueError(
                f"{each.name} corrects gradients through simulated contact, and nothing is simulated: omit it"
            )


def _fields(estimator: type[Estimator]) -> set[str]:
    return {field.name for field in dataclasses.fields(estimator)}
