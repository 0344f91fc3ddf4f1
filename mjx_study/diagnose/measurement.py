"""Variances, times and means of the estimators under one contact model.

The error of an estimator after a second of computing is sqrt(bias^2 + variance x seconds per sample), relative to the
gradient. The bias is the detectable deviation of the estimator's mean from the mean cost's slope along a path
(`estimators.circulations`).
"""

import dataclasses
import math
import time
from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np

from estimators import ORACLES, Circulation, Estimator, make_estimator, oracles_of, variance_interval
from estimators.mean_check import NODES
from mjx_study.compiled import Builds
from mjx_study.diagnose.means import MAX_PATHS, along_means, in_nodes, reach_of, unmixed
from mjx_study.experiment.memory import fits_in_memory
from mjx_study.experiment.sampling import cell_keys, draw_batches
from mjx_study.experiment.tally import onset_numbers, unconverged
from mjx_study.objective import BlankObjective, Simulator, chunk_for
from mjx_study.progress import Progress, silent
from mjx_study.results.variables import ONSETS
from mjx_study.runtime import local_devices, precision
from mjx_study.simulation.contact import ContactModel, has_mujoco_law
from mjx_study.simulation.scene import num_constraint_rows
from mjx_study.tasks.task import Task

ESTIMATORS: Final = ("zobg", "fobg", "aobg", "fobg_onset", "aobg_onset")
SAMPLES: Final = 500  # samples per batch, if time allows
BUDGET_SECONDS: Final = 30.0  # time for all batches, compilation excluded [s]
LARGE_CHUNK: Final = 8
"""Samples per program call on a CPU for large models: a call takes the time of all of them, however few are
requested. Small ones share the programs of studies."""
SMALL_MODEL: Final = (8, 32)  # maximum numbers of degrees of freedom and constraint rows of a small model
RESOLVED_SE: Final = 2.0  # standard errors beyond which a gradient is distinguishable from 0
INTERVAL_SE: Final = 1.96  # half-width of a 95 % interval in standard errors
MOST_SAMPLES: Final = 16 * SAMPLES  # number of samples beyond which no more are drawn without being asked for
TARGET_ERROR: Final = 0.1  # relative error for which the page states a number of samples


@dataclasses.dataclass(frozen=True)
class Measured:
    """Measurements of an estimator on one batch.

    Attributes:
        variance, lower, upper: variance of one sample, with its 95 % interval [gradient^2].
        seconds: computing time per sample [s].
        paths: checks of the mean along paths; none for zeroth order, which is unbiased.
        verdict: verdict on the mean: unbiased by theory, or right, biased or undecided by the check.
        off, off_error: deviation of the mean along the paths, less its standard error (in squares), and that error
            [gradient].
        bias: the same, but if undecided with its standard error added (in squares) [gradient].
        norm: norm of the mean, without what noise adds to it [gradient].
        slope: slope of the mean cost along the first path [gradient]; 0 without paths.
        lost: number of excluded nonfinite samples.
    """

    estimator: str
    variance: float
    lower: float
    upper: float
    seconds: float
    paths: tuple[Circulation, ...]
    verdict: str
    off: float
    off_error: float
    bias: float
    norm: float
    slope: float
    lost: int

    def error(self, norm: float, variance: float | None = None, bias: float | None = None) -> float:
        """Error after a second of computing, relative to a gradient of this norm; by default that measured."""
        spread = (self.variance if variance is None else variance) * self.seconds
        bias = self.bias if bias is None else bias
        return math.hypot(bias, math.sqrt(spread)) / norm if norm > 0 else math.inf

    def interval(self, norm: float) -> tuple[float, float]:
        """95 % interval of `error`, from those of variance and bias."""
        low, high = (max(self.bias + sign * INTERVAL_SE * self.off_error, 0.0) for sign in (-1, 1))
        return self.error(norm, self.lower, low), self.error(norm, self.upper, high)

    def more_samples(self) -> float:
        """Factor by which the number of samples would have to grow for a verdict, as in `Circulation.more_samples`."""
        return max((each.more_samples() for each in self.paths), default=1.0)


@dataclasses.dataclass(frozen=True)
class Measurement:
    """Measurements of the estimators under one contact model, best first.

    Attributes:
        onsets: `mjx_study.results.variables.ONSETS` of the first-order batch; empty under a law other than MuJoCo's.
        unconverged: number of rollouts in which the solver did not converge.
        seconds: time of drawing the samples and checking the means [s].
        cost: mean magnitude of the cost.
    """

    samples: int
    seconds: float
    cost: float
    onsets: dict[str, float]
    unconverged: int
    estimators: tuple[Measured, ...]

    @property
    def lost(self) -> int:
        return max(each.lost for each in self.estimators)

    @property
    def surest(self) -> Measured:
        """The estimator of least variance among those without visible bias."""
        return min((each for each in self.estimators if each.verdict != "biased"), key=lambda each: each.variance)

    @property
    def by_slope(self) -> bool:
        """Whether the gradient's norm is the mean cost's slope along a path: unbiased estimates are too noisy."""
        (norm, error), (slope, uncertainty) = self._of_surest, self._slope
        return norm <= RESOLVED_SE * error and slope > RESOLVED_SE * uncertainty

    @property
    def _of_surest(self) -> tuple[float, float]:
        return self.surest.norm, math.sqrt(self.surest.variance / self.samples)

    @property
    def _slope(self) -> tuple[float, float]:
        """Slope along a path and its standard error, from those of the integrated mean and of the gap."""
        checked = [each for each in self.estimators if each.paths]
        errors = [(math.hypot(each.off_error, math.sqrt(each.variance / self.samples)), each) for each in checked]
        error, known = min(errors, key=lambda each: each[0], default=(math.inf, None))
        return (known.slope, error) if known else (0.0, error)

    @property
    def norm(self) -> float:
        """Norm of the gradient, or its standard error if that is larger."""
        return self._slope[0] if self.by_slope else max(self.surest.norm, self.norm_error)

    @property
    def norm_error(self) -> float:
        return (self._slope if self.by_slope else self._of_surest)[1]

    @property
    def resolved(self) -> bool:
        return self.by_slope or self.surest.norm > RESOLVED_SE * self.norm_error

    @property
    def best(self) -> Measured:
        return self.estimators[0]

    @property
    def open_questions(self) -> list[float]:
        """Factors by which the number of samples would have to grow to tell the gradient from 0, and to decide about
        the mean of each estimator that may be the best; none if all of that is known."""
        resolving = [] if self.resolved or not self.norm else [(RESOLVED_SE * self.norm_error / self.norm) ** 2]
        rivals = [each for each in self.estimators if each.error(1.0, bias=0.0) <= self.best.error(1.0)]
        return resolving + [each.more_samples() for each in rivals if each.verdict == "undecided"]

    @property
    def samples_needed(self) -> float:
        """Samples that the best estimator needs for `TARGET_ERROR`; infinite if its bias alone is larger."""
        left = (TARGET_ERROR * self.norm) ** 2 - self.best.bias**2
        return self.best.variance / left if left > 0 else math.inf


def estimators_of(task: Task, contact: ContactModel | None) -> list[Estimator]:
    """The five estimators, or the three without an onset term under a law other than MuJoCo's."""
    names = [name for name in ESTIMATORS if has_mujoco_law(contact) or not name.endswith("_onset")]
    return [make_estimator(name, gamma=task.defaults.gamma, sigma=task.sigma) for name in names]


def chunk_of(task: Task, samples: int) -> int:
    """Number of samples per program call."""
    devices, size = local_devices(), (task.scene.host.nv, num_constraint_rows(task.scene.template))
    large = any(number > most for number, most in zip(size, SMALL_MODEL, strict=True))
    usual = chunk_for(samples, devices, [task])
    return min(usual, LARGE_CHUNK) if large and devices[0].platform == "cpu" else usual


def affordable(seconds: float, chunk: int) -> int:
    """Number of samples that fit into `BUDGET_SECONDS`, at theta and along all paths, but at least one call per path,
    given the time of one call of all programs [s] and its number of samples, including a baseline.

    The number of calls is the nearest power of two, so that the next run mostly has as many and draws the same numbers.
    """
    calls = max(1.0, BUDGET_SECONDS / (seconds * MAX_PATHS * (NODES + 1)))
    return min(SAMPLES, MAX_PATHS * chunk * 2 ** round(math.log2(calls)) - 1)


def measure(
    simulator: Simulator,
    contact: ContactModel | None,
    samples: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Measurement:
    """Measure the estimators at the task's theta, without the contacts and step derivatives of a diagnosis.

    The simulator's compiled programs serve every contact model, None being the MJCF's. By default `SAMPLES` samples are
    drawn, fewer if they would take longer than `BUDGET_SECONDS`, and more where `more_samples` says so.
    """
    task = simulator.task
    chosen = estimators_of(task, contact)
    oracles, objective, keys = oracles_of(chosen, "evaluation"), simulator.objective(contact), cell_keys(seed, 1)

    def drawn(count: int):
        return draw_batches(objective, task.theta, keys, oracles, count, slice(1))

    progress(0, 2, "programs")
    builds = Builds()
    blank = BlankObjective(**vars(objective))
    for oracle in oracles:
        getattr(blank, ORACLES[oracle].method)(task.theta, jax.random.split(jax.random.key(0), 1))
    blank.build(builds)
    builds.wait()
    drawn(1)
    reach, first = reach_of(task), [each for each in chosen if any(ORACLES[oracle].order for oracle in each.needs)]

    def measured(samples: int) -> Measurement:
        stage, begun = f"{samples} samples", time.perf_counter()
        progress(1, 2, stage)
        batches, seconds, residuals = drawn(samples)
        batches = jax.tree.map(lambda leaf: jax.device_put(leaf[0]), batches)
        nodes, estimates = in_nodes(progress, 1, 2, stage), unmixed(chosen, batches)
        along = along_means(first, objective, task.theta, reach, estimates, samples, seed, nodes)
        paths: dict[Estimator, tuple[Circulation, ...]] = dict(zip(first, zip(*along, strict=True), strict=True))
        found = [
            _measured(each, batches, sum(seconds[oracle] for oracle in each.needs), paths.get(each, ()), reach, samples)
            for each in chosen
        ]
        onsets = {}
        if "corrected" in batches:
            events = np.asarray(batches["corrected"].events).reshape(-1, len(ONSETS))
            onsets = dict(zip(ONSETS, onset_numbers(events).tolist(), strict=True))
        unsolved = max(unconverged(each, precision()) for each in residuals.values())
        costs = jnp.abs(batches["evaluation"].value)
        cost = float(jnp.mean(costs, where=jnp.isfinite(costs)))
        unordered = Measurement(samples, time.perf_counter() - begun, cost, onsets, unsolved, tuple(found))
        order = sorted(found, key=lambda each: each.error(unordered.norm))
        return dataclasses.replace(unordered, estimators=tuple(order))

    if samples is not None:
        return measured(samples)
    found = measured(affordable(sum(drawn(1)[1].values()), simulator.chunk_size))
    while (factor := more_samples(found)) and fits_in_memory(task, chosen, factor * found.samples):
        found = measured(factor * found.samples)
    return found


def more_samples(found: Measurement) -> int:
    """Factor by which to draw more samples, a power of two: it answers the most open questions that `BUDGET_SECONDS`
    and `MOST_SAMPLES` allow; 0 if it answers none."""
    most = min(BUDGET_SECONDS / found.seconds, MOST_SAMPLES / found.samples)
    factors = [2 ** max(1, math.ceil(math.log2(each))) for each in found.open_questions if math.isfinite(each)]
    return max((each for each in factors if each <= most), default=0)


def _measured(
    estimator: Estimator, batches: Any, seconds: float, paths: tuple[Circulation, ...], reach: float, samples: int
) -> Measured:
    """Measure an estimator on its batches, given the time that they took and checks of its mean along paths."""
    estimate = estimator(batches)
    lower, upper = variance_interval(estimate, 0.95)
    squared = float(jnp.sum(estimate.mean**2)) - float(estimate.variance) / samples
    verdicts = {each.verdict() for each in paths}
    verdict = next((each for each in ("biased", "undecided", "right") if each in verdicts), "unbiased")
    gaps, errors = (np.array([float(getattr(each, name)) for each in paths]) for name in ("gap", "standard_error"))
    off, bias = (
        float(np.sqrt(np.sum(np.maximum(gaps**2 + sign * errors**2, 0.0)))) / (2 * reach)
        for sign in (-1, 1 if verdict == "undecided" else -1)
    )
    off_error = float(np.linalg.norm(gaps * errors)) / (float(np.linalg.norm(gaps)) or 1.0) / (2 * reach)
    return Measured(
        estimator=estimator.name,
        variance=float(estimate.variance),
        lower=float(lower),
        upper=float(upper),
        seconds=seconds / samples,
        paths=paths,
        verdict=verdict,
        off=off,
        off_error=off_error,
        bias=bias,
        norm=math.sqrt(max(squared, 0.0)),
        slope=abs(float(paths[0].difference)) / (2 * reach) if paths else 0.0,
        lost=int(estimate.num_nonfinite),
    )
