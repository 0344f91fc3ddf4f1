"""Run the check: every contact model, every state, every derivative."""

import mujoco

from mjx_study.gradcheck.collect import collect, step_check
from mjx_study.gradcheck.compiling import Compiler
from mjx_study.gradcheck.coordinates import coordinates
from mjx_study.gradcheck.cost import CostCheck, CostPrograms, check_cost, judge_closed_forms
from mjx_study.gradcheck.engine_step import EngineStep
from mjx_study.gradcheck.finding import Finding, gravity
from mjx_study.gradcheck.plan import GradcheckPlan
from mjx_study.gradcheck.programs import Programs, Setting
from mjx_study.gradcheck.report import GradcheckReport, StepCheck
from mjx_study.gradcheck.state_check import check_state
from mjx_study.gradcheck.states import start_of, states_of
from mjx_study.runtime import environment
from mjx_study.simulation.engine import quiet_engine
from mjx_study.study.configuration import Progress


def gradcheck(plan: GradcheckPlan, progress: Progress = lambda done, total, what: None) -> GradcheckReport:
    with quiet_engine():  # intermediate states may cause warnings
        return _gradcheck(plan, progress)


def _gradcheck(plan: GradcheckPlan, progress: Progress) -> GradcheckReport:
    task, compiler = plan.subject, Compiler()
    work = _Work(progress, 1 + len(plan.cells) * (plan.states + plan.is_task))
    work.step("compiling")
    layouts = [coordinates(task.scene, cell.contact) for cell in plan.cells]
    programs = Programs(layouts[0], compiler)
    settings = [Setting(cell.contact, layout.scales) for cell, layout in zip(plan.cells, layouts, strict=True)]
    programs.start(settings[0], start_of(task.scene), stock=plan.stock)
    costs = CostPrograms(task, plan.seed, compiler) if plan.is_task else None
    if costs is not None:
        costs.compile(plan.cells[0].contact)
    cost_checks: list[CostCheck] = []
    step_checks: list[StepCheck] = []
    findings: list[Finding] = []
    for cell, layout, setting in zip(plan.cells, layouts, settings, strict=True):
        visited = None
        if costs is not None:
            work.step(f"{cell.label}: gradient of the cost")
            cost, visited = check_cost(costs, cell, plan.seed)
            cost_checks.append(cost)
        samples, coverage = states_of(task.scene, cell.contact, plan.states, task.horizon, plan.seed, visited)
        engine_step = EngineStep(layout, cell.contact)
        checks = []
        for sample in samples:
            work.step(f"{cell.label}: {sample.label}")
            checks.append(check_state(programs, engine_step, setting, sample, stock=plan.stock))
        found = collect(cell, programs.layout, checks)
        step_checks.append(step_check(cell, programs.layout, checks, found, coverage))
        findings += found
    work.end()
    findings += judge_closed_forms(cost_checks)
    return GradcheckReport(
        subject=task.name,
        summary=_summary(plan),
        costs=tuple(cost_checks),
        steps=tuple(step_checks),
        findings=tuple(sorted(findings, key=gravity)),
        warnings=(*plan.warnings, *unoffered(task.scene.host)),
        environment=environment(),
    )


class _Work:
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


def unoffered(host: mujoco.MjModel) -> list[str]:
    """Features of the model that a step's derivative does not cover."""
    notes = []
    if host.nsensor:
        notes.append(f"{_count(host.nsensor, 'sensor')}: not computed by a step, so without a derivative")
    if host.nmocap:
        notes.append(f"{_count(host.nmocap, 'mocap pose')}: not an input of a step, so without a derivative")
    return notes


def _count(number: int, noun: str, rest: str = "") -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}{rest and ' ' + rest}"
