"""Are the derivatives right? Automatic differentiation against central differences, the C engine and a closed form.

A mismatch is not yet a wrong derivative: where the cost has a kink or a jump at theta, its two one-sided differences
disagree, and no derivative can match both. The report tells the two apart.
"""

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_study.contact import ContactModel, apply_contact
from mjx_study.dynamics import State, step_jacobian
from mjx_study.objective import rollout_cost
from mjx_study.reference import value_and_gradient
from mjx_study.runtime import environment
from mjx_study.study import Cell, Progress, plan_cells
from mjx_study.table import format_table
from mjx_study.task import Task

STIFFNESS: Final = (10.0, 100.0, 1000.0)
CONTACT: Final = ("penalty", "mujoco", "mujoco_default")
STEP_SIZES: Final = tuple(10.0**-exponent for exponent in range(3, 10))
DIRECTIONS: Final = 6
STATES: Final = 12

FORWARD_TOLERANCE: Final = 1e-10
DIFFERENCE_TOLERANCE: Final = 1e-6
ENGINE_TOLERANCE: Final = 1e-5
ENGINE_KINK: Final = 1e-3
CLOSED_FORM_TOLERANCE: Final = 1e-3
RESIDUAL_TOLERANCE: Final = 1e-6

_READING: Final = """\
All figures are relative. The gradient of the whole cost in reverse mode is compared with forward mode, with central
differences at the best of several step sizes, and with a hand-derived closed form; a step's Jacobian with that of the
C engine. one-sided: by how much forward and backward differences disagree, 0 where the cost is smooth.
"""
_KINK: Final = """\
kink: one-sided differences disagree at every step size. Contacts that make or break, and the jump of MuJoCo's force at
their onset, leave no derivative to compare with at this theta.
"""


@dataclasses.dataclass(frozen=True)
class Finding:
    """The checks of one contact model; every figure is relative, and None where a check does not apply.

    Attributes:
        contact: family.
        stiffness: K [N/m].
        gradient_norm: of the whole cost's gradient at theta, in cost per unit of theta.
        forward: reverse mode against forward mode.
        difference: reverse mode against central differences at the best step size.
        one_sided: how far the two one-sided differences disagree at that step size.
        engine: a step's Jacobian against the C engine's, the worst of several states along the rollout.
        closed_form: against the reference system's hand-derived gradient.
        residual: largest relative solver residual of the rollout.
        verdict: `right`, `kink` (the cost has no derivative here to compare with), `unconverged` or `wrong`.
    """

    contact: str
    stiffness: float
    gradient_norm: float
    forward: float
    difference: float
    one_sided: float
    engine: float | None
    closed_form: float | None
    residual: float
    verdict: str


@dataclasses.dataclass(frozen=True)
class GradcheckReport:
    """All findings, with what they depended on."""

    task: str
    environment: dict[str, Any]
    findings: tuple[Finding, ...]
    warnings: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether nothing is wrong or unconverged; a kink is a property of the cost, not an error."""
        return all(finding.verdict in ("right", "kink") for finding in self.findings)

    def as_json(self) -> dict[str, Any]:
        """The report as plain data."""
        findings = [dataclasses.asdict(finding) for finding in self.findings]
        for row in findings:
            for name, value in row.items():
                row[name] = None if isinstance(value, float) and not math.isfinite(value) else value
        return dataclasses.asdict(self) | {"findings": findings, "passed": self.passed}

    def lines(self) -> list[str]:
        """The report as text."""
        header = ["contact", "K [N/m]", "|gradient|", "forward mode", "differences", "one-sided", "C engine"]
        header += ["closed form", "residual", "verdict"]
        rows = []
        for found in self.findings:
            figures = (
                found.forward,
                found.difference,
                found.one_sided,
                found.engine,
                found.closed_form,
                found.residual,
            )
            cells = ["-" if value is None else f"{value:.1e}" for value in figures]
            rows.append([found.contact, f"{found.stiffness:g}", f"{found.gradient_norm:.4g}", *cells, found.verdict])
        table = format_table(rows, header)
        notes = _READING
        if any(found.verdict == "kink" for found in self.findings):
            notes += _KINK
        verdict = "all derivatives that exist are right" if self.passed else "SOMETHING IS WRONG: see the verdicts"
        warned = [f"warning: {text}" for text in self.warnings]
        return [f"{self.task}: derivatives", "", *table, "", *notes.splitlines(), verdict, *warned]


@dataclasses.dataclass(frozen=True)
class GradcheckPlan:
    """What to check, itself checked."""

    task: Task
    cells: tuple[Cell, ...]
    warnings: tuple[str, ...]
    seed: int


def plan_gradcheck(task: Task, families: Sequence[str], stiffnesses: Sequence[float], *, seed: int) -> GradcheckPlan:
    """Build and check the contact models.

    Raises:
        ValueError: a family or stiffness that cannot be used, a random start, or float32.
    """
    if task.random_start:
        raise ValueError(f"gradcheck needs a fixed start, and {task.name} draws one")
    if task.theta.dtype != jnp.float64:
        raise ValueError("gradcheck compares with differences and needs float64; leave --precision at its default")
    cells, messages = plan_cells(task, families, stiffnesses)
    if not cells:
        raise ValueError("no contact model to check: give at least one stiffness and one contact family")
    return GradcheckPlan(task, cells, messages, seed)


def gradcheck(plan: GradcheckPlan, progress: Progress = lambda done, total, what: None) -> GradcheckReport:
    """Check every contact model of a plan."""
    programs = _Programs(plan.task)
    total = len(plan.cells)
    findings = []
    for done, cell in enumerate(plan.cells):
        progress(done, total, f"{cell.family}, K = {cell.stiffness:g} N/m")
        findings.append(_check(plan, programs, cell))
    progress(total, total, "done")
    return GradcheckReport(plan.task.name, environment(), tuple(findings), plan.warnings)


class _Programs:
    """Noise-free cost of a task as compiled programs of theta and contact model."""

    def __init__(self, task: Task):
        self.task = task

        def cost(theta: Float[Array, " params"], contact: ContactModel):
            silent = jnp.zeros((task.horizon, task.scene.host.nu), theta.dtype)
            return rollout_cost(task, theta, contact, task.draw_start(jax.random.key(0)), silent)

        def slope(theta, direction, contact):
            return jax.jvp(lambda x: cost(x, contact)[0], (theta,), (direction,))[1]

        def jacobian(state: State, control, contact):
            model = apply_contact(task.scene.model, contact)
            return step_jacobian(task.scene, model, state.qpos, state.qvel, state.act, control, state.warmstart)[0]

        self.costs = jax.jit(jax.vmap(lambda theta, contact: cost(theta, contact)[0], in_axes=(0, None)))
        self.gradient = jax.jit(jax.grad(cost, has_aux=True))
        self.slopes = jax.jit(jax.vmap(slope, in_axes=(None, 0, None)))
        self.jacobians = jax.jit(jax.vmap(jacobian, in_axes=(0, 0, None)))

    def batch(self, seed: int) -> Float[np.ndarray, "directions params"]:
        """Unit directions to look along."""
        directions = np.random.default_rng(seed).normal(size=(DIRECTIONS, len(self.task.theta)))
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _check(plan: GradcheckPlan, programs: _Programs, cell: Cell) -> Finding:
    theta = np.asarray(plan.task.theta)
    gradient, (states, controls, residual) = programs.gradient(theta, cell.contact)
    gradient, norm = np.asarray(gradient), float(np.linalg.norm(gradient))
    directions = programs.batch(plan.seed)
    slopes = np.asarray(programs.slopes(theta, directions, cell.contact))
    forward = float(np.max(np.abs(slopes - directions @ gradient)) / norm)
    difference, one_sided = _differences(programs, cell, directions, slopes, norm)
    engine = _against_engine(plan.task, programs, cell, states, controls)
    closed_form = _against_closed_form(plan.task, cell, gradient)
    verdict = _verdict(forward, difference, one_sided, engine, closed_form, float(residual))
    return Finding(
        cell.family,
        cell.stiffness,
        norm,
        forward,
        difference,
        one_sided,
        engine,
        closed_form,
        float(residual),
        verdict,
    )


def _differences(
    programs: _Programs,
    cell: Cell,
    directions: Float[np.ndarray, "directions params"],
    slopes: Float[np.ndarray, " directions"],
    norm: float,
) -> tuple[float, float]:
    """Relative error of central differences, each direction at its best step size, and the one-sided gap there."""
    theta = np.asarray(programs.task.theta)
    sizes = np.array(STEP_SIZES)
    moves = (sizes[:, None, None] * directions).reshape(-1, len(theta))
    costs = np.asarray(programs.costs(theta + np.concatenate([moves, -moves, np.zeros((1, len(theta)))]), cell.contact))
    shape = (len(sizes), len(directions))
    above, below, here = costs[: len(moves)].reshape(shape), costs[len(moves) : -1].reshape(shape), costs[-1]
    central = (above - below) / (2 * sizes[:, None])
    gap = np.abs(above - 2 * here + below) / sizes[:, None] / norm
    error = np.abs(central - slopes) / norm
    best = np.argmin(error, axis=0)
    columns = np.arange(len(directions))
    worst = int(np.argmax(error[best, columns]))
    # The gap shrinks with the step where the cost is smooth; a kink keeps it. Take the smallest over the steps.
    return float(error[best[worst], worst]), float(np.min(gap[:, worst]))


def _against_engine(task: Task, programs: _Programs, cell: Cell, states: State, controls: Array) -> float | None:
    """The worst relative difference of a step's Jacobian to the C engine's centred differences.

    States at a kink, where the engine's forward and centred differences disagree, are left out.
    """
    host = copy.copy(task.scene.host)
    if host.nq != host.nv or task.horizon < 3:
        return None
    apply_to_host(host, cell.contact)
    chosen = np.unique(np.linspace(1, task.horizon - 2, STATES).astype(int))
    picked = jax.tree.map(lambda leaf: leaf[chosen], states)
    # A state's `warmstart` is the acceleration of the step before; the next state holds this step's.
    solved = dataclasses.replace(picked, warmstart=states.warmstart[chosen + 1])
    ours = np.asarray(programs.jacobians(solved, controls[chosen], cell.contact))
    worst = 0.0
    for index, row in enumerate(ours):
        data = mujoco.MjData(host)
        data.qpos[:], data.qvel[:], data.act[:] = picked.qpos[index], picked.qvel[index], picked.act[index]
        data.ctrl[:], data.qacc_warmstart[:] = controls[chosen[index]], picked.warmstart[index]
        central, forward = (_engine_jacobian(host, data, centred=centred) for centred in (True, False))
        norm = np.linalg.norm(central)
        if np.linalg.norm(forward - central) <= ENGINE_KINK * norm:
            worst = max(worst, float(np.linalg.norm(row - central) / norm))
    return worst


def _engine_jacobian(host: mujoco.MjModel, data: mujoco.MjData, *, centred: bool) -> Float[np.ndarray, "nv_na inputs"]:
    """Derivatives of (qvel', act') by the C engine's differences, columns (qpos, qvel, act, ctrl)."""
    size = 2 * host.nv + host.na
    over_state, over_control = np.zeros((size, size)), np.zeros((size, host.nu))
    mujoco.mjd_transitionFD(host, data, 1e-7, centred, over_state, over_control, None, None)
    return np.concatenate([over_state, over_control], axis=1)[host.nv :]


def apply_to_host(host: mujoco.MjModel, contact: ContactModel) -> None:
    """Set every geom and pair of a host model to a contact model, in place, as `apply_contact` does on the device."""
    for leaf in (host.geom_solref, host.pair_solref):
        leaf[:] = np.asarray(contact.solref)
    for leaf in (host.geom_solimp, host.pair_solimp):
        leaf[:] = np.asarray(contact.solimp)
    if contact.friction is not None:
        friction = np.asarray(contact.friction)
        host.geom_friction[:] = friction
        host.pair_friction[:] = friction[[0, 0, 1, 2, 2]]
    if contact.margin is not None:
        host.geom_margin[:] = float(contact.margin)
        host.pair_margin[:] = float(contact.margin)


def _against_closed_form(task: Task, cell: Cell, gradient: Float[np.ndarray, " params"]) -> float | None:
    if task.reference is None or cell.family != "penalty":
        return None
    reference = task.reference(cell.stiffness)
    controls = np.asarray(task.theta).reshape(reference.horizon, -1)
    exact = value_and_gradient(reference.system, np.array(reference.start), controls)[1].reshape(-1)
    return float(np.linalg.norm(gradient - exact) / np.linalg.norm(exact))


def _verdict(
    forward: float,
    difference: float,
    one_sided: float,
    engine: float | None,
    closed_form: float | None,
    residual: float,
) -> str:
    if not residual <= RESIDUAL_TOLERANCE:
        return "unconverged"
    exact = forward <= FORWARD_TOLERANCE and (engine is None or engine <= ENGINE_TOLERANCE)
    smooth = difference <= DIFFERENCE_TOLERANCE
    if exact and smooth and (closed_form is None or closed_form <= CLOSED_FORM_TOLERANCE):
        return "right"
    if exact and not smooth and one_sided > DIFFERENCE_TOLERANCE:
        return "kink"
    return "wrong"
