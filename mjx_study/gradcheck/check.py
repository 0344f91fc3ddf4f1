"""Plan and run a check: every contact model, every state, every derivative."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Final

import jax.numpy as jnp
import mujoco

from mjx_study.choices import CHECKED_STATES, CHECKED_STEPS, laws_of, takes_stiffness
from mjx_study.choices import CHECKED_STIFFNESS as STIFFNESS
from mjx_study.gradcheck.coordinates import make_coordinates
from mjx_study.gradcheck.cost import CostPrograms, check_cost, judge_closed_forms
from mjx_study.gradcheck.engine_step import EngineStep
from mjx_study.gradcheck.programs import Compiler, ContactCase, Programs
from mjx_study.gradcheck.report import CostCheck, Finding, GradcheckReport, StepCheck, gravity
from mjx_study.gradcheck.states import start_of, states_of
from mjx_study.gradcheck.steps import check_state, collect, step_check
from mjx_study.options.option import OptionError, reject_untaken
from mjx_study.progress import Progress, silent
from mjx_study.runtime import environment
from mjx_study.simulation.engine import quiet_engine
from mjx_study.simulation.scene import Scene
from mjx_study.table import plural
from mjx_study.tasks.contact_grid import ContactPoint, family_grid
from mjx_study.tasks.mjcf import scene_task
from mjx_study.tasks.task import Task

CONTACT: Final = ("penalty", "mujoco", "mujoco_default")


@dataclasses.dataclass(frozen=True, eq=False)
class GradcheckPlan:
    """Validated plan of a check.

    Attributes:
        subject: the task; for a file, the result of `scene_task`.
        is_task: whether to check its cost.
        cells, warnings: contact models to check in turn, and the warnings about them.
        states: number of states per contact model.
        seed: random seed of initial states, states and directions.
        stock: whether to check the derivative of `mjx.step` too.
        parameters: whether to check derivatives with respect to contact parameters.
    """

    subject: Task
    is_task: bool
    cells: tuple[ContactPoint, ...]
    warnings: tuple[str, ...]
    states: int
    seed: int
    stock: bool
    parameters: bool = True

    def __post_init__(self) -> None:
        if self.subject.scene.template.qpos.dtype != jnp.float64:
            raise ValueError("gradcheck compares with differences and needs float64, the default precision")
        if self.subject.scene.host.nv == 0:
            raise ValueError(f"{self.subject.scene.name} has no degree of freedom: there is nothing to differentiate")
        if self.states < 1:
            raise ValueError(f"states must be at least 1, got {self.states}")


def plan_gradcheck(
    task: Task,
    families: Sequence[str] | None,
    stiffnesses: Sequence[float] | None,
    *,
    seed: int,
    damping: float | None = None,
    smoothing: float | None = None,
    states: int = CHECKED_STATES,
    stock: bool = False,
) -> GradcheckPlan:
    """Plan a check of a task's gradient, and of steps along its rollout.

    Args:
        task: the task, in float64, with the theta of its gradient.
        families: contact families; by default `CONTACT`, or `mjcf` for a task without contact.
        stiffnesses: stiffnesses for families that take one [N/m]; by default `STIFFNESS`, or the task's if those are in
            another range.
        seed: random seed of initial states, states and directions.
        damping: override of each family's damping [N s/m].
        smoothing: override of the smoothing kappa of laws other than MuJoCo's [J].
        states: number of states per contact model, at least 1.
        stock: whether to check the derivative of `mjx.step` too.

    Raises:
        ValueError: unusable family or stiffness, too few states, or float32.
    """
    if families is None:
        families = ("mjcf",) if task.contact_pair is None else CONTACT
    if not families or (stiffnesses is not None and not stiffnesses):
        raise ValueError("no contact model to check: give at least one stiffness and one contact family")
    own = task.defaults.stiffnesses
    overlap = min(STIFFNESS) <= max(own) and min(own) <= max(STIFFNESS)
    usual = STIFFNESS if overlap else own
    cells, messages = family_grid(task, families, usual if stiffnesses is None else stiffnesses, damping, smoothing)
    reject_untaken(families, stiffness=stiffnesses, damping=damping, smoothing=smoothing)
    if stock and (laws := laws_of(families)):
        raise OptionError("stock", f"is for MuJoCo's law, which {laws[0]} does not have: omit it")
    return GradcheckPlan(task, True, cells, messages, states, seed, stock)


def plan_scene_gradcheck(
    scene: Scene,
    families: Sequence[str] | None = None,
    stiffnesses: Sequence[float] | None = None,
    *,
    seed: int,
    pair: tuple[str, str] | None = None,
    damping: float | None = None,
    smoothing: float | None = None,
    horizon: int = CHECKED_STEPS,
    states: int = CHECKED_STATES,
    stock: bool = False,
) -> GradcheckPlan:
    """Plan a check of the steps of any scene.

    Args:
        scene: the scene, in float64, with at least one degree of freedom.
        families: contact families; by default `mjcf`, or `mujoco` if a stiffness is given.
        stiffnesses: stiffnesses for families that take one [N/m].
        seed: random seed of the states.
        pair: names of the two geoms whose contact has the stiffness; every contact gets the same solref.
        damping: as for `plan_gradcheck`.
        smoothing: as for `plan_gradcheck`.
        horizon: number of steps of the rollout from which states are taken.
        states: number of states per contact model.
        stock: whether to check the derivative of `mjx.step` too.

    Raises:
        ValueError: as for `plan_gradcheck`, or a stiffness without a pair.
    """
    if families is None:
        families = ("mjcf",) if stiffnesses is None else ("mujoco",)
    reject_untaken(families, stiffness=stiffnesses, damping=damping, smoothing=smoothing)
    swept = takes_stiffness(families)
    if swept and stiffnesses is None:
        raise OptionError("stiffness", "must be given in N/m, along with {}, for a family that takes one", "pair")
    if swept and pair is None:
        raise OptionError("stiffness", "in N/m requires the effective mass of a contact: give {} GEOM,GEOM", "pair")
    if pair is not None and not swept:
        raise OptionError("pair", "is for a stiffness: give {}, or omit it", "stiffness")
    task, model = scene_task(scene, horizon=horizon, pair=pair), {"damping": damping, "smoothing": smoothing}
    plan = plan_gradcheck(task, families, stiffnesses, **model, seed=seed, states=states, stock=stock)
    return dataclasses.replace(plan, is_task=False)


@quiet_engine()  # intermediate states may cause warnings
def gradcheck(plan: GradcheckPlan, progress: Progress = silent) -> GradcheckReport:
    """Run all checks of a plan; `progress` is called with (parts done, their total number, the next)."""
    task, compiler = plan.subject, Compiler()
    done, total = itertools.count(), 1 + len(plan.cells) * (plan.states + plan.is_task)

    def begin(what: str) -> None:
        progress(min(next(done), total), total, what)

    begin("compiling")
    layouts = [make_coordinates(task.scene, cell.contact, parameters=plan.parameters) for cell in plan.cells]
    programs = Programs(layouts[0], compiler)
    cases = [ContactCase(cell.contact, layout.scales) for cell, layout in zip(plan.cells, layouts, strict=True)]
    programs.start(cases[0], start_of(task.scene), stock=plan.stock)
    costs = CostPrograms(task, plan.seed, compiler) if plan.is_task else None
    if costs is not None:
        costs.compile(plan.cells[0].contact)
    cost_checks: list[CostCheck] = []
    step_checks: list[StepCheck] = []
    findings: list[Finding] = []
    for cell, layout, case in zip(plan.cells, layouts, cases, strict=True):
        visited = None
        if costs is not None:
            begin(f"{cell.label}: gradient of the cost")
            cost, visited = check_cost(costs, cell, plan.seed)
            cost_checks.append(cost)
        samples, coverage = states_of(task.scene, cell.contact, plan.states, task.horizon, plan.seed, visited)
        engine_step = EngineStep(layout, cell.contact)
        checks = []
        for sample in samples:
            begin(f"{cell.label}: {sample.label}")
            checks.append(check_state(programs, engine_step, case, sample, stock=plan.stock))
        found = collect(cell, programs.layout, checks)
        step_checks.append(step_check(cell, programs.layout, checks, found, coverage))
        findings += found
    progress(total, total, "done")
    findings += judge_closed_forms(cost_checks)
    return GradcheckReport(
        subject=task.name,
        summary=_summary(plan),
        costs=tuple(cost_checks),
        steps=tuple(step_checks),
        findings=tuple(sorted(findings, key=gravity)),
        warnings=(*plan.warnings, *_uncompared(step_checks), *unoffered(task.scene.host)),
        environment=environment(),
    )


def _summary(plan: GradcheckPlan) -> str:
    host = plan.subject.scene.host
    parts = [f"{plural(host.nv, 'degree')} of freedom"]
    parts += [plural(number, noun) for number, noun in ((host.na, "activation"), (host.nu, "control")) if number]
    taken = f"{plural(plan.states, 'state')} along {plural(plan.subject.horizon, 'step')} of {host.opt.timestep:g} s"
    return f"{', '.join(parts)}; {taken}"


def _uncompared(checks: Sequence[StepCheck]) -> list[str]:
    return [
        f"{check.label}: {plural(check.states, 'state')} not compared with mjx.step and the C engine, which have "
        "MuJoCo's law; its own differences judge the derivatives"
        for check in checks
        if check.stock_step is None
    ]


def unoffered(host: mujoco.MjModel) -> list[str]:
    """Features of the model that a step's derivative does not cover."""
    features = [(host.nsensor, "sensor", "not computed by a step"), (host.nmocap, "mocap pose", "no input of a step")]
    return [f"{plural(count, noun)}: {why}, so without a derivative" for count, noun, why in features if count]
