"""Check the gradient of a task's total cost: reverse against forward mode, finite differences, and a closed form."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from mjx_study.gradcheck.compiling import Compiler
from mjx_study.gradcheck.differences import differences, moves
from mjx_study.gradcheck.finding import Entry, Finding
from mjx_study.objective import rollout_cost
from mjx_study.reference.noise import split_sample_key
from mjx_study.simulation.contact import ContactModel
from mjx_study.simulation.engine import HostState
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Task

DIRECTIONS: Final = 6
BATCH: Final = 8
"""Rollouts per call of the cost program."""
DIFFERENCE_TOLERANCE: Final = 1e-6
MODES_TOLERANCE: Final = 1e-9
CLOSED_FORM: Final = 1e-3
"""Relative distance from the closed form's gradient that counts as agreement."""
GROWTH: Final = 2.0
"""Allowed growth of the distance with stiffness, which should bring the two models together."""


@dataclasses.dataclass(frozen=True)
class CostCheck:
    """Checks of one contact model's whole-horizon gradient; errors are relative to its norm.

    Attributes:
        stiffness: K [N/m].
        gradient_norm: norm of the gradient, in cost per unit of theta.
        modes: difference between reverse and forward mode along some directions.
        difference: difference from central differences along the same directions.
        one_sided: disagreement of the two one-sided differences at the smallest step.
        closed_form: distance from the hand-written gradient of the reference system, a different model of the same
            system; measures the distance between the models. None without a reference.
        residual: largest relative solver residual of the rollout.
        verdict: right, kink, jump, unconverged, nan or wrong.
    """

    contact: str
    stiffness: float
    gradient_norm: float
    modes: float
    difference: float
    one_sided: float
    closed_form: float | None
    residual: float
    verdict: str


class CostPrograms:
    """Zero-noise cost of a task from an initial state drawn by a key, compiled for any theta and contact model."""

    def __init__(self, task: Task, seed: int, compiler: Compiler):
        self.task = task
        self.compiler = compiler
        self.key = jax.random.key(seed)
        self.start = task.draw_start(split_sample_key(jax.random.clone(self.key))[0])

    def compile(self, contact: ContactModel | None) -> None:
        """Start compiling the programs of the methods below."""
        self.compiler.start(self._both_modes, self.task.theta, contact, np.zeros((DIRECTIONS, len(self.task.theta))))
        self.compiler.start(self._many, np.zeros((BATCH, len(self.task.theta))), contact)

    def gradient(self, contact: ContactModel | None, directions: np.ndarray) -> Any:
        """Return (states, controls, residual), the reverse-mode gradient, and forward-mode slopes along directions."""
        return self.compiler.run(self._both_modes, self.task.theta, contact, directions)

    def costs(self, contact: ContactModel | None, changes: np.ndarray) -> np.ndarray:
        theta = np.asarray(self.task.theta)
        rows = -(-len(changes) // BATCH) * BATCH
        thetas = np.broadcast_to(theta, (rows, len(theta))).copy()
        thetas[: len(changes)] += changes
        chunks = [self.compiler.run(self._many, part, contact) for part in thetas.reshape(-1, BATCH, len(theta))]
        return np.concatenate(chunks)[: len(changes)]

    def _both_modes(self, theta, contact, directions):
        value, push, rollout = jax.linearize(lambda x: self._cost(x, contact), theta, has_aux=True)
        (gradient,) = jax.linear_transpose(push, theta)(jnp.ones_like(value))
        return rollout, gradient, jax.lax.map(push, directions)

    def _many(self, thetas, contact):
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
    truth = differences(programs.costs(cell.contact, moves(directions))[:, None])
    error = np.abs(directions @ gradient - truth.value[0])
    closed_form = _against_closed_form(task, cell, gradient, jax.random.clone(programs.key))
    apart = error > DIFFERENCE_TOLERANCE * scale + 3 * truth.uncertainty[0]
    verdict = cost_verdict(
        finite=bool(np.all(np.isfinite(gradient))),
        modes=modes,
        residual=float(residual),
        excused=[
            "jump" if jump else "kink" if kink and miss <= gap else None
            for far, jump, kink, miss, gap in zip(apart, truth.jump[0], truth.kink[0], error, truth.gap[0], strict=True)
            if far
        ],
    )
    check = CostCheck(
        cell.family,
        cell.stiffness,
        norm,
        modes,
        float(error.max() / scale),
        float(truth.gap.max() / scale),
        closed_form,
        float(residual),
        verdict,
    )
    return check, _host_states(states, controls)


def judge_closed_forms(checks: Sequence[CostCheck]) -> list[Finding]:
    """Report distances from the closed form that grow as the contact stiffens; they may be large."""
    known = sorted(
        (check.stiffness, check.closed_form, check.contact) for check in checks if check.closed_form is not None
    )
    findings = []
    for stiffness, distance, contact in known:
        softest, nearest = known[0][0], known[0][1]
        grows = distance > max(CLOSED_FORM, GROWTH * nearest)
        if not distance <= CLOSED_FORM:
            text = f"the gradient is {distance:.1e} of its norm from the closed form's"
            text += f", farther than at {softest:g} N/m ({nearest:.1e})" if grows else ""
            entry = Entry("the whole rollout", 0, 0.0, "", distance, None)
            label = f"{contact}, K = {stiffness:g} N/m"
            findings.append(Finding(label, "project", "wrong" if grows else "apart", (), text, (entry,)))
    return findings


def cost_verdict(*, finite: bool, modes: float, residual: float, excused: list[str | None]) -> str:
    """Return the verdict on a gradient.

    Args:
        excused: kink or jump for each direction in which differences disagree, or None if nothing excuses it.
    """
    if not finite:
        return "nan"
    if not residual <= DIFFERENCE_TOLERANCE:
        return "unconverged"
    if not modes <= MODES_TOLERANCE or None in excused:
        return "wrong"
    return max((name for name in excused if name), key=("kink", "jump").index, default="right")


def _against_closed_form(task: Task, cell: ContactPoint, gradient: np.ndarray, key: Any) -> float | None:
    if task.reference is None or cell.family != "penalty":
        return None
    exact = np.asarray(task.reference(cell.stiffness).value_and_gradient(task.theta, key)[1])
    size = float(np.linalg.norm(exact))
    return float(np.linalg.norm(gradient - exact)) / (size if size > 0 else 1.0)


def _host_states(states: Any, controls: Any) -> list[HostState]:
    qpos, qvel, act, warmstart = map(np.asarray, (states.qpos, states.qvel, states.act, states.warmstart))
    controls = np.asarray(controls)
    return [HostState(qpos[i], qvel[i], act[i], controls[i], warmstart[i]) for i in range(len(controls))]
