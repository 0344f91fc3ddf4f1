"""Check an estimator's mean by its integral along a path, compared with the difference of the mean cost.

The mean of first-order gradients can be wrong even if the derivative of every step is right, which no check of single
steps reveals.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from types import MappingProxyType
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from estimators import Estimator, GradientEstimate, Objective, oracles_of
from estimators.mean_check import NODES, Circulation, circulations
from estimators.registry import find_estimator, label_of
from mjx_study.diagnose.columns import MEANS
from mjx_study.experiment.resolution import CORRECTED, check_estimators, direction_of, reads_onset
from mjx_study.experiment.sampling import Objectives, cell_keys, draw_batches
from mjx_study.experiment.study import StudyPlan, estimators_of
from mjx_study.objective import Simulator, chunk_for
from mjx_study.options.option import check_span
from mjx_study.progress import Progress, silent
from mjx_study.runtime import local_devices
from mjx_study.table import Column, as_plain, percent, tabulate
from mjx_study.tasks.contact_grid import ContactPoint
from mjx_study.tasks.task import Task

HALF_LENGTH: Final = 2.0  # length of the path to either side of theta, in standard deviations of noise on theta
FEEDBACK: Final = 0.02  # the same for noise on the controls, in the unit of theta
ALONG_MEANS: Final = "means"  # value of `direction` for paths along the estimators' means, see `along_means`
MAX_PATHS: Final = 3
UNRESOLVED: Final = 10.0  # uncertainty of a difference, in slopes, above which its size is not told
MIN_SHARE: Final = 1e-3  # smallest share of a mean orthogonal to the others that warrants a path along it

Nodes = Callable[[int, int], None]
"""Called before each node of the paths with the number of nodes done, and of all."""


@dataclasses.dataclass(frozen=True)
class MeanCheck:
    """Check of one estimator's mean for one contact model; made by `check_mean`.

    The stiffness [N/m] is 0 for a contact model not defined by one; the verdict is "right", "biased" or "undecided".
    """

    contact: str
    stiffness: float
    estimator: str
    circulation: Circulation
    verdict: str

    def as_dict(self) -> dict[str, Any]:
        """Return plain data, including the gap and its 99.9 % interval as shares of the difference."""
        numbers = {name: float(value) for name, value in vars(self.circulation).items()}
        scale = abs(numbers["difference"]) or math.nan
        numbers |= {"half_width": float(self.circulation.half_width), "relative_gap": numbers["gap"] / scale}
        numbers |= {"detectable": 2 * numbers["half_width"] / scale}
        named = {"contact": self.contact, "stiffness": self.stiffness, "estimator": self.estimator}
        return as_plain(named | numbers | {"verdict": self.verdict})


def reach_of(task: Task) -> float:
    """Default half length of a path through a task's theta [unit of theta]."""
    return HALF_LENGTH * task.sigma if task.policy.additive else FEEDBACK


def path_of(task: Task, span: Sequence[float] | None, direction: str) -> str:
    """Describe the path, or paths, along which means are checked."""
    low, high = span or (-reach_of(task), reach_of(task))
    unit = getattr(task.policy, "unit", "")
    through = f"theta = {float(task.theta[0]):g}" if task.policy.num_params == 1 else f"theta, direction {direction}"
    return f"path: {low:.3g} to {high:.3g}{f' {unit}' if unit else ''} about {through}"


def along_means(
    estimators: Sequence[Estimator],
    objective: Objective,
    theta: Float[Array, " params"],
    reach: float,
    estimates: Sequence[GradientEstimate],
    samples: int,
    seed: int,
    progress: Nodes = lambda done, total: None,
) -> list[list[Circulation]]:
    """Check means along up to three orthogonal paths, which share the samples; results by path and estimator.

    The first path follows the most precise estimate, the others the orthogonal parts of the next ones: only there does
    a bias orthogonal to the gradient show. Their differences of the mean cost are replaced by the first path's, so that
    all gaps are shares of the gradient. Progress is reported in nodes.
    """
    paths = [reach * jnp.asarray(unit, theta.dtype) for unit in _at_right_angles(estimates)]
    each = max(2, samples // len(paths))
    found = []
    for done, along in enumerate(paths):
        report = lambda node, before=NODES * done: progress(before + node, NODES * len(paths))  # noqa: E731
        ends = theta - along, theta + along
        found.append(circulations(estimators, objective, *ends, jax.random.key(seed), each, progress=report))
    return [
        [dataclasses.replace(one, difference=first.difference) for one, first in zip(path, found[0], strict=True)]
        for path in found
    ]


def in_nodes(progress: Progress, done: int, total: int, what: str) -> Nodes:
    """Report nodes within one of several pieces of work."""
    return lambda node, nodes: progress(done, total, f"{what}; means along paths, node {node + 1} of {nodes}")


def _at_right_angles(estimates: Sequence[GradientEstimate]) -> list[np.ndarray]:
    """Orthonormal vectors that span the means, the most precise first, without negligible parts."""
    units: list[np.ndarray] = []
    for estimate in sorted(estimates, key=lambda each: float(each.variance / jnp.sum(each.mean**2))):
        left = mean = np.asarray(estimate.mean, float)
        for unit in units:
            left = left - (left @ unit) * unit
        size = float(np.linalg.norm(left))
        if len(units) < MAX_PATHS and size > MIN_SHARE * float(np.linalg.norm(mean)):
            units.append(left / size)
    return units or [np.eye(len(np.asarray(estimates[0].mean)))[0]]


def unmixed(estimators: Sequence[Estimator], batches: dict[str, Any]) -> list[GradientEstimate]:
    """Compute the estimates that use a single batch, without interpolation; by default all."""
    single = [estimator for estimator in estimators if len(estimator.needs) == 1]
    return [estimator(batches) for estimator in single or estimators]


def check_mean(
    task: Task,
    cells: Sequence[ContactPoint],
    estimators: Sequence[Estimator],
    *,
    samples: int,
    seed: int,
    names: Sequence[str] = (),
    span: Sequence[float] | None = None,
    direction: str = "random",
    progress: Progress = silent,
) -> list[MeanCheck]:
    """Check every estimator for every contact model.

    Args:
        task: task with the theta that the path passes through, and its onset treatment.
        estimators: estimators with their options; they share the samples.
        samples: samples at each node of the path.
        names: names of the estimators in the checks; by default their own.
        span: ends of the path, from theta along the direction [unit of theta]; None for two standard deviations of the
            noise to either side, or 0.02 for noise on the controls.
        direction: "random", the index of a parameter, or "means" for the paths of `along_means`.

    Raises:
        ValueError: an estimator's formula does not apply to the task, or the direction is invalid.
    """
    check_estimators(estimators, task)
    check_span(span)
    low, high = span or (-reach_of(task), reach_of(task))
    axis = "random" if direction == ALONG_MEANS else direction
    along = jnp.asarray(direction_of(axis, task.policy.num_params, seed), task.theta.dtype)
    simulator = Simulator(task, chunk_size=chunk_for(samples, local_devices(), [task]))
    found, ends = [], (task.theta + low * along, task.theta + high * along)
    for index, cell in enumerate(cells):
        nodes = in_nodes(progress, index, len(cells), cell.label)
        objective, key = simulator.objective(cell.contact), jax.random.key(seed)
        if direction == ALONG_MEANS:
            paths = _along_own(estimators, objective, task.theta, reach_of(task), samples, seed, nodes)
        else:
            report = lambda node, nodes=nodes: nodes(node, NODES)  # noqa: E731
            paths = [circulations(estimators, objective, *ends, key, samples, progress=report)]
        found += [
            MeanCheck(cell.family, cell.stiffness_or_zero, name, each, each.verdict())
            for numbers in paths
            for name, each in zip(names or [estimator.name for estimator in estimators], numbers, strict=True)
        ]
    progress(len(cells), len(cells), "done")
    return found


def _along_own(
    estimators: Sequence[Estimator],
    objective: Any,
    theta: Array,
    reach: float,
    samples: int,
    seed: int,
    progress: Nodes,
) -> list[list[Circulation]]:
    """`along_means` with estimates from a batch of their own."""
    batches, _, _ = draw_batches(objective, theta, cell_keys(seed, 1), oracles_of(estimators), samples, slice(1))
    estimates = unmixed(estimators, jax.tree.map(lambda leaf: jax.device_put(leaf[0]), batches))
    return along_means(estimators, objective, theta, reach, estimates, samples, seed, progress)


def check_terms(
    plan: StudyPlan, thetas: Mapping[str, Sequence[float]] = MappingProxyType({}), progress: Progress = silent
) -> list[MeanCheck]:
    """Check the means of a study's estimators that have an onset term, along themselves, with as many samples.

    It needs no reference gradient.

    Args:
        thetas: parameters at which to check, by estimator; by default the task's.
    """
    objectives, found = Objectives(plan), []
    chosen = [
        (cell, name, estimator)
        for cell in plan.cells
        if not cell.model.analytic
        for name, estimator in zip(plan.config.estimator_names, estimators_of(plan, cell), strict=True)
        if CORRECTED in estimator.needs or (plan.task_of(cell).onset != "none" and reads_onset([estimator]))
    ]
    for index, (cell, name, estimator) in enumerate(chosen):
        nodes = in_nodes(progress, index, len(chosen), cell.model.label)
        task = plan.task_of(cell).replace(sigma=cell.sigma)
        theta = jnp.asarray(thetas.get(name, task.theta), task.theta.dtype)
        if np.all(np.isfinite(theta)):
            drawn = cell.samples, plan.config.seed, nodes
            ((circulation,),) = _along_own([estimator], objectives(cell), theta, reach_of(task), *drawn)
            place = cell.model.family, cell.model.stiffness_or_zero
            found.append(MeanCheck(*place, name, circulation, circulation.verdict()))
    if chosen:
        progress(len(chosen), len(chosen), "done")
    return found


def term_lines(checks: Sequence[MeanCheck], onset: str = "none") -> list[str]:
    lines = []
    for check in checks:
        row, name = check.as_dict(), _label(check.estimator, onset)
        where = f"{check.contact}, K = {check.stiffness:g} N/m" if check.stiffness else check.contact
        more = "; more --samples decide it" if check.verdict == "undecided" else ""
        gap, half = row["relative_gap"], (row["detectable"] or 0.0) / 2
        found = "the mean cost is flat" if gap is None else f"{percent(abs(gap), 2)} ± {percent(half, 2)} off"
        if half > UNRESOLVED:
            found, more = f"its samples vary too much, ± {half:.0e} times the slope", ""
        lines.append(
            f"{where}: the mean of {name} is {check.verdict}, on average along its path: {found}, without a "
            f"reference{more}."
        )
    return lines


def _label(name: str, onset: str) -> str:
    """Label of an estimator that has been checked, so that its module is known."""
    return (":" in name and find_estimator(name).own_label()) or label_of(name, onset)


def lines_of(checks: Sequence[MeanCheck], onset: str = "none") -> list[str]:
    identity = (
        Column("contact", itemgetter("contact")),
        Column("K [N/m]", lambda row: f"{row['stiffness']:g}" if row["stiffness"] else "-"),
        Column("estimator", lambda row: _label(row["estimator"], onset)),
    )
    return tabulate([check.as_dict() for check in checks], [*identity, *MEANS])
