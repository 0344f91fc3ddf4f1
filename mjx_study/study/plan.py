"""The configuration of a study, and its plan: checked, resolved into cells, nothing computed."""

import dataclasses
import itertools
from typing import Any, ClassVar, Final

import jax

import estimators
from estimators import ESTIMATORS, Estimator, find_estimator
from estimators.cross_fitting import PLUG_IN, check_weights
from estimators.ddcg import PUBLISHED_TOLERANCE
from mjx_study.limits import MOST_CELLS, MOST_PROGRAMS, check_count
from mjx_study.objective import chunk_for
from mjx_study.option import OPTIONS, Checked, check
from mjx_study.simulation.contact import FAMILIES
from mjx_study.study.configuration import (
    EstimatorConfig,
    at_theta,
    check_names,
    configured_estimators,
    refuse_repeats,
)
from mjx_study.study.descents import OptimiseConfig, OptimisePlan, plan_optimise
from mjx_study.study.landscapes import check_span, line_of
from mjx_study.study.memory import bytes_per_sample, check_batches, seeds_at_once
from mjx_study.study.sampling import LARGEST_BATCH
from mjx_study.table import digits_to_tell_apart
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import ContactPoint, contact_grid, solver_grid
from mjx_study.tasks.task import Task, check_sigma
from mjx_study.tasks.validation import check_shapes

OF_KIND: Final[dict[str, dict[str, Any]]] = {
    "gradients": {"reference_samples": 600},
    "descents": {"optimizer": "sgd", "learning_rate": None, "decay": None, "evaluation_samples": 200},
    "landscapes": {"span": None, "direction": None},
}
"""Options that one kind of sweep alone has, and what they are unless given."""
ASKED_BY: Final = {"descents": "give iterations as well", "landscapes": "give points as well"}


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyConfig(Checked):
    """Everything that decides a study: gradient estimates, or descents, or landscapes.

    Attributes:
        tasks: names of tasks, or tasks.
        estimators: names of estimators.
        theta: parameters at which gradients are taken, of a single task; None for the task's.
        contact: contact families; None for each task's. Empty for none but those of `solref`.
        stiffness: of the families that take one [N/m]; None for each task's.
        damping: of the contact [N s/m]; None for each family's.
        solref, solimp: contact models in MuJoCo's own terms, every solref with every solimp, beside the families;
            either alone goes with MuJoCo's default of the other.
        timestep: [s]; None for the MJCF's. Each gets as many steps as take as long as the task's own, unless horizon is
            given.
        cone: pyramidal, elliptic; None for the MJCF's.
        sigma: standard deviations of the noise; None for each task's.
        samples: sizes of a batch.
        confidence: of the intervals within a batch.
        seeds: batches of each size, or descents; of landscapes, batches that are taken together at each point. None for
            10, of landscapes 1.
        iterations: of gradient descent; None to estimate gradients where each task starts.
        points: on a line through each task's theta, for landscapes; None for no landscapes.
        span, direction: of that line, as in `LandscapeConfig`; None for each task's range and a random direction.
        optimizer, learning_rate, decay: of a descent, as in `OptimiseConfig`.
        reference_samples: pairs of rollouts behind each reference gradient; of gradients, None for 600.
        evaluation_samples: rollouts behind the cost of a final policy; of descents, None for 200.
        seed, noise, baseline, gamma, published, failure_probability, variance_proxy, radius, max_norm, window,
            tolerance, weights, onset, horizon, model, chunk_size: as in `EstimatorConfig`.
    """

    ranges: ClassVar = {"samples": "[3, 1e7]"}

    tasks: tuple[str | Task, ...]
    estimators: tuple[str, ...] = ("zobg", "fobg", "aobg")
    theta: tuple[float, ...] | None = None
    contact: tuple[str, ...] | None = None
    stiffness: tuple[float, ...] | None = None
    damping: float | None = None
    solref: tuple[tuple[float, ...], ...] = ()
    solimp: tuple[tuple[float, ...], ...] = ()
    timestep: tuple[float, ...] | None = None
    cone: tuple[str, ...] | None = None
    sigma: tuple[float, ...] | None = None
    samples: tuple[int, ...] = (100,)
    confidence: float = 0.95
    seeds: int | None = None
    iterations: int | None = None
    points: int | None = None
    span: tuple[float, ...] | None = None
    direction: str | None = None
    optimizer: str | None = None
    learning_rate: float | None = None
    decay: float | None = None
    reference_samples: int | None = None
    evaluation_samples: int | None = None
    seed: int = 0
    noise: str | None = None
    baseline: str = "zero_noise"
    gamma: float | None = None
    published: bool = False
    failure_probability: float = 0.05
    variance_proxy: str = "variance"
    radius: str | float = "max_deviation"
    max_norm: float | None = None
    window: int | None = None
    tolerance: float = PUBLISHED_TOLERANCE
    weights: str = PLUG_IN
    onset: str = "none"
    horizon: int | None = None
    model: str | None = None
    chunk_size: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.tasks:
            raise ValueError("no task given")
        if self.theta is not None and len(self.tasks) > 1:
            raise ValueError("theta is of a single task; give one task, or leave theta out")
        check_names("estimator", self.estimators, ESTIMATORS)
        if self.contact:
            check_names("contact family", self.contact, FAMILIES)
        if self.contact is not None and not any(FAMILIES[name].swept for name in self.contact):
            for name in ("stiffness", "damping"):
                if getattr(self, name) is not None:
                    chosen = f"contact {', '.join(self.contact)}" if self.contact else "solref or solimp alone"
                    raise ValueError(f"{chosen} takes no {name}; leave {name} out")
        for name in ("tasks", "stiffness", "solref", "solimp", "timestep", "cone", "sigma", "samples"):
            values = getattr(self, name)
            if values is not None:
                refuse_repeats(name, values)
            if values == () and name not in ("solref", "solimp"):
                raise ValueError(f"no {name} given: give at least one, or leave it out")
        if self.iterations is not None and self.points is not None:
            raise ValueError("iterations are of descents and points of landscapes: give one of them")
        self._settle()
        check_span(self.span)
        check_weights(self.weights, min(self.samples))

    def _settle(self) -> None:
        """Refuse options that have no effect in this kind of sweep, and give its own their defaults."""
        for kind, options in OF_KIND.items():
            given = [name for name in options if getattr(self, name) is not None]
            if kind != self.kind and given:
                listed = f"{' and '.join(given)} {'is' if len(given) == 1 else 'are'}"
                raise ValueError(f"{listed} of {kind}: {ASKED_BY.get(kind, 'leave it out')}")
            for name, default in options.items():
                if kind == self.kind and getattr(self, name) is None:
                    object.__setattr__(self, name, default)

    @property
    def task_names(self) -> list[str]:
        """Names of the tasks."""
        return [which if isinstance(which, str) else which.name for which in self.tasks]

    @property
    def kind(self) -> str:
        """What is computed: gradients, descents or landscapes."""
        return "descents" if self.iterations is not None else "gradients" if self.points is None else "landscapes"

    @property
    def batches(self) -> int:
        """The number of seeds, given or not."""
        return self.seeds or (1 if self.kind == "landscapes" else 10)


@dataclasses.dataclass(frozen=True)
class Group:
    """What one compilation serves.

    Attributes:
        name: name of the task, as the configuration has it; two tasks may call themselves the same.
        task: as it is built.
        timestep: [s].
        cone: pyramidal or elliptic.
        models: contact models.
    """

    name: str
    task: Task
    timestep: float
    cone: str
    models: tuple[ContactPoint, ...]


@dataclasses.dataclass(frozen=True)
class StudyCell:
    """One file of a study.

    Attributes:
        group: index of the group.
        model: the contact model.
        sigma: of the noise.
        samples: in each batch.
    """

    group: int
    model: ContactPoint
    sigma: float
    samples: int


@dataclasses.dataclass(frozen=True)
class StudyPlan:
    """A sweep that has been checked.

    Attributes:
        config: as given.
        groups: what is compiled.
        cells: what is computed, in this order.
        chunk_size: samples per device and call, for the devices here unless the configuration gives it.
        warnings: about contact models.
    """

    config: StudyConfig
    groups: tuple[Group, ...]
    cells: tuple[StudyCell, ...]
    chunk_size: int
    warnings: tuple[str, ...]

    @property
    def compilations(self) -> int:
        """Programs of rollouts that are needed: two for each group, or one for each of its descents."""
        if self.config.kind != "descents":
            return 2 * len(self.groups)
        settings = {(cell.group, cell.sigma, cell.samples) for cell in self.cells}
        return len(settings) * len(self.config.estimators)

    @property
    def memory(self) -> int:
        """That batches and their statistics take at once in the largest cell, roughly [bytes]."""
        cells = {(cell.group, cell.samples): cell for cell in self.cells}.values()
        return max(memory_of_seed(self, cell) * seeds_together(self, cell) for cell in cells)

    def label(self, cell: StudyCell) -> str:
        """As messages name a cell."""
        group = self.groups[cell.group]
        digits = digits_to_tell_apart(each.timestep for each in self.groups)
        return f"{group.name}, {cell.model.label}, h = {group.timestep:.{digits}g} s, N = {cell.samples}"


def plan_study(config: StudyConfig) -> StudyPlan:
    """Check a configuration and resolve its defaults, computing nothing.

    Raises:
        ValueError: anything about the configuration that cannot be run; the message says what is accepted.
    """
    programs = len(config.tasks) * len(config.timestep or (None,)) * len(config.cone or (None,))
    check_count(programs, "programs", MOST_PROGRAMS, "give fewer tasks, timesteps or cones")
    groups: list[Group] = []
    cells: list[StudyCell] = []
    messages: list[str] = []
    for which, timestep, cone in itertools.product(config.tasks, config.timestep or (None,), config.cone or (None,)):
        task = at_theta(_build(config, which, timestep, cone), config.theta)
        name = which if isinstance(which, str) else which.name
        models, told = contact_grid(task, config.contact, config.stiffness, config.damping)
        if config.solref or config.solimp:
            more, also = solver_grid(task, config.solref, config.solimp)
            models, told = models + more, told + also
        if not models:
            raise ValueError("no contact model: give at least one contact family, solref or solimp")
        each = len(models) * len(config.sigma or (None,)) * len(config.samples)
        change = "give fewer contact models, timesteps, sigmas or sample counts"
        check_count(programs * each, "cells", MOST_CELLS, change)
        host = task.scene.host
        group = Group(name, task, float(host.opt.timestep), {0: "pyramidal", 1: "elliptic"}[int(host.opt.cone)], models)
        at = f"h = {group.timestep!r} s: " if config.timestep is not None else ""
        messages += [f"{at}{message}" for message in told]
        for model, sigma, samples in itertools.product(models, config.sigma or (task.sigma,), config.samples):
            check_sigma(sigma)
            cells.append(StudyCell(len(groups), model, sigma, samples))
        groups.append(group)
    most = min(LARGEST_BATCH, max(config.samples) * (1 if config.iterations else config.batches))
    chunk = chunk_for(most, jax.local_devices()) if config.chunk_size is None else config.chunk_size
    plan = StudyPlan(config, tuple(groups), tuple(cells), chunk, tuple(dict.fromkeys(messages)))
    check_batches(plan.memory)
    for cell in {cell.group: cell for cell in cells}.values():
        estimators_of(plan, cell)
        if config.kind == "descents":
            descent_plan(plan, cell)
        elif config.kind == "landscapes":
            line_of(groups[cell.group].task, config.points or 0, config.span, config.direction, config.seed)
    return plan


def oracles_of(config: StudyConfig) -> tuple[str, ...]:
    """Kinds of batches that the estimators need, and costs."""
    return estimators.oracles_of(map(find_estimator, config.estimators), "evaluation")


def memory_of_seed(plan: StudyPlan, cell: StudyCell) -> int:
    """Memory of the batches of one seed of a cell, and of their statistics [bytes]."""
    each = bytes_per_sample(plan.groups[cell.group].task, oracles_of(plan.config), len(plan.config.estimators))
    return cell.samples * each


def seeds_together(plan: StudyPlan, cell: StudyCell) -> int:
    """How many seeds a cell draws at once: of gradients as many as fit, of others all."""
    batches = plan.config.batches
    return seeds_at_once(memory_of_seed(plan, cell), batches) if plan.config.kind == "gradients" else batches


def _build(config: StudyConfig, which: str | Task, timestep: float | None, cone: str | None) -> Task:
    chosen = {"timestep": timestep, "cone": cone, "horizon": config.horizon, "model": config.model}
    chosen = {key: value for key, value in chosen.items() if value is not None}
    changes = {"onset": config.onset} | ({} if config.noise is None else {"noise": config.noise})
    if isinstance(which, Task):
        if chosen:
            raise ValueError(f"{', '.join(chosen)}: only for a task that is built by its name; build this one so")
        check_shapes(which)
        return which.replace(**changes)
    if timestep is not None and config.horizon is None:
        own = make_task(which, **{key: value for key, value in chosen.items() if key != "timestep"})
        steps = own.horizon * float(own.scene.host.opt.timestep) / timestep
        chosen["horizon"] = max(1, round(min(steps, 1e15)))
        check(OPTIONS["horizon"], chosen["horizon"])
    return make_task(which, **chosen).replace(**changes)


def estimators_of(plan: StudyPlan, cell: StudyCell) -> tuple[Estimator, ...]:
    """A cell's estimators with their options, checked against its task."""
    task = plan.groups[cell.group].task.replace(sigma=cell.sigma)
    return configured_estimators(_shared(plan.config, task), task)


def _shared(config: StudyConfig, task: Task) -> EstimatorConfig:
    names = {field.name for field in dataclasses.fields(EstimatorConfig)} & {
        field.name for field in dataclasses.fields(StudyConfig)
    }
    built = {"sigma", "cone", "horizon", "model", "theta"}  # the task has them
    kept = {name: getattr(config, name) for name in names - built}
    return EstimatorConfig(task=task.name, **kept)


def descent_plan(plan: StudyPlan, cell: StudyCell) -> OptimisePlan:
    """A cell's descents."""
    config, task = plan.config, plan.groups[cell.group].task.replace(sigma=cell.sigma)
    names = ("iterations", "optimizer", "learning_rate", "decay", "evaluation_samples")
    chosen = {field.name: getattr(_shared(config, task), field.name) for field in dataclasses.fields(EstimatorConfig)}
    chosen |= {name: getattr(config, name) for name in names}
    chosen |= {"seeds": config.batches, "samples": cell.samples, "chunk_size": plan.chunk_size}
    descent = OptimiseConfig(**chosen)
    return plan_optimise(descent, task, cell.model)
