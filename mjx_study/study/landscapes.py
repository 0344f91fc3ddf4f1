r"""Landscapes: what a decision's cost looks like, what noise makes of it, and which slope each estimator sees.

Along a line theta(t) = theta_0 + t * direction (for a decision of one number, theta = t) and at each point of a grid:

    the cost without noise,  F = E V_1,  E[ZoBG] . direction,  E[FoBG] . direction,

each mean with its standard error. Where F has a slope that E[FoBG] does not see, the cost jumps. The same keys are used
at every point and for every contact model, so curves are smooth and differences between them are not sampling noise;
zeroth- and first-order means come from independent keys. For a decision of one number from a fixed start the means are
also had without sampling, by quadrature.

Reference: Suh et al. 2022, figure of simple systems, second row.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from estimators import FirstOrder, GradientEstimate, Objective, ZerothOrder, first_order, zeroth_order
from mjx_study.objective import Simulator, chunk_for
from mjx_study.option import Checked
from mjx_study.reference import FunctionObjective, Reference, ScalarFunction, smoothed
from mjx_study.runtime import environment
from mjx_study.simulation.contact import ContactModel
from mjx_study.study.configuration import Progress, at_theta, check_span
from mjx_study.study.memory import check_memory
from mjx_study.study.quadrature import Line, Means, applies, grid, means
from mjx_study.tasks import make_task
from mjx_study.tasks.contact_grid import ContactPoint, contact_grid
from mjx_study.tasks.task import Task
from mjx_study.tasks.validation import check_shapes

SPAN_SIGMAS: Final = 10.0
"""Half the default width of a line through many parameters, in standard deviations of the noise."""
DETECTED: Final = 4.0
"""Standard errors beyond which two means are called different."""
NOTABLE: Final = 0.05
"""Share of the largest slope beyond which a difference is mentioned, where there is no sampling error."""
QUADRATURE: Final = 1500
"""Points of the grid that quadrature uses under Gaussian noise; heavier tails get more."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LandscapeConfig(Checked):
    """Everything that decides a landscape.

    Attributes:
        task: name of a task.
        contact: contact families; None for the task's.
        stiffness: contact stiffnesses [N/m]; None for the middle one of the task's.
        damping: of the contact [N s/m]; None for each family's.
        points: on the line.
        span: first and last t; None for the task's, or 10 sigma to either side.
        direction: "random", or the index of one parameter; a decision of one number has no other.
        theta: parameters that the line goes through, where there are several; None for the task's.
        samples: in each batch at each point.
        sigma: standard deviation of the noise, in the unit of what it is added to; None for the task's.
        noise: name of the noise's density; None for the task's.
        seed: of all randomness.
        reference: whether the analytic reference is drawn beside the contact models, where there is one.
    """

    ranges: ClassVar = {"samples": "[3, 1e7]"}

    task: str
    contact: tuple[str, ...] | None = None
    stiffness: tuple[float, ...] | None = None
    damping: float | None = None
    points: int = 41
    span: tuple[float, ...] | None = None
    direction: str = "random"
    theta: tuple[float, ...] | None = None
    samples: int = 100
    sigma: float | None = None
    noise: str | None = None
    seed: int = 0
    reference: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_span(self.span)


@dataclasses.dataclass(frozen=True)
class Curve:
    """The landscape of one contact model or of the reference; all arrays run along the line.

    Attributes:
        label: for a heading.
        family: contact family, or "reference".
        stiffness: K [N/m]; 0 where there is none.
        cost: without noise; the mean over starts where they are drawn.
        smoothed, smoothed_se: F, the mean cost with noise.
        zeroth, zeroth_se: mean of ZoBG along the direction, with a zero-noise baseline.
        first, first_se: mean of FoBG along the direction.
        nonfinite: samples left out.
        residual: largest relative solver residual; 0 for the reference.
        exact: the means without sampling; None where quadrature does not apply.
    """

    label: str
    family: str
    stiffness: float
    cost: Float[np.ndarray, " points"]
    smoothed: Float[np.ndarray, " points"]
    smoothed_se: Float[np.ndarray, " points"]
    zeroth: Float[np.ndarray, " points"]
    zeroth_se: Float[np.ndarray, " points"]
    first: Float[np.ndarray, " points"]
    first_se: Float[np.ndarray, " points"]
    nonfinite: int
    residual: float
    exact: Means | None = None

    @property
    def difference(self) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
        """E[FoBG] - E[ZoBG] along the direction, and its standard error."""
        return self.first - self.zeroth, np.hypot(self.first_se, self.zeroth_se)


@dataclasses.dataclass(frozen=True)
class Landscape:
    """Curves over one line.

    Attributes:
        config: as resolved.
        environment: versions, machine, devices, precision.
        position: t, in the unit of theta.
        direction: unit vector in the space of theta; (1,) for a decision of one number.
        curves: the reference first, then one for each contact model.
        warnings: what MuJoCo would alter or the integrator cannot resolve.
    """

    config: LandscapeConfig
    environment: dict[str, Any]
    position: Float[np.ndarray, " points"]
    direction: Float[np.ndarray, " params"]
    curves: tuple[Curve, ...]
    warnings: tuple[str, ...]

    def findings(self) -> list[str]:
        """What the intervals say about the first-order mean, curve by curve."""
        return [f"{curve.label}: {self._finding(curve)}" for curve in self.curves]

    def _finding(self, curve: Curve) -> str:
        if curve.exact is None:
            gap, error = curve.difference
            seen, first, zeroth = np.abs(gap) > DETECTED * error, curve.first, curve.zeroth
            source, uncertainty = "E[ZoBG]", f"more than {DETECTED:g} standard errors"
        else:
            first, zeroth = curve.exact.first, curve.exact.slope
            gap = first - zeroth
            largest = float(np.max(np.abs(zeroth)))
            error = 3 * (curve.exact.slope_error + curve.exact.first_error) + NOTABLE * largest
            seen = np.abs(gap) > error
            source, uncertainty = "the mean cost's slope", f"more than {NOTABLE:.0%} of its largest value"
        if not np.any(seen):
            return f"E[FoBG] nowhere differs from {source} by {uncertainty}"
        worst = int(np.argmax(np.where(seen, np.abs(gap), -np.inf)))
        return (
            f"E[FoBG] differs from {source} by {uncertainty} at {np.mean(seen):.0%} of the points, most at "
            f"{self.position[worst]:.3g}, where it is {first[worst]:.3g} in place of {zeroth[worst]:.3g}"
        )

    def as_json(self) -> dict[str, Any]:
        """The landscape as plain data."""
        document = dataclasses.asdict(self) | {"findings": self.findings()}
        return _plain(document)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | tuple | list):
        return [_plain(item) for item in (value.tolist() if isinstance(value, np.ndarray) else value)]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@dataclasses.dataclass(frozen=True)
class ThetaLine:
    """Points theta_0 + t direction.

    Attributes:
        position: t, in the unit of theta.
        direction: of unit length, (params,).
        thetas: the points.
    """

    position: Float[np.ndarray, " points"]
    direction: Float[np.ndarray, " params"]
    thetas: tuple[Float[Array, " params"], ...]


def line_of(task: Task, points: int, span: Sequence[float] | None, direction: str | None, seed: int) -> ThetaLine:
    """The line through a task's theta; for a decision of one number, its range, whatever theta is.

    Args:
        task: whose parameters they are.
        points: how many.
        span: first and last t; None for the task's, or 10 sigma to either side.
        direction: "random" or None, or the index of one parameter.
        seed: of a random direction.

    Raises:
        ValueError: there is no such direction.
    """
    theta = np.asarray(task.theta, float)
    along = _direction(direction or "random", len(theta), seed)
    low, high = span or task.span or (-SPAN_SIGMAS * task.sigma, SPAN_SIGMAS * task.sigma)
    check_span((low, high))
    position = np.linspace(low, high, points)
    origin = np.zeros(1) if len(theta) == 1 else theta
    return ThetaLine(position, along, tuple(jnp.asarray(origin + t * along, task.theta.dtype) for t in position))


@dataclasses.dataclass(frozen=True)
class LandscapePlan:
    """A landscape that has been checked."""

    config: LandscapeConfig
    task: Task
    cells: tuple[ContactPoint, ...]
    line: ThetaLine
    warnings: tuple[str, ...]


def plan_landscape(config: LandscapeConfig, task: Task | None = None) -> LandscapePlan:
    """Check a configuration and resolve its defaults, computing nothing.

    Args:
        config: what to draw.
        task: in place of the one that the configuration names.

    Raises:
        ValueError: a direction, family, stiffness, theta or noise that cannot be used.
    """
    if task is None:
        task = make_task(config.task)
    else:
        check_shapes(task)
    if config.theta is not None and task.policy.num_params == 1:
        raise ValueError("theta has one entry, and the line is its range: give --span")
    task = at_theta(task, config.theta)
    changes = {"sigma": config.sigma, "noise": config.noise}
    task = task.replace(**{name: value for name, value in changes.items() if value is not None})
    stiffness = config.stiffness or (task.middle_stiffness,)
    cells, messages = contact_grid(task, config.contact, stiffness, config.damping)
    if not cells:
        raise ValueError("no contact model: give at least one contact family")
    check_memory(task, (ZerothOrder(), FirstOrder()), config.samples, other=config.points * task.policy.num_params)
    line = line_of(task, config.points, config.span, config.direction, config.seed)
    resolved = dataclasses.replace(
        config,
        contact=tuple(dict.fromkeys(cell.family for cell in cells)),
        stiffness=stiffness,
        span=(float(line.position[0]), float(line.position[-1])),
        sigma=task.sigma,
        noise=task.noise,
        reference=config.reference and task.reference is not None,
    )
    return LandscapePlan(resolved, task, cells, line, messages)


def _direction(direction: str, params: int, seed: int) -> Float[np.ndarray, " params"]:
    if params == 1:
        return np.ones(1)
    if direction == "random":
        drawn = np.random.default_rng(seed).normal(size=params)
        return drawn / np.linalg.norm(drawn)
    if not direction.isdecimal() or int(direction) >= params:
        raise ValueError(f"direction must be random or a parameter's index, 0 to {params - 1}; got {direction}")
    return np.eye(params)[int(direction)]


def landscape(plan: LandscapePlan, progress: Progress = lambda done, total, what: None) -> Landscape:
    """Draw a landscape's curves."""
    config, task = plan.config, plan.task
    position, direction, thetas = plan.line.position, plan.line.direction, plan.line.thetas
    simulator = Simulator(task, chunk_size=chunk_for(config.samples, jax.local_devices()))
    exact = _quadrature(task, position)
    objectives: list[tuple[str, str, float, Objective, Means | None]] = []
    if config.reference and task.reference is not None:
        reference = task.analytic(plan.cells[0].stiffness)
        objectives.append(("reference", "reference", 0.0, reference, _closed_form(reference, position)))
    for cell in plan.cells:
        objective = simulator.objective(cell.contact)
        objectives.append((cell.label, cell.family, cell.stiffness, objective, exact(cell.contact)))
    total = len(objectives) * len(thetas)
    streams = jax.random.split(jax.random.key(config.seed))
    keys = [jax.random.split(stream, config.samples) for stream in streams]
    curves = []
    for label, family, stiffness, objective, known in objectives:
        points = []
        for theta in thetas:
            progress(len(curves) * len(thetas) + len(points), total, label)
            points.append(_point(objective, theta, direction, keys))
        columns = {name: np.array([point[name] for point in points]) for name in points[0]}
        nonfinite, residual = int(columns.pop("nonfinite").sum()), float(columns.pop("residual").max())
        curves.append(Curve(label, family, stiffness, **columns, nonfinite=nonfinite, residual=residual, exact=known))
    progress(total, total, "done")
    return Landscape(config, environment(), position, direction, tuple(curves), plan.warnings)


def _point(
    objective: Objective,
    theta: Float[Array, " params"],
    direction: Float[np.ndarray, " params"],
    keys: Sequence[Key[Array, " samples"]],
) -> dict[str, float]:
    drawn = [jax.random.clone(batch) for batch in keys]  # the same noise at every point, on purpose
    evaluation = objective.evaluate(theta, drawn[0])
    estimates = (zeroth_order(evaluation, "zero_noise"), first_order(objective.differentiate(theta, drawn[1])))
    (zeroth, zeroth_se), (first, first_se) = (_along(estimate, direction) for estimate in estimates)
    value = np.asarray(evaluation.value)
    value = value[np.isfinite(value)]
    residual = 0.0 if evaluation.residual is None else float(np.max(np.asarray(evaluation.residual)))
    return {
        "cost": float(np.mean(np.asarray(evaluation.baseline))),
        "smoothed": _mean(value),
        "smoothed_se": _standard_error(value),
        "zeroth": zeroth,
        "zeroth_se": zeroth_se,
        "first": first,
        "first_se": first_se,
        "nonfinite": sum(int(estimate.num_nonfinite) for estimate in estimates),
        "residual": residual,
    }


def _along(estimate: GradientEstimate, direction: Float[np.ndarray, " params"]) -> tuple[float, float]:
    """Mean and standard error of a gradient's component along a direction; samples that are not finite are left out."""
    component = np.asarray(estimate.per_sample) @ direction
    component = component[np.isfinite(component)]
    return _mean(component), _standard_error(component)


def _mean(sample: Float[np.ndarray, " samples"]) -> float:
    return float(np.mean(sample)) if len(sample) else math.nan


def _standard_error(sample: Float[np.ndarray, " samples"]) -> float:
    return float(np.std(sample, ddof=1) / math.sqrt(len(sample))) if len(sample) > 1 else math.nan


def _quadrature(task: Task, position: Float[np.ndarray, " points"]) -> Callable[[ContactModel | None], Means | None]:
    """Means without sampling as a function of the contact model; None where it does not apply."""
    if not applies(task):
        return lambda contact: None
    line, points = Line(task), grid(position[0], position[-1], task.sigma, QUADRATURE, task.noise)
    return lambda contact: means(points, *line(points, contact), position, task.sigma, task.noise)


def _closed_form(reference: Reference, position: Float[np.ndarray, " points"]) -> Means | None:
    """Means of a function of one parameter; None of any other reference."""
    if not isinstance(reference, FunctionObjective) or not isinstance(reference.function, ScalarFunction):
        return None
    points = [smoothed(reference.function, np.array([t]), reference.sigma, reference.noise) for t in position]
    value, slope, jump = np.array([(point.value, point.gradient[0], point.jump_term[0]) for point in points]).T
    return Means(value, slope, slope - jump, np.zeros_like(slope), np.zeros_like(slope))
