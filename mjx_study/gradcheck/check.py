"""The check itself: every contact model, every state, every derivative; and what is to be checked, itself checked."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_study.configuration import Cell, Progress, plan_cells
from mjx_study.contact import FAMILIES, ContactModel, apply_contact
from mjx_study.dynamics import initial_state
from mjx_study.engine import HostState, converged_host, transition_jacobian
from mjx_study.gradcheck import diagnosis
from mjx_study.gradcheck.causes import SINGULAR, Place, cause_of_fault, cause_of_kink, degenerate_contact, singular
from mjx_study.gradcheck.coordinates import Coordinates, coordinates
from mjx_study.gradcheck.cost import CostCheck, CostPrograms, check_cost
from mjx_study.gradcheck.diagnosis import Judged, judge, modes_apart, worst_verdict
from mjx_study.gradcheck.differences import Differences, differences, moves
from mjx_study.gradcheck.placement import compare_engines
from mjx_study.gradcheck.programs import Linear, Programs, Setting
from mjx_study.gradcheck.report import Entry, Finding, GradcheckReport, StepCheck
from mjx_study.gradcheck.rounding import solution_noise
from mjx_study.gradcheck.states import Sample, choose, reached, sample_states
from mjx_study.policy import OpenLoop
from mjx_study.runtime import environment
from mjx_study.scene import Scene
from mjx_study.task import Task

STIFFNESS: Final = (10.0, 100.0, 1000.0)
CONTACT: Final = ("penalty", "mujoco", "mujoco_default")
STATES: Final = 4
HORIZON: Final = 200
"""Steps of the rollout that a file's states are taken from."""


@dataclasses.dataclass(frozen=True, eq=False)
class GradcheckPlan:
    """What to check, itself checked.

    Attributes:
        subject: the task; for a file one that has neither cost nor policy.
        is_task: whether its cost is to be checked.
        cells: contact models.
        warnings: about them.
        states: per contact model.
        seed: of starts, states and directions.
        stock: whether the derivative of `mjx.step` is checked too.
    """

    subject: Task
    is_task: bool
    cells: tuple[Cell, ...]
    warnings: tuple[str, ...]
    states: int
    seed: int
    stock: bool


def plan_gradcheck(
    task: Task,
    families: Sequence[str] | None,
    stiffnesses: Sequence[float] | None,
    *,
    seed: int,
    damping: float | None = None,
    states: int = STATES,
    stock: bool = False,
) -> GradcheckPlan:
    """Check a task's gradient, and steps along its rollout.

    Args:
        task: the task.
        families: contact families; None for the task's own where it has no contact, else for `CONTACT`.
        stiffnesses: for families that take one [N/m]; None for `STIFFNESS`, or the task's where those lie elsewhere.
        seed: of starts, states and directions.
        damping: in place of each family's [N s/m].
        states: per contact model.
        stock: whether the derivative of `mjx.step` is checked too.

    Raises:
        ValueError: a family or stiffness that cannot be used, too few states, or float32.
    """
    _check(task, states)
    if families is None:
        families = ("mjcf",) if task.contact_pair is None else CONTACT
    if stiffnesses is None:
        stiffnesses = STIFFNESS if min(STIFFNESS) <= max(task.stiffnesses, default=0.0) else task.stiffnesses
    cells, messages = plan_cells(task, families, stiffnesses, damping)
    if not cells:
        raise ValueError("no contact model to check: give at least one stiffness and one contact family")
    return GradcheckPlan(task, True, cells, messages, states, seed, stock)


def plan_scene_gradcheck(
    scene: Scene,
    families: Sequence[str] | None = None,
    stiffnesses: Sequence[float] | None = None,
    *,
    seed: int,
    pair: tuple[str, str] | None = None,
    damping: float | None = None,
    horizon: int = HORIZON,
    states: int = STATES,
    stock: bool = False,
) -> GradcheckPlan:
    """Check steps of any scene.

    Args:
        scene: the scene.
        families: contact families; None for `mjcf`, or for `mujoco` where a stiffness is given.
        stiffnesses: for families that take one [N/m].
        seed: of states.
        pair: names of the two geoms whose contact has this stiffness; every contact gets the same solref.
        damping: in place of each family's [N s/m].
        horizon: steps of the rollout that states are taken from.
        states: per contact model.
        stock: whether the derivative of `mjx.step` is checked too.

    Raises:
        ValueError: as `plan_gradcheck`, or a stiffness without a pair.
    """
    if families is None:
        families = ("mjcf",) if stiffnesses is None else ("mujoco",)
    swept = any(name in FAMILIES and FAMILIES[name].swept for name in families)
    if swept and stiffnesses is None:
        raise ValueError("a contact family with a stiffness needs one: give --stiffness in N/m, and --pair")
    if (swept or stiffnesses is not None) and pair is None:
        raise ValueError("a stiffness in N/m needs the mass that it acts on: give --pair GEOM,GEOM")
    subject = _bare_task(scene, pair, horizon)
    _check(subject, states)
    if pair is None and families != ("mjcf",):
        # single points of MuJoCo's parameters do not need the pair that a stiffness does
        moving = _any_pair(scene)
        subject = subject if moving is None else subject.replace(contact_pair=moving)
    cells, messages = plan_cells(subject, families, stiffnesses or (), damping)
    if pair is None:
        cells = tuple(dataclasses.replace(cell, stiffness=0.0) for cell in cells)
    return GradcheckPlan(subject, False, cells, messages, states, seed, stock)


def _bare_task(scene: Scene, pair: tuple[str, str] | None, horizon: int) -> Task:
    """A task that stands for a scene alone."""
    zero = jnp.zeros((), scene.template.qpos.dtype)
    policy = OpenLoop(horizon, scene.host.nu)
    return Task(
        name=scene.name,
        description="an MJCF",
        scene=scene,
        horizon=horizon,
        policy=policy,
        theta=jnp.zeros(policy.num_params, zero.dtype),
        sigma=1.0,
        start=initial_state(scene),
        running_cost=lambda state, control: zero,
        final_cost=lambda state: zero,
        contact_pair=pair,
        gamma=float("inf"),
    )


def _any_pair(scene: Scene) -> tuple[str, str] | None:
    host = scene.host
    named = [(mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_GEOM, geom), geom) for geom in range(host.ngeom)]
    named = [(name, geom) for name, geom in named if name]
    moving = [name for name, geom in named if host.body_invweight0[host.geom_bodyid[geom], 0] > 0]
    others = [name for name, _ in named if name != moving[0]] if moving else []
    return (moving[0], others[0]) if others else None


def _check(task: Task, states: int) -> None:
    if task.scene.template.qpos.dtype != jnp.float64:
        raise ValueError("gradcheck compares with differences and needs float64; leave --precision at its default")
    if task.scene.host.nv == 0:
        raise ValueError(f"{task.scene.name} has no degree of freedom: there is nothing to differentiate")
    if states < 1:
        raise ValueError(f"states must be at least 1, got {states}")


def gradcheck(plan: GradcheckPlan, progress: Progress = lambda done, total, what: None) -> GradcheckReport:
    """Run every check of a plan."""
    task = plan.subject
    costs = CostPrograms(task, plan.seed) if plan.is_task else None
    work = _Work(progress, len(plan.cells) * (plan.states + (costs is not None)))
    cost_checks: list[CostCheck] = []
    step_checks: list[StepCheck] = []
    findings: list[Finding] = []
    programs: Programs | None = None
    for cell in plan.cells:
        layout = coordinates(task.scene, cell.contact)
        programs = Programs(layout) if programs is None else programs
        setting = Setting(cell.contact, layout.scales)
        if costs is None:
            samples = sample_states(task.scene, cell.contact, plan.states, task.horizon, plan.seed)
        else:
            work.step(f"{cell.label}: gradient of the cost")
            cost, visited = check_cost(costs, cell, plan.seed)
            cost_checks.append(cost)
            samples = _along(task.scene, cell.contact, visited, plan.states)
        checked, found = _check_steps(plan, programs, setting, cell, samples, work)
        step_checks.append(checked)
        findings += found
    work.end()
    order = {name: rank for rank, name in enumerate((*reversed(diagnosis.VERDICTS), "placement"))}
    findings.sort(key=lambda finding: (not finding.fails, finding.who != "project", order[finding.verdict]))
    return GradcheckReport(
        subject=task.name,
        summary=_summary(plan),
        costs=tuple(cost_checks),
        steps=tuple(step_checks),
        findings=tuple(findings),
        warnings=plan.warnings,
        environment=environment(),
    )


class _Work:
    """Counts pieces of work."""

    def __init__(self, progress: Progress, total: int):
        self.progress, self.total, self.done = progress, total, 0

    def step(self, what: str) -> None:
        self.progress(min(self.done, self.total), self.total, what)
        self.done += 1

    def end(self) -> None:
        self.progress(self.total, self.total, "done")


def _summary(plan: GradcheckPlan) -> str:
    host = plan.subject.scene.host
    parts = [_count(host.nv, "degree", "of freedom")]
    parts += [_count(number, noun) for number, noun in ((host.na, "activation"), (host.nu, "control")) if number]
    taken = f"{_count(plan.states, 'state')} along {_count(plan.subject.horizon, 'step')} of {host.opt.timestep:g} s"
    return f"{', '.join(parts)}; {taken}"


def _count(number: int, noun: str, rest: str = "") -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}{rest and ' ' + rest}"


def _along(scene: Scene, contact: ContactModel | None, visited: list[HostState], count: int) -> list[Sample]:
    """States of a task's own rollout: its start, and others in contact."""
    chosen = choose([reached(scene, contact, state) for state in visited], count - 1)
    return [Sample("start", 0, visited[0]), *(Sample(f"step {index}", index, visited[index]) for index in chosen)]


@dataclasses.dataclass(frozen=True, eq=False)
class StateCheck:
    """All that was computed at one state.

    Attributes:
        sample: the state.
        linear: value and derivatives.
        truth: differences.
        judged: verdicts by mode: forward, reverse, tape, or mjx.step.
        modes: reverse against forward mode.
        engine_step: against the C engine's step.
        engine: against its Jacobian; None where the steps differ.
        placement: in words, what differs between the two.
        place: what causes are looked up in.
    """

    sample: Sample
    linear: Linear
    truth: Differences
    judged: dict[str, Judged]
    derivatives: dict[str, np.ndarray]
    modes: float
    engine_step: float
    engine: float | None
    placement: str
    place: Place


def check_state(programs: Programs, setting: Setting, sample: Sample, *, stock: bool = False) -> StateCheck:
    """Every comparison at one state.

    Args:
        programs: of the scene.
        setting: the contact model, and the units of its parameters.
        sample: the state.
        stock: whether to differentiate `mjx.step` too.
    """
    layout, contact = programs.layout, setting.contact
    linear = programs.linear(setting, sample.state)
    reference = jnp.asarray(linear.qpos)
    still = np.zeros((1, len(layout.inputs)))
    qacc = programs.values(setting, sample.state, reference, still)[2]
    solved = dataclasses.replace(sample.state, warmstart=qacc)
    stages = programs.stages(setting, sample.state)
    floor = solution_noise(layout, stages, qacc)
    truth = differences(programs.values(setting, solved, reference, moves(np.eye(len(layout.inputs))))[0], floor)
    converged = None if linear.residual <= 1e-10 else programs.linear(setting, solved).forward

    derivatives = {"forward": linear.forward, "reverse": linear.reverse}
    if linear.tape is not None:
        derivatives["tape"] = linear.tape
    model = apply_contact(layout.scene.model, contact)
    place = Place(layout, sample.state, stages, qacc, np.asarray(model.geom_solref), np.asarray(model.geom_solimp))
    known = {
        "starved": not linear.residual <= diagnosis.RESIDUAL_TOLERANCE,
        "degenerate": degenerate_contact(place) is not None,
    }
    judged = {mode: judge(layout, jacobian, truth, converged, **known) for mode, jacobian in derivatives.items()}
    if stock:
        derivatives["mjx.step"] = programs.stock(setting, sample.state)
        judged["mjx.step"] = judge(layout, derivatives["mjx.step"], truth, degenerate=known["degenerate"])
    apart = [modes_apart(layout, linear.forward, derivatives[mode]) for mode in ("reverse", "tape") if mode in judged]
    placement = compare_engines(layout.scene, contact, sample.state, stages, qacc)
    engine = None if placement.text else _engine_error(layout, contact, solved, truth, linear)
    return StateCheck(
        sample,
        linear,
        truth,
        judged,
        derivatives,
        max(apart),
        placement.step,
        engine,
        placement.text,
        place,
    )


def _engine_error(
    layout: Coordinates, contact: ContactModel | None, state: HostState, truth: Differences, linear: Linear
) -> float | None:
    """Worst relative difference to the C engine's Jacobian, where its own differences settle."""
    host = converged_host(layout.scene, contact)
    centred, forward = (transition_jacobian(host, state, centred=which, step=1e-6) for which in (True, False))
    columns = layout.columns("qpos", "qvel", "act", "ctrl")
    ours = linear.forward[:, columns]
    scale = diagnosis.row_scales(layout, linear.forward, truth)[:, columns]
    smooth = (np.abs(centred - forward) <= 1e-3 * scale) & ~truth.kink[:, columns] & ~truth.jump[:, columns]
    figures = np.where(smooth & np.isfinite(ours) & (scale > 1e-6), np.abs(ours - centred) / scale, 0.0)
    return float(figures.max(initial=0.0)) if smooth.any() else None


def _check_steps(
    plan: GradcheckPlan, programs: Programs, setting: Setting, cell: Cell, samples: list[Sample], work: _Work
) -> tuple[StepCheck, list[Finding]]:
    checks = []
    for sample in samples:
        work.step(f"{cell.label}: {sample.label}")
        checks.append(check_state(programs, setting, sample, stock=plan.stock))
    found = _collect(cell, programs.layout, checks)
    inputs, layout = len(programs.layout.inputs), programs.layout

    def worst(mode_names: Sequence[str], blocks: Sequence[str]) -> float:
        columns = layout.columns(*blocks)
        return max(
            (
                _error(layout, check, mode, columns)
                for check in checks
                for mode in mode_names
                if mode in check.derivatives and columns
            ),
            default=0.0,
        )

    state_blocks = [block for block in layout.blocks() if block != "contact"]
    modes = ("forward", "reverse", "tape")
    step = StepCheck(
        contact=cell.family,
        stiffness=cell.stiffness,
        states=len(checks),
        entries=len(checks) * inputs * len(layout.outputs),
        modes=max(check.modes for check in checks),
        differences=worst(modes, state_blocks),
        parameters=worst(modes, ["contact"]) if len(layout.scales) else None,
        engine_step=max(check.engine_step for check in checks),
        engine=max((check.engine for check in checks if check.engine is not None), default=None),
        stock=_stock_figure(checks, worst(["mjx.step"], layout.blocks())) if plan.stock else None,
        residual=max(check.linear.residual for check in checks),
        verdict=worst_verdict([f.verdict for f in found if f.who == "project" and f.verdict in diagnosis.VERDICTS]),
    )
    return step, found


def _error(layout: Coordinates, check: StateCheck, mode: str, columns: list[int]) -> float:
    """Worst relative error of entries that have a derivative and that differences resolve."""
    jacobian, truth = check.derivatives[mode], check.truth
    scale = diagnosis.row_scales(layout, jacobian, truth)
    codes = check.judged[mode].codes
    counted = ~np.isin(codes, (diagnosis.KINK, diagnosis.JUMP)) & (truth.uncertainty <= diagnosis.RESOLVED * scale)
    figures = np.where(counted, np.abs(jacobian - truth.value) / scale, 0.0)[:, columns]
    return float("inf") if np.isnan(figures).any() else float(figures.max(initial=0.0))


def _stock_figure(checks: list[StateCheck], worst: float) -> float:
    return float("inf") if any((c.judged["mjx.step"].codes == diagnosis.NAN).any() for c in checks) else worst


def _collect(cell: Cell, layout: Coordinates, checks: list[StateCheck]) -> list[Finding]:
    """Findings, equal ones together."""
    groups: dict[tuple[str, str, tuple[str, ...], str], list[Entry]] = {}
    timestep = layout.scene.timestep
    for check in checks:
        own = [mode for mode in check.judged if mode != "mjx.step"]
        for who, modes in (("project", own), ("mjx.step", [m for m in check.judged if m == "mjx.step"])):
            for row, column in _entries(check, modes):
                codes = {mode: int(check.judged[mode].codes[row, column]) for mode in modes}
                code = max(codes.values())
                shown = tuple(mode for mode in modes if codes[mode] == code)
                verdict = diagnosis.VERDICTS[code]
                if who != "project" and verdict in ("kink", "jump"):
                    continue  # of the step, and so already the project's
                output, source = layout.outputs[row], layout.inputs[column]
                if verdict in ("kink", "jump"):
                    cause = cause_of_kink(check.place, output, source)
                elif verdict == "unconverged":
                    cause = _budget(layout)
                else:
                    cause = cause_of_fault(check.place, output, source, stock=who == "mjx.step")
                entry = Entry(
                    check.sample.label,
                    check.sample.index,
                    check.sample.index * timestep,
                    f"d {output} / d {source}",
                    float(check.derivatives[shown[0]][row, column]),
                    float(check.truth.value[row, column]),
                    float(check.truth.gap[row, column]) if verdict in ("kink", "jump") else None,
                )
                groups.setdefault((who, verdict, shown, cause), []).append(entry)
        _add_states(groups, check, layout)
    return [Finding(cell.label, *key, tuple(entries)) for key, entries in groups.items()]


def _entries(check: StateCheck, modes: list[str]) -> list[tuple[int, int]]:
    if not modes:
        return []
    codes = np.max([check.judged[mode].codes for mode in modes], axis=0)
    return [(int(row), int(column)) for row, column in np.argwhere(codes != diagnosis.RIGHT)]


def _add_states(groups: dict[Any, list[Entry]], check: StateCheck, layout: Coordinates) -> None:
    """What concerns a state and not an entry."""

    def add(verdict: str, modes: tuple[str, ...], cause: str, value: float) -> None:
        sample = check.sample
        entry = Entry(sample.label, sample.index, sample.index * layout.scene.timestep, "", value, None)
        groups.setdefault(("project", verdict, modes, cause), []).append(entry)

    if not check.linear.residual <= diagnosis.RESIDUAL_TOLERANCE:
        add("unconverged", (), f"residual {check.linear.residual:.1e}; {_budget(layout)}", check.linear.residual)
    if not check.modes <= diagnosis.MODES_TOLERANCE:
        nearby = degenerate_contact(check.place)
        why = SINGULAR if singular(check.place) else nearby
        text = f"the two modes of differentiation disagree by {check.modes:.1e}"
        add("jump" if nearby else "wrong", (), f"{text}: {why}" if why else text, check.modes)
    if check.placement:
        add("placement", (), f"acceleration apart by {check.engine_step:.1e}: {check.placement}", check.engine_step)


def _budget(layout: Coordinates) -> str:
    option = layout.scene.host.opt
    return (
        f"the solver stopped early, with iterations={option.iterations} and ls_iterations={option.ls_iterations}; "
        "give more with --iterations and --ls-iterations"
    )
