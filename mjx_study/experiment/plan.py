"""Plan a study: check its configuration and resolve it into cells, computing nothing."""

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, Final

import jax

import estimators
from estimators import Estimator, find_estimator
from estimators.interpolation import check_weights
from estimators.noise import check_sigma
from estimators.user_inputs import inputs_read
from mjx_study.choices import CONES, REFERENCE
from mjx_study.experiment.iteration import make_optimizer, schedule_factors
from mjx_study.experiment.memory import (
    AT_ONCE,
    BLOCK_BYTES,
    LARGEST_BLOCK,
    blocks_take,
    bytes_of_moments,
    bytes_per_sample,
    check_batches,
    check_memory,
    largest_batch,
    padded_size,
)
from mjx_study.experiment.resolution import at_theta, configured_estimators, line_of, recipe_of
from mjx_study.experiment.unused_options import reject_unused_options
from mjx_study.identity import contents, estimator_contents
from mjx_study.limits import MOST_CELLS, MOST_GIB, MOST_PROGRAMS, check_count
from mjx_study.objective import chunk_for
from mjx_study.options.configuration import BUILDER_OPTIONS, OPTIONS, SAMPLES, NamedTask, Settings, StudyConfig
from mjx_study.options.option import OptionError
from mjx_study.runtime import local_devices
from mjx_study.table import digits_to_tell_apart
from mjx_study.tasks import TASKS, task_with_options
from mjx_study.tasks.contact_grid import ContactPoint, backward_grid, family_grid, single_defaults, solver_grid
from mjx_study.tasks.network import with_network
from mjx_study.tasks.soundness import check_soundness
from mjx_study.tasks.task import Recipe, Task, check_shapes
from mjx_study.tasks.user_task import registered_name

HISTORY_NUMBERS: Final = 20
"""Approximate count of numbers kept per iteration and seed, over all estimators."""


@dataclasses.dataclass(frozen=True)
class Group:
    """Cells that share compiled programs; the task's name in the configuration is unique."""

    name: str
    task: Task
    timestep: float
    cone: str
    models: tuple[ContactPoint, ...]
    recipe: Recipe | None = None

    @property
    def descent(self) -> Recipe:
        """The recipe, which groups of descents have."""
        assert self.recipe is not None
        return self.recipe


@dataclasses.dataclass(frozen=True)
class StudyCell:
    """One cell of a study, stored as one file; sigma is the standard deviation of the noise."""

    group: int
    model: ContactPoint
    sigma: float
    samples: int


@dataclasses.dataclass(frozen=True)
class StudyPlan:
    """A checked and resolved study.

    Attributes:
        cells: cells in the order of computation.
        warnings: warnings about contact models.
    """

    config: StudyConfig
    groups: tuple[Group, ...]
    cells: tuple[StudyCell, ...]
    chunk_size: int
    warnings: tuple[str, ...]

    @cached_property
    def settings(self) -> Settings:
        """The configuration's."""
        return self.config.settings

    @cached_property
    def chosen(self) -> dict[tuple[int, float], tuple[Estimator, ...]]:
        """Estimators by group and sigma, filled by `estimators_of`."""
        return {}

    def with_chunk(self, size: int) -> "StudyPlan":
        """The plan with another chunk size, such as that of a study begun earlier."""
        return dataclasses.replace(self, chunk_size=size)

    @property
    def compilations(self) -> int:
        """Number of programs to compile for each kind of contact of a group: two, or in descents one per estimator."""
        each = 2 if self.settings.kind != "descents" else len(self.config.estimators)
        return each * len({self.program_of(cell) for cell in self.cells if not cell.model.analytic})

    def program_of(self, cell: StudyCell) -> tuple[Any, ...] | None:
        """Key of a cell's compiled programs; None for an analytic system."""
        if cell.model.analytic:
            return None
        own = (cell.sigma, cell.samples) if self.settings.kind == "descents" else ()
        return cell.group, *own, jax.tree.structure(cell.model.contact)

    @property
    def memory(self) -> int:
        """Approximate memory of the batches and statistics held at once in the largest cell [bytes]."""
        return max(memory_of(self, cell) for cell in {(cell.group, cell.samples): cell for cell in self.cells}.values())

    @property
    def iterations(self) -> int | None:
        """Iterations of the longest descent; None in other kinds of study."""
        return max((group.recipe.iterations for group in self.groups if group.recipe), default=None)

    @property
    def contents(self) -> dict[str, str]:
        """Digests of what the numbers depend on: the tasks in all their forms, and user-defined estimators."""
        forms: dict[str, list[Task]] = {}
        for group in self.groups:
            forms.setdefault(group.name, []).append(group.task)
        return contents(forms) | estimator_contents(
            dict(zip(self.config.estimator_names, self.config.estimators, strict=True))
        )

    @property
    def places(self) -> tuple[str, ...]:
        """Names of the modules of user-defined tasks and estimators, and of tasks given as objects."""
        tasks = [each if isinstance(each, str) else f"task {each.name}" for each in self.config.tasks]
        places = [registered_name(each) or each for each in tasks if each not in TASKS]
        own = [each for each in self.config.estimator_names if ":" in each]
        return tuple(dict.fromkeys(each.partition(":")[0] for each in (*places, *own)))

    @property
    def seen(self) -> dict[str, str]:
        """Digests of files and environment variables that user-defined code has read so far."""
        return inputs_read(self.places)

    def label(self, cell: StudyCell) -> str:
        """A cell's name in messages."""
        group = self.groups[cell.group]
        digits = digits_to_tell_apart(each.timestep for each in self.groups)
        return f"{group.name}, {cell.model.label}, h = {group.timestep:.{digits}g} s, N = {cell.samples}"


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
    settings = config.settings
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
                raise OptionError("network", "needs MJX: the analytic references use the task's own policy")
            task = with_network(task, config.network, jax.random.key(config.seed))
        task = at_theta(task, config.theta)
        if which not in sound and not (which in TASKS and config.theta is config.model is None):
            check_soundness(task)
        sound.append(which)
        recipe = recipe_of(config, task) if settings.kind == "descents" else None
        counts = config.samples or (SAMPLES if recipe is None else recipe.samples,)
        check_weights(config.weights, min(counts))
        name = which if isinstance(which, str) else which.name
        models, told = family_grid(task, config.contact, config.stiffness, config.damping)
        if config.solref or config.solimp:
            more, also = solver_grid(task, config.solref, config.solimp)
            models, told = models + more, told + also
        models, also = backward_grid(task, models, config.backward, config.backward_stiffness, config.backward_margin)
        told += also
        if not models:
            raise OptionError("contact", "needs at least one contact family, or {} or {}", "solref", "solimp")
        each = len(models) * len(config.sigma or (None,)) * len(counts)
        change = "give fewer contact models, timesteps, sigmas or sample counts"
        check_count(programs * each, "cells", MOST_CELLS, change)
        options = task.scene.host.opt
        group = Group(name, task, float(options.timestep), CONES[int(options.cone)], models, recipe)
        at = f"h = {group.timestep!r} s: " if config.timestep is not None else ""
        messages += [f"{at}{message}" for message in told]
        for model, sigma, samples in itertools.product(models, config.sigma or (task.sigma,), counts):
            check_sigma(sigma)
            cells.append(StudyCell(len(groups), model, sigma, samples))
        groups.append(group)
    together = 1 if settings.kind == "descents" else config.batches
    most = min(largest_batch(), max(min(cell.samples, config.block_size or cell.samples) for cell in cells) * together)
    tasks = [group.task for group in groups]
    chunk = chunk_for(most, local_devices(), tasks) if config.chunk_size is None else config.chunk_size
    plan = StudyPlan(config, tuple(groups), tuple(cells), chunk, tuple(dict.fromkeys(messages)))
    check_batches(plan.memory, _whole(plan))
    for cell in {cell.group: cell for cell in cells}.values():
        group, chosen = groups[cell.group], estimators_of(plan, cell)
        if config.surrogate and (corrected := [each.name for each in chosen if "corrected" in each.needs]):
            raise OptionError("backward", f"replaces the derivatives that {corrected[0]} corrects: omit one of them")
        if group.recipe is not None:
            make_optimizer(settings.optimizer, group.recipe.learning_rate, group.recipe.decay)
            _check_schedules(config, group, group.recipe.iterations, chosen)
            history = HISTORY_NUMBERS * config.batches * group.recipe.iterations
            check_memory(group.task, chosen, config.batches * cell.samples, other=history)
            check_memory(group.task, (), settings.evaluation_samples)
        elif settings.kind == "landscapes":
            if config.theta is not None and group.task.policy.num_params == 1:
                raise OptionError("theta", "has one entry, and the line is its range: give {} instead", "span")
            line_of(group.task, settings.points, config.span, config.direction, config.seed)
    reject_unused_options(config, given, [(group.task, group.models) for group in groups])
    return plan


def _as_single(config: StudyConfig, built: dict[str, Task]) -> StudyConfig:
    """The configuration of a single run; the first task is built, and added to those that are."""
    first = config.tasks[0]
    task = _build(config, first, None, None, built)
    if isinstance(first, str):
        built[first] = task
    contact, stiffness = single_defaults(task, config.contact, config.stiffness)
    return dataclasses.replace(config, contact=contact, stiffness=stiffness)


def _whole(plan: StudyPlan) -> list[str]:
    """Names of estimators that need whole batches, in studies whose batches can be split into blocks; ValueError if
    there are any along with a block size."""
    if plan.settings.kind != "gradients":
        return []
    found = [each.name for each in estimators_of(plan, plan.cells[0]) if not each.mergeable]
    if found and plan.config.block_size is not None:
        reason = f"splits batches, and {', '.join(found)} must have whole ones: omit it; {blocks_take(found)}"
        raise OptionError("block_size", reason)
    return found


def _check_schedules(config: StudyConfig, group: Group, iterations: int, chosen: Sequence[Estimator]) -> None:
    """Raise ValueError for a schedule that cannot be read, or that a contact model or estimator does not support."""
    schedule_factors(config.sigma_schedule, iterations)
    schedule_factors(config.stiffness_schedule, iterations, most=1.0)
    if config.stiffness_schedule and any(
        model.stiffness is None or (model.contact is None and not model.analytic) for model in group.models
    ):
        raise OptionError("stiffness_schedule", "needs contact models with a stiffness; mjcf has none to set")
    fixed = [each.name for each in chosen if hasattr(each, "sigma")]
    if config.sigma_schedule and fixed:
        raise OptionError("sigma_schedule", f"changes sigma, and {fixed[0]} holds for one: omit one of them")


def oracles_of(config: StudyConfig) -> tuple[str, ...]:
    """Oracles that the estimators need, evaluations included."""
    return estimators.oracles_of(map(find_estimator, config.estimators), "evaluation")


def memory_of_seed(plan: StudyPlan, cell: StudyCell) -> int:
    """Memory of the batches and statistics of one seed of a cell [bytes]."""
    each = bytes_per_sample(plan.groups[cell.group].task, oracles_of(plan.config), len(plan.config.estimators))
    return padded_samples(plan, cell) * each


def padded_samples(plan: StudyPlan, cell: StudyCell) -> int:
    """Number of samples to which whole batches are padded for their statistics: their own unless all estimators are
    mergeable, and so ignore padding."""
    mergeable = all(each.mergeable for each in estimators_of(plan, cell))
    return padded_size(cell.samples) if mergeable else cell.samples


def block_of(plan: StudyPlan, cell: StudyCell) -> int:
    """Number of a seed's samples held at once: all of them, or a block if the configuration asks for it, or if the
    batches would otherwise be rejected."""
    config, whole = plan.config, cell.samples
    if plan.settings.kind != "gradients":
        return whole
    if config.block_size is not None:
        return min(config.block_size, whole)
    fits = memory_of_seed(plan, cell) <= MOST_GIB * 2**30
    if fits or not all(each.mergeable for each in estimators_of(plan, cell)):
        return whole
    even = int(BLOCK_BYTES / bytes_in_block(plan, cell)) // 2 * 2
    return min(whole, LARGEST_BLOCK, max(2, even))


def blocks_of(plan: StudyPlan, cell: StudyCell) -> int:
    """Number of blocks per seed; whole batches are one."""
    return math.ceil(cell.samples / block_of(plan, cell))


def memory_of(plan: StudyPlan, cell: StudyCell) -> int:
    """Memory held at once [bytes]: batches and statistics, or a block, and moments until a batch is complete."""
    if blocks_of(plan, cell) == 1:
        return memory_of_seed(plan, cell) * seeds_together(plan, cell)
    moments = bytes_of_moments(estimators_of(plan, cell), plan.groups[cell.group].task.policy.num_params)
    kept = plan.config.batches + math.ceil(math.log2(blocks_of(plan, cell)))
    return block_of(plan, cell) * bytes_in_block(plan, cell) + 2 * kept * moments


def bytes_in_block(plan: StudyPlan, cell: StudyCell) -> int:
    """Memory per sample of a block, statistics included [bytes]."""
    task, count = plan.groups[cell.group].task, len(plan.config.estimators)
    return bytes_per_sample(task, oracles_of(plan.config), 2 * count, draws=0)


def seeds_together(plan: StudyPlan, cell: StudyCell) -> int:
    """Number of seeds that a cell draws at once: all, or in studies of gradients as many as fit, in equal groups."""
    batches = plan.config.batches
    if plan.settings.kind != "gradients":
        return batches
    fitting = max(1, int(AT_ONCE[jax.default_backend()] / memory_of_seed(plan, cell)))
    return math.ceil(batches / math.ceil(batches / fitting))


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


def estimators_of(plan: StudyPlan, cell: StudyCell) -> tuple[Estimator, ...]:
    """Build a cell's estimators with their options, and check them against its task."""
    key = cell.group, cell.sigma
    if key not in plan.chosen:
        task = plan.groups[cell.group].task.replace(sigma=cell.sigma)
        plan.chosen[key] = configured_estimators(plan.config, task)
    return plan.chosen[key]
