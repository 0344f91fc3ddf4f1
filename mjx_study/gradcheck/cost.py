"""Check the gradient of a task's total cost: reverse against forward mode, finite differences, and a closed form."""

from collections.abc import Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from estimators.noise import split_sample_key
from mjx_study.gradcheck.diagnosis import worst_verdict
from mjx_study.gradcheck.differences import moves, take_differences
from mjx_study.gradcheck.programs import Compiler, compiled
from mjx_study.gradcheck.report import WHOLE, CostCheck, Entry, Finding
from mjx_study.objective import rollout_cost
from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.engine import HostState
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Task

DIRECTIONS: Final = 6
BATCH: Final = 8  # rollouts per call of the cost program
DIFFERENCE_TOLERANCE: Final = 1e-6
MODES_TOLERANCE: Final = 1e-9
CLOSED_FORM_TOLERANCE: Final = 1e-3  # relative distance from the closed form's gradient that counts as agreement
MAX_GROWTH: Final = 2.0  # allowed growth of the distance with stiffness, which should bring the two models together


class CostPrograms:
    """Zero-noise cost of a task from an initial state drawn by a key, compiled for any theta and contact model."""

    def __init__(self, task: Task, seed: int, compiler: Compiler):
        self.task, self.compiler = task, compiler
        self.key = jax.random.key(seed)
        self.start = task.draw_start(split_sample_key(jax.random.clone(self.key))[0])
        self._both_modes = compiled("derivatives of the cost", self._in_both_modes, task, seed)
        self._many = compiled("costs", self._costs_at, task, seed)

    def compile(self, contact: ContactModel | None) -> None:
        self.compiler.start(self._both_modes, self.task.theta, contact, np.zeros((DIRECTIONS, len(self.task.theta))))
        self.compiler.start(self._many, np.zeros((BATCH, len(self.task.theta))), contact)

    def gradient(self, contact: ContactModel | None, directions: np.ndarray) -> Any:
        """Return (states, controls, residual), the reverse-mode gradient, and forward-mode slopes along directions."""
        return self.compiler.run(self._both_modes, self.task.theta, contact, directions)

    def costs(self, contact: ContactModel | None, changes: np.ndarray) -> np.ndarray:
        thetas = np.asarray(self.task.theta) + np.pad(changes, ((0, -len(changes) % BATCH), (0, 0)))
        parts = thetas.reshape(-1, BATCH, thetas.shape[1])
        chunks = [self.compiler.run(self._many, part, contact) for part in parts]
        return np.concatenate(chunks)[: len(changes)]

    def _in_both_modes(self, theta, contact, directions):
        value, push, rollout = jax.linearize(lambda x: self._cost(x, contact), theta, has_aux=True)
        (gradient,) = jax.linear_transpose(push, theta)(jnp.ones_like(value))
        return rollout, gradient, jax.lax.map(push, directions)

    def _costs_at(self, thetas, contact):
        return jax.vmap(lambda theta: self._cost(theta, contact)[0])(thetas)

    def _cost(self, theta, contact):
        zero_noise = jnp.zeros(self.task.policy.noise_shape, theta.dtype)
        return rollout_cost(self.task, theta, contact, self.start, zero_noise)


def check_cost(programs: CostPrograms, cell: ContactPoint, seed: int) -> tuple[CostCheck, list[HostState]]:
    """Check one contact model's gradient; also return the states of its rollout with their controls."""
    task = programs.task
    directions = np.random.default_rng(seed).normal(size=(DIRECTIONS, len(task.theta)))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    (states, controls, residual, _), gradient, slopes = programs.gradient(cell.contact, directions)
    gradient = np.asarray(gradient)
    norm = float(np.linalg.norm(gradient))
    scale = norm if norm > 0 else 1.0
    modes = float(np.max(np.abs(slopes - directions @ gradient))) / scale
    truth = take_differences(programs.costs(cell.contact, moves(directions))[:, None])
    error = np.abs(directions @ gradient - truth.value[0])
    apart = ~(error <= DIFFERENCE_TOLERANCE * scale + 3 * truth.uncertainty[0])  # True where NaN
    kinks = truth.kink[0] & (error <= truth.gap[0])
    excuses = np.select([np.isnan(error), truth.jump[0], kinks], ["unresolved", "jump", "kink"], "")[apart].tolist()
    finite = bool(np.all(np.isfinite(gradient)))
    verdict = cost_verdict(finite=finite, modes=modes, residual=float(residual), excuses=excuses)
    closed_form = _against_closed_form(task, cell, gradient, jax.random.clone(programs.key))
    errors = (modes, float(error.max() / scale), float(truth.gap.max() / scale), closed_form, float(residual))
    check = CostCheck(cell.family, cell.stiffness_or_zero, norm, *errors, verdict)
    fields = (states.qpos, states.qvel, states.act, controls, states.warmstart)
    return check, [HostState(*row) for row in zip(*map(np.asarray, fields), strict=False)]  # one state more


def judge_closed_forms(checks: Sequence[CostCheck]) -> list[Finding]:
    """Report distances from the closed form that grow as the contact stiffens; they may be large."""
    known = sorted((each.stiffness, each.closed_form, each.contact) for each in checks if each.closed_form is not None)
    findings = []
    for stiffness, distance, contact in known:
        softest, nearest, _ = known[0]
        grows = distance > max(CLOSED_FORM_TOLERANCE, MAX_GROWTH * nearest)
        if not distance <= CLOSED_FORM_TOLERANCE:
            text = f"the gradient is {distance:.1e} of its norm from the closed form's"
            text += f", farther than at {softest:g} N/m ({nearest:.1e})" if grows else ""
            entry = Entry(WHOLE, 0, 0.0, "", distance, None)
            label = f"{contact}, K = {stiffness:g} N/m"
            findings.append(Finding(label, "project", "wrong" if grows else "apart", (), text, (entry,)))
    return findings


def cost_verdict(*, finite: bool, modes: float, residual: float, excuses: Sequence[str]) -> str:
    """Return the verdict on a gradient, from the excuse for each direction in which it is off, empty for none."""
    if not finite:
        return "nan"
    if not residual <= DIFFERENCE_TOLERANCE:
        return "unconverged"
    if not modes <= MODES_TOLERANCE or "" in excuses:
        return "wrong"
    return worst_verdict(excuses)


def _against_closed_form(task: Task, cell: ContactPoint, gradient: np.ndarray, key: Any) -> float | None:
    if task.reference is None or cell.family != "penalty":
        return None
    exact = np.asarray(task.reference(cell.stiffness_or_zero).value_and_gradient(task.theta, key)[1])
    size = float(np.linalg.norm(exact))
    return float(np.linalg.norm(gradient - exact)) / (size if size > 0 else 1.0)
