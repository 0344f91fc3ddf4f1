"""Plan a study: check its configuration and resolve it into cells, computing nothing."""

import dataclasses
import itertools
import math
from collections.abc import Mapping
from typing import Final

import jax

from estimators.interpolation import check_weights
from estimators.noise import check_sigma
from mjx_study.choices import CONES, REFERENCE
from mjx_study.experiment.memory import LARGEST_BATCH
from mjx_study.experiment.resolution import at_theta, reject_unused_options
from mjx_study.experiment.study import Group, StudyCell, StudyKind, StudyPlan, check_numbers, estimators_of
from mjx_study.graph.native import in_numpy
from mjx_study.limits import MOST_CELLS, MOST_PROGRAMS, check_count
from mjx_study.objective import chunk_for, natively
from mjx_study.options.configuration import BUILDER_OPTIONS, OPTIONS, SAMPLES, NamedTask, StudyConfig
from mjx_study.options.option import OptionError
from mjx_study.results.kind import find_kind
from mjx_study.runtime import local_devices
from mjx_study.simulation.contact import has_mujoco_law
from mjx_study.table import count
from mjx_study.tasks import TASKS, task_with_options
from mjx_study.tasks.contact_grid import Grid, backward_grid, family_grid, single_defaults, solver_grid
from mjx_study.tasks.network import with_network
from mjx_study.tasks.soundness import check_soundness
from mjx_study.tasks.task import Task, check_shapes

LONG_IN_NUMPY: Final = 10_000_000  # steps, a minute or so, from which a study says that NumPy computes them


def plan_study(config: StudyConfig, built: Mapping[str, Task] | None = None, *, single: bool = False) -> StudyPlan:
    """Check a configuration and resolve its defaults, computing nothing.

    Args:
        config: what to study; fields that are None take their defaults.
        built: tasks already built by the caller, by name, with the configuration's `BUILDER_OPTIONS` and the MJCF's
            timestep and cone.
        single: whether the contact families and stiffnesses that the configuration leaves open are those of a single
            run (`mjx_study.tasks.contact_grid.single_defaults`), and not all of the task's.

    Raises:
        ValueError: the configuration cannot be run; the message says what is accepted.
    """
    built, given = dict(built or {}), [name for name in OPTIONS if config.given(name)]
    if single:
        config = _as_single(config, built)
    kind: StudyKind = find_kind(config.settings.kind)
    variants = config.tasks, config.timestep or (None,), config.cone or (None,)
    programs = math.prod(map(len, variants))
    check_count(programs, "programs", MOST_PROGRAMS, "give fewer tasks, timesteps or cones")
    groups: list[Group] = []
    cells: list[StudyCell] = []
    messages: list[str] = []
    sound: list[object] = []
    for which, timestep, cone in itertools.product(*variants):
        task = _build(config, which, timestep, cone, built)
        if config.network is not None:
            if REFERENCE in (config.contact or ()):
                raise OptionError("network", "needs MJX: the analytic references use the policy of the task")
            task = with_network(task, config.network, jax.random.key(config.seed))
        task = at_theta(task, config.theta)
        if which not in sound and not (which in TASKS and config.theta is config.model is None):
            check_soundness(task)
        sound.append(which)
        recipe = kind.recipe(config, task)
        counts = config.samples or (SAMPLES if recipe is None else recipe.samples,)
        check_weights(config.weights, min(counts))
        name = which if isinstance(which, str) else which.name
        models, about_models = _contact_models(config, task)
        each = len(models) * len(config.sigma or (None,)) * len(counts)
        change = "give fewer contact models, timesteps, sigmas or sample counts"
        check_count(programs * each, "cells", MOST_CELLS, change)
        options = task.scene.host.opt
        group = Group(name, task, float(options.timestep), CONES[int(options.cone)], models, recipe)
        at = f"h = {group.timestep!r} s: " if config.timestep is not None else ""
        messages += [f"{at}{message}" for message in about_models]
        for model, sigma, samples in itertools.product(models, config.sigma or (task.sigma,), counts):
            check_sigma(sigma)
            cells.append(StudyCell(len(groups), model, sigma, samples))
        groups.append(group)
    together = 1 if kind.one_program else config.seeds
    most = max(min(cell.samples, config.block_size or cell.samples) for cell in cells) * together
    tasks = [group.task for group in groups]
    most = min(LARGEST_BATCH[jax.default_backend()], most)
    size = config.chunk_size
    if size is None or natively(tasks):  # native code gains nothing from others, which would be built
        size = chunk_for(most, local_devices(), tasks, own_program=kind.one_program)
    plan = StudyPlan(config, tuple(groups), tuple(cells), size, tuple(dict.fromkeys(messages)))
    kind.check_memory(plan)
    check_numbers(plan.axes, plan.fields)
    steps = in_numpy() and sum(int(kind.rollouts(plan, cell)[0]) * plan.task_of(cell).horizon for cell in cells)
    if steps > LONG_IN_NUMPY:
        message = f"NumPy computes {count(steps)} steps: with a C compiler they take a tenth of the time"
        plan = dataclasses.replace(plan, warnings=(*plan.warnings, f"{message} (docs/native.md)"))
    for cell in {cell.group: cell for cell in cells}.values():
        corrected = [each.name for each in estimators_of(plan, cell) if "corrected" in each.needs]
        if config.surrogate and corrected:
            raise OptionError("backward", f"replaces the derivatives that {corrected[0]} corrects: omit one of them")
        others = [each.family for each in groups[cell.group].models if not has_mujoco_law(each.contact)]
        if corrected and others:
            raise OptionError(
                "estimators", f"with {corrected[0]} corrects MuJoCo's law, not {others[0]}: omit one of them"
            )
        kind.check(plan, cell)
    grids = [(group.task, group.models) for group in groups]
    reject_unused_options(config, given, grids, first_order=kind.first_order)
    return plan


def _as_single(config: StudyConfig, built: dict[str, Task]) -> StudyConfig:
    """The configuration of a single run; the first task is built, and added to those that are."""
    first = config.tasks[0]
    task = _build(config, first, None, None, built)
    if isinstance(first, str):
        built[first] = task
    contact, stiffness = single_defaults(task, config.contact, config.stiffness)
    return dataclasses.replace(config, contact=contact, stiffness=stiffness)


def _contact_models(config: StudyConfig, task: Task) -> Grid:
    """A task's contact models, and warnings about them; OptionError if there are none."""
    models, found = family_grid(task, config.contact, config.stiffness, config.damping, config.smoothing)
    if config.solref or config.solimp:
        more, also = solver_grid(task, config.solref, config.solimp)
        models, found = models + more, found + also
    models, also = backward_grid(task, models, config.backward, config.backward_stiffness, config.backward_margin)
    if not models:
        raise OptionError("contact", "needs at least one contact family, or {} or {}", "solref", "solimp")
    return models, found + also


def _build(
    config: StudyConfig, which: str | NamedTask, timestep: float | None, cone: str | None, built: Mapping[str, Task]
) -> Task:
    chosen = {"timestep": timestep, "cone": cone} | {name: getattr(config, name) for name in BUILDER_OPTIONS}
    chosen = {name: value for name, value in chosen.items() if value is not None}
    changes = {"onset": config.onset} | ({} if config.noise is None else {"noise": config.noise})
    if not isinstance(which, str):
        if not isinstance(which, Task):
            raise OptionError("tasks", f"takes names and Tasks, got {type(which).__name__}")
        if chosen:
            raise OptionError(next(iter(chosen)), "is for tasks given by name: build this one with it instead")
        check_shapes(which)
        return which.replace(**changes)
    if which in built and timestep is None and cone is None:
        return built[which].replace(**changes)
    return task_with_options(which, chosen).replace(**changes)
