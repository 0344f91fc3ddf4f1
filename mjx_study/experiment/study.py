"""A study: its kind, its plan of cells, and the computation of a cell in work units.

A cell is computed in work units: mostly a single one, or blocks whose summaries are merged. Units can be computed in
any order and anywhere, since each depends on the plan alone.
"""

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Hashable, Mapping, Sized
from concurrent.futures import Future
from contextlib import contextmanager
from functools import cached_property
from typing import Any, Final, TypeVar

import jax
import numpy as np

import estimators
from estimators import Estimator, find_estimator
from estimators.user_inputs import inputs_read
from mjx_study.experiment.memory import bytes_per_sample, check_batches, padded_size
from mjx_study.experiment.resolution import configured_estimators
from mjx_study.identity import contents, estimator_contents
from mjx_study.limits import MOST_NUMBERS
from mjx_study.options.configuration import StudyConfig
from mjx_study.results.kind import StudyResults, find_kind
from mjx_study.table import digits_to_tell_apart
from mjx_study.tasks import TASKS, registered_name
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Recipe, Task

Result = TypeVar("Result")
Arrays = dict[str, np.ndarray]
SAVE_SECONDS: Final = 20.0
"""Seconds between checkpoints of a cell."""


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
    def kind(self) -> "StudyKind":
        return find_kind(self.config.settings.kind)

    @cached_property
    def chosen(self) -> dict[tuple[int, float], tuple[Estimator, ...]]:
        """Estimators by group and sigma, filled by `estimators_of`."""
        return {}

    @cached_property
    def oracles(self) -> tuple[str, ...]:
        """Oracles that the estimators need, evaluations included."""
        return estimators.oracles_of(map(find_estimator, self.config.estimators), "evaluation")

    def task_of(self, cell: StudyCell) -> Task:
        """A cell's task, with the task's own sigma."""
        return self.groups[cell.group].task

    def program_of(self, cell: StudyCell) -> Hashable:
        """Key of a cell's compiled programs; None for an analytic system."""
        return None if cell.model.analytic else self.kind.program_of(cell)

    @property
    def compilations(self) -> int:
        programs = {self.program_of(cell) for cell in self.cells} - {None}
        return self.kind.programs_per_key(self.config) * len(programs)

    @property
    def memory(self) -> int:
        """Approximate memory of the batches and statistics held at once in the largest cell [bytes]."""
        different = {(cell.group, cell.samples): cell for cell in self.cells}
        return max(self.kind.memory(self, cell) for cell in different.values())

    def memory_of_seed(self, cell: StudyCell) -> int:
        """Memory of the batches and statistics of one seed of a cell [bytes]."""
        each = bytes_per_sample(self.task_of(cell), self.oracles, len(self.config.estimators))
        return self.padded_samples(cell) * each

    def padded_samples(self, cell: StudyCell, seeds: int = 1) -> int:
        """Number of samples to which whole batches, of several seeds together, are padded for their statistics: their
        own unless all estimators are mergeable, and so ignore padding."""
        samples, mergeable = seeds * cell.samples, all(each.mergeable for each in estimators_of(self, cell))
        return padded_size(samples) if mergeable else samples

    @property
    def iterations(self) -> int | None:
        """Iterations of the longest descent; None in other kinds of study."""
        return max((group.recipe.iterations for group in self.groups if group.recipe), default=None)

    @property
    def fields(self) -> dict[str, Any]:
        """Fields of the configuration as a manifest holds them."""
        named = {"tasks": self.config.task_names, "estimators": self.config.estimator_names}
        optimizers = {group.recipe.optimizer for group in self.groups if group.recipe}
        shared = optimizers.pop() if len(optimizers) == 1 else None
        return self.config.resolved() | named | {"iterations": self.iterations, "optimizer": shared}

    @cached_property
    def coordinates(self) -> list[dict[str, Any]]:
        """Exact coordinates of every cell on the study's axes."""
        return [
            {
                "task": (group := self.groups[cell.group]).name,
                "timestep": group.timestep,
                "cone": group.cone,
                "model": (cell.model.family, cell.model.stiffness_or_zero),
                "sigma": cell.sigma,
                "samples": cell.samples,
            }
            for cell in self.cells
        ]

    @cached_property
    def axes(self) -> dict[str, list[Any]]:
        """The values of all cells along each axis: numbers sorted, others in the order of the configuration."""
        axes = {name: list(dict.fromkeys(each[name] for each in self.coordinates)) for name in self.coordinates[0]}
        return axes | {name: sorted(axes[name]) for name in ("timestep", "sigma", "samples")}

    @property
    def contents(self) -> dict[str, str]:
        forms: dict[str, list[Task]] = {}
        for group in self.groups:
            forms.setdefault(group.name, []).append(group.task)
        return contents(forms) | estimator_contents(
            dict(zip(self.config.estimator_names, self.config.estimators, strict=True))
        )

    @property
    def user_modules(self) -> tuple[str, ...]:
        """Names of the modules of user-defined tasks and estimators, and of tasks given as objects."""
        tasks = [each if isinstance(each, str) else f"task {each.name}" for each in self.config.tasks]
        names = [registered_name(each) or each for each in tasks if each not in TASKS]
        own = [each for each in self.config.estimator_names if ":" in each]
        return tuple(dict.fromkeys(each.partition(":")[0] for each in (*names, *own)))

    @property
    def seen(self) -> dict[str, str]:
        """Digests of files and environment variables that user-defined code has read so far."""
        return inputs_read(self.user_modules)

    def label(self, cell: StudyCell) -> str:
        """A cell's name in messages."""
        group = self.groups[cell.group]
        digits = digits_to_tell_apart(each.timestep for each in self.groups)
        return f"{group.name}, {cell.model.label}, h = {group.timestep:.{digits}g} s, N = {cell.samples}"


def estimators_of(plan: StudyPlan, cell: StudyCell) -> tuple[Estimator, ...]:
    """Build a cell's estimators with their options, and check them against its task."""
    key = cell.group, cell.sigma
    if key not in plan.chosen:
        plan.chosen[key] = configured_estimators(plan.config, plan.task_of(cell).replace(sigma=cell.sigma))
    return plan.chosen[key]


def check_numbers(axes: Mapping[str, Sized], config: Mapping[str, Any]) -> None:
    """Raise ValueError for a study with a variable of more than `MOST_NUMBERS` numbers, given the axes of all cells."""
    inner = config["seeds"] * len(config["estimators"]) * max(config["iterations"] or 1, config["points"] or 1)
    if math.prod(map(len, axes.values())) * inner > MOST_NUMBERS:
        raise ValueError(
            f"a variable would have more than {MOST_NUMBERS} numbers, which is the limit: use fewer tasks, seeds, "
            "iterations or points"
        )


class StudyError(ValueError):
    """A folder holds no study, another study, or a damaged file."""


def reason_of(error: Exception) -> str:
    """What is wrong with a file, in one line."""
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Checkpointing within a cell.

    Attributes:
        kept: arrays of the last checkpoint.
        report: reports progress within the cell: done, total, and what is being computed.
        name: name of the checkpoint in messages.
    """

    kept: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    save: Callable[[Arrays], None] = lambda arrays: None
    report: Callable[[int, int, str], None] = lambda done, total, what: None
    name: str = "the checkpoint"

    @contextmanager
    def restored(self) -> Generator[None]:
        """Let arrays of the checkpoint that are missing or of another form be a StudyError."""
        try:
            yield
        except (KeyError, IndexError, TypeError, ValueError) as error:
            reason = f"no {error}" if isinstance(error, KeyError) else reason_of(error)
            message = f"{self.name} does not fit the study ({reason}); move it away to compute its cell again"
            raise StudyError(message) from error


class Computation(ABC):
    """Computes work units of a plan's cells, and keeps compiled programs between them."""

    def begin(self, cell: StudyCell, checkpoint: Checkpoint) -> Any:
        """The `merged_samples.Blocks` of a cell, with those that its checkpoint holds; StudyError if that does not fit.
        None for a single work unit, which finds all numbers."""
        return None

    @abstractmethod
    def compute(self, cell: StudyCell, unit: int, checkpoint: Checkpoint) -> Future[Arrays]:
        """Compute a unit; on accelerators it may still be running on return."""


class StudyKind(StudyResults):
    """A kind of study: how a configuration is checked, and how a cell is computed."""

    one_program: bool = False
    """Whether all of a cell's samples run inside one program, made for their number."""
    first_order: bool = False
    """Whether cells have means of first-order gradients whatever the estimators are."""

    def describe(self, plan: StudyPlan) -> str:
        """The kind in the head of a sweep."""
        return self.name

    def recipe(self, config: StudyConfig, task: Task) -> Recipe | None:
        """Settings of a task's descents; None in other kinds of study."""
        return None

    def check(self, plan: StudyPlan, cell: StudyCell) -> None:
        """Raise ValueError for a configuration that cannot be run; called with one cell of each group."""

    def check_memory(self, plan: StudyPlan) -> None:
        """Raise ValueError for batches that do not fit into memory."""
        check_batches(plan.memory, "use fewer samples or seeds")

    def program_of(self, cell: StudyCell) -> Hashable:
        """Key of the compiled programs of a cell with MJX."""
        return cell.group, jax.tree.structure(cell.model.contact)

    def programs_per_key(self, config: StudyConfig) -> int:
        """Number of rollout programs for each key: costs and derivatives."""
        return 2

    def memory(self, plan: StudyPlan, cell: StudyCell) -> int:
        """Memory held at once [bytes]: the batches of all seeds."""
        each = bytes_per_sample(plan.task_of(cell), plan.oracles, len(plan.config.estimators), draws=0)
        return plan.padded_samples(cell) * plan.config.seeds * each

    def size(self, plan: StudyPlan, cell: StudyCell) -> int:
        """Size of a cell's arrays [bytes]."""
        sizes = self.sizes(plan.fields, plan.task_of(cell).policy.num_params)
        return sum(8 * math.prod(sizes[dim] for dim in variable.dims) for variable in self.variables.values())

    @abstractmethod
    def rollouts(self, plan: StudyPlan, cell: StudyCell) -> np.ndarray:
        """Approximate number of rollouts of a cell, and of those differentiated."""

    def more_rollouts(self, plan: StudyPlan, cell: StudyCell) -> int:
        """Maximum number of further rollouts, by what is found."""
        return 0

    @abstractmethod
    def computation(self, plan: StudyPlan) -> Computation:
        """The computation of a plan's cells."""


def done(result: Result) -> Future[Result]:
    """A future that has its result."""
    future = Future[Result]()
    future.set_result(result)
    return future
