"""Measurement of claims: studies and landscapes shared by several claims, and statistics computed from them."""

import dataclasses
import hashlib
import math
import re
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Float

import estimators
from estimators import Estimator, GradientEstimate, Objective
from estimators.confidence import student_quantile
from mjx_study.choices import FAMILIES as CONTACTS
from mjx_study.choices import REFERENCE, laws_of
from mjx_study.claims.thrown import THROWN
from mjx_study.execution.run import run_study
from mjx_study.experiment.quadrature import Line, means
from mjx_study.objective import Simulator
from mjx_study.options.configuration import StudyConfig
from mjx_study.reference import FinalCost, ReferenceObjective, function_objective, smoothed
from mjx_study.simulation.contact import ContactModel
from mjx_study.tasks import task_with_options
from mjx_study.tasks.contact_grid import backward_grid, family_grid
from mjx_study.tasks.task import Task

FAMILIES: Final = (
    REFERENCE, "penalty", "impedance", "mujoco", "mujoco_default", "mujoco_stiff", "smooth_onset", "mjcf",
    *laws_of(CONTACTS),
)  # fmt: skip
"""Columns of the verdict matrix."""
REAL: Final = FAMILIES[1 : FAMILIES.index("mjcf")]
"""MJX contact families to compare; "mjcf" is for systems without contact."""
TIMED: Final = 64  # samples per device in a timed batch
REPEATS: Final = 12  # repetitions of a timing
RELAXATIONS: Final = {
    "smooth onset": ("smooth_onset", 1.0, None),
    "ten times softer": ("mujoco", 0.1, None),
    "from 1 mm apart": ("smooth_onset", 1.0, 0.001),
}
"""Contact models whose derivatives may replace exact ones: family, stiffness factor, margin [m]."""


@dataclasses.dataclass(frozen=True)
class Effort:
    """Amount of measurement.

    Attributes:
        density: points of a landscape per standard deviation of the noise.
        draws: number of samples if samples are free.
        batches: number of batches if batches are cheap.
        samples, seeds: sample and batch numbers for simulated batches.
        seeds_of_descents, iterations: settings of descents; iterations as a share of the task's recipe.
    """

    name: str
    density: int
    draws: int
    batches: int
    samples: int
    seeds: int
    seeds_of_descents: int
    iterations: float


EFFORTS: Final = {
    "quick": Effort("quick", 40, 100_000, 400, 100, 10, 12, 0.4),
    "full": Effort("full", 200, 1_000_000, 4000, 400, 20, 30, 1.0),
}


@dataclasses.dataclass(frozen=True)
class Statistic:
    """An estimate with what its interval is computed from.

    Attributes:
        error, freedom: its standard error, and the degrees of freedom of that.
        slack: bound on a deterministic error, such as a quadrature's.
        samples, of: number and kind of the samples behind the standard error.
        trials: if not 0, the estimate is a share of this many trials, with a Wilson interval.
    """

    estimate: float
    error: float = 0.0
    freedom: float = 1e9
    slack: float = 0.0
    samples: int = 0
    of: str = ""
    trials: int = 0


def exact(estimate: float, slack: float = 0.0, points: int = 0) -> Statistic:
    """Statistic without sampling error, from a quadrature with `points` points."""
    return Statistic(float(estimate), slack=float(slack), samples=points, of="points")


def mean_of(values: Sequence[float] | np.ndarray, of: str, slack: float = 0.0) -> Statistic:
    """Mean of independent values, with the t-interval of its standard error."""
    kept = np.asarray(values, float)
    error = float(np.std(kept, ddof=1) / math.sqrt(len(kept)))
    return Statistic(float(np.mean(kept)), error, float(len(kept) - 1), slack, len(kept), of)


def share_of(happened: np.ndarray, of: str) -> Statistic:
    return Statistic(float(np.mean(happened)), samples=len(happened), of=of, trials=len(happened))


def ratio_of(top: np.ndarray, bottom: np.ndarray, of: str) -> Statistic:
    """log10 of the ratio of two means over the same trials, by the delta method."""
    high, low = float(np.mean(top)), float(np.mean(bottom))
    terms = (top / high - bottom / low) / math.log(10)
    return dataclasses.replace(mean_of(terms, of), estimate=math.log10(high / low))


@dataclasses.dataclass(frozen=True, eq=False)
class Landscape:
    """Cost and derivative of an MJX rollout over one parameter, on a fine uniform grid, piecewise constant.

    A `Function`, so that estimators and descents run on it as on an analytic system, without another simulation.
    Beyond the grid, its end cells go on.
    """

    points: Float[np.ndarray, " size"]
    values: Float[np.ndarray, " size"]
    slopes: Float[np.ndarray, " size"]
    num_params: int = 1

    def value(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch"]:
        return np.asarray(self.values[self._cell(x)])

    def gradient(self, x: Float[np.ndarray, "*batch 1"]) -> Float[np.ndarray, "*batch 1"]:
        return np.asarray(self.slopes[self._cell(x)])[..., None]

    def _cell(self, x: np.ndarray) -> np.ndarray:
        spacing = self.points[1] - self.points[0]
        return np.asarray(np.clip(np.rint((x[..., 0] - self.points[0]) / spacing), 0, len(self.points) - 1), int)


@dataclasses.dataclass(frozen=True)
class Slopes:
    """Gradient of F, and the mean of first-order gradients, at one theta; F as an objective has one parameter.

    `errors` are the quadrature errors of both over |grad F|, from this number of points; 0 for a closed form.
    """

    gradient: float
    first: float
    errors: tuple[float, float]
    objective: ReferenceObjective
    theta: float
    points: int = 0

    @property
    def relative(self) -> float:
        """E[FoBG] / grad F - 1."""
        return self.first / self.gradient - 1


class Laboratory:
    """Measures at one effort, and caches simulated and compiled results.

    The studies are kept in `folder`, if given, and resumed; with `accept_versions`, also those begun by other versions.
    """

    def __init__(self, effort: Effort, folder: Path | None = None, accept_versions: bool = False):
        self.effort, self._folder, self._accept = effort, folder, accept_versions
        self.study, self.task = cache(self._study), cache(self._task)
        self.tabulated, self.landscape = cache(self._tabulated), cache(self._landscape)
        self._line = cache(lambda name, timestep, onset: Line(self.task(name, timestep, onset)))
        self._simulator = cache(lambda name: Simulator(self.task(name), chunk_size=TIMED))

    def _study(self, config: StudyConfig) -> xr.Dataset:
        folder = None
        if self._folder is not None:
            settings = repr(config.resolved() | {"tasks": config.task_names, "effort": self.effort})
            digest = hashlib.sha256(settings.encode()).hexdigest()[:12]
            folder = self._folder / f"{re.sub(r'[^a-z_]+', '-', config.task_names[0])}-{config.settings.kind}-{digest}"
        return run_study(config, folder, accept_versions=self._accept)

    def _task(self, name: str, timestep: float | None = None, onset: str = "none") -> Task:
        task = THROWN[name]() if name in THROWN else task_with_options(name, {"timestep": timestep})
        return task.replace(onset=onset)

    def _contact(
        self, task: Task, family: str, stiffness: float, relaxed: str | None = None, smoothing: float = 1.0
    ) -> ContactModel | None:
        """Contact model of a family, with exact derivatives or those of one of `RELAXATIONS`; `smoothing` is a factor
        on that of a law other than MuJoCo's."""
        kappa = CONTACTS[family].smoothing * smoothing if laws_of((family,)) else None
        (cell,), _ = family_grid(task, (family,), (stiffness,), smoothing=kappa)
        if relaxed is not None:
            other, factor, margin = RELAXATIONS[relaxed]
            (cell,), _ = backward_grid(task, (cell,), (other,), factor * cell.stiffness_or_zero, margin)
        return cell.contact

    def _landscape(
        self, name: str, family: str, stiffness: float, low: float, high: float, sigma: float,
        timestep: float | None = None, onset: str = "none", relaxed: str | None = None, smoothing: float = 1.0,
    ) -> Landscape:  # fmt: skip
        """Landscape of a task between two parameters, extended by the noise around them."""
        task = self.task(name, timestep, onset)
        points = np.arange(low - 5.4 * sigma, high + 5.4 * sigma, sigma / self.effort.density)
        contact = self._contact(task, family, stiffness, relaxed, smoothing)
        return Landscape(points, *self._line(name, timestep, onset)(points, contact))

    def objective(self, name: str, family: str, stiffness: float) -> Objective:
        """Task under a family, for measurements by rollouts."""
        task = self.task(name)
        if family == REFERENCE:
            return task.analytic(stiffness)
        return self._simulator(name).objective(self._contact(task, family, stiffness))

    def _tabulated(self, name: str, family: str, stiffness: float, low: float, high: float) -> Task:
        """Task whose analytic system is its landscape under a family."""
        task = self.task(name)
        sigma, table = task.sigma, self.landscape(name, family, stiffness, low, high, task.sigma)
        return task.replace(name=f"{name}, {family}", reference=lambda stiffness: function_objective(table, sigma))

    def slopes(
        self, name: str, family: str, theta: float, *, stiffness: float, sigma: float | None = None,
        timestep: float | None = None, onset: str = "none", relaxed: str | None = None, smoothing: float = 1.0,
    ) -> Slopes:  # fmt: skip
        """Gradient and means at theta by quadrature, or in closed form for the analytic system."""
        task = self.task(name)
        sigma = task.sigma if sigma is None else sigma
        if family == REFERENCE:
            reference = task.analytic(stiffness)
            assert isinstance(reference.system, FinalCost)
            return closed_form(reference.system.function, theta, sigma)
        table = self.landscape(name, family, stiffness, theta, theta, sigma, timestep, onset, relaxed, smoothing)
        found = means(table.points, table.values, table.slopes, np.array([theta]), sigma, task.noise)
        slope, first = float(found.slope[0]), float(found.first[0])
        errors = float(found.slope_error[0]) / abs(slope), float(found.first_error[0]) / abs(slope)
        return Slopes(slope, first, errors, function_objective(table, sigma), theta, len(table.points))


def times_of(work: Callable[[], Any]) -> np.ndarray:
    """Time repetitions of the same work after a warm-up [s]."""
    jax.block_until_ready(work())
    found = []
    for _ in range(REPEATS):
        begun = time.perf_counter()
        jax.block_until_ready(work())
        found.append(time.perf_counter() - begun)
    return np.array(found)


def closed_form(function: Any, theta: float, sigma: float) -> Slopes:
    exactly = smoothed(function, np.array([theta]), sigma)
    gradient, jump = float(exactly.gradient[0]), float(exactly.jump_term[0])
    return Slopes(gradient, gradient - jump, (1e-12, 1e-12), function_objective(function, sigma), theta)


def batch(estimator: Estimator, at: Slopes, samples: int) -> GradientEstimate:
    return estimators.estimate(estimator, at.objective, jnp.array([at.theta]), jax.random.key(0), samples)


def batches(chosen: Sequence[Estimator], at: Slopes, samples: int, count: int) -> list[GradientEstimate]:
    """Draw many independent batches, shared by several estimators; leaves have a leading axis of batches."""
    needs = estimators.oracles_of(chosen)
    drawn = estimators.draw(needs, at.objective, jnp.array([at.theta]), jax.random.key(1), samples * count)
    parts = jax.tree.map(lambda leaf: leaf.reshape(count, samples, *leaf.shape[1:]), drawn)
    return [jax.jit(jax.vmap(each))(parts) for each in chosen]


def log_variance(estimate: GradientEstimate) -> Statistic:
    """log10 of a batch's variance, with the error of its jackknife interval; zero variance counts as 1e-300."""
    variance, confidence, half = max(float(estimate.variance), 1e-300), 0.95, 0.0
    freedom = jnp.maximum(estimators.effective_samples(estimate).count - 1.0, 2.0)
    if variance > 1e-300:
        half = math.log10(float(estimators.variance_interval(estimate, confidence)[1]) / variance)
    error = half / float(student_quantile(0.5 + confidence / 2, freedom))
    return Statistic(math.log10(variance), error, float(freedom), samples=len(estimate.per_sample), of="samples")


def difference_of(one: Statistic, other: Statistic) -> Statistic:
    """Difference of independent statistics, with Welch-Satterthwaite degrees of freedom."""
    squares = np.array([one.error**2, other.error**2])
    parts = float(np.sum(squares**2 / np.array([one.freedom, other.freedom])))
    freedom = float(np.sum(squares)) ** 2 / parts if parts > 0 else 1e9
    error, slack = math.sqrt(float(np.sum(squares))), one.slack + other.slack
    return Statistic(one.estimate - other.estimate, error, freedom, slack, one.samples, one.of)
