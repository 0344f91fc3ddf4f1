"""What every study is asked for, checked and resolved: the task, its contact models, its estimators."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from estimators import ESTIMATORS, Estimator, make_estimator
from estimators.cross_fitting import PLUG_IN, check_weights
from estimators.ddcg import PUBLISHED_TOLERANCE
from mjx_study.objective import chunk_for
from mjx_study.option import Checked
from mjx_study.tasks import make_task
from mjx_study.tasks.task import Task
from mjx_study.tasks.validation import check_shapes

Progress = Callable[[int, int, str], None]
"""Called with (work done, work in all, what is being done)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class EstimatorConfig(Checked):
    """What decides how estimators run on a task; base of the configurations of studies.

    Attributes:
        task: name of a task.
        estimators: names of estimators, or `module:name` of one's own.
        theta: parameters at which gradients are taken or a descent begins; None for the task's.
        seed: of all randomness.
        sigma: standard deviation of the noise, in the unit of what it is added to; None for the task's.
        noise: name of the noise's density; None for the task's.
        baseline: of zeroth-order estimates: zero_noise, leave_one_out or none.
        gamma: accuracy that the alpha-order estimate must keep, in the unit of the gradient; None for the task's.
        published: whether gamma and what follows are the published example's, on the scale of the task's cost.
        failure_probability: of the confidence radius epsilon.
        variance_proxy: in epsilon: variance, second_moment or upper_bound.
        radius: R in epsilon: max_deviation, or a bound in the unit of the gradient.
        max_norm: of a sample of the clipped first-order estimate, in the unit of the gradient.
        window: steps between cuts of the truncated first-order estimate.
        tolerance: of the discontinuity test of "ddcg".
        weights: plug_in or cross_fitted, of the estimators that interpolate.
        onset: none, or linear for first-order gradients with the term of contact that begins; see
            `mjx_study.simulation.onset`.
        damping: of the contact [N s/m]; None for each family's.
        cone: pyramidal or elliptic; None for the MJCF's.
        horizon: steps; None for the task's.
        model: an MJCF in place of the task's own; None for that.
        chunk_size: samples per device and call; None to choose by the number of samples.
    """

    task: str
    estimators: tuple[str, ...] = ("zobg", "fobg", "aobg")
    theta: tuple[float, ...] | None = None
    seed: int = 0
    sigma: float | None = None
    noise: str | None = None
    baseline: str = "zero_noise"
    gamma: float | None = None
    published: bool = False
    failure_probability: float = 0.05
    variance_proxy: str = "variance"
    radius: str | float = "max_deviation"
    max_norm: float | None = None
    window: int | None = None
    tolerance: float = PUBLISHED_TOLERANCE
    weights: str = PLUG_IN
    onset: str = "none"
    damping: float | None = None
    cone: str | None = None
    horizon: int | None = None
    model: str | None = None
    chunk_size: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_names("estimator", self.estimators, ESTIMATORS)


def check_names(label: str, names: Sequence[str], choices: Collection[str]) -> None:
    """Refuse a selection that is empty or names something twice.

    Raises:
        ValueError: with the choices.
    """
    if not names:
        raise ValueError(f"no {label} given; choose from {', '.join(choices)}")
    refuse_repeats(label, names)


def refuse_repeats(label: str, values: Sequence[object]) -> None:
    """Raises ValueError for a value that occurs twice."""
    repeated = {str(value) for value, count in Counter(values).items() if count > 1}
    if repeated:
        raise ValueError(f"{label} given twice: {', '.join(sorted(repeated))}")


def configured_task(config: EstimatorConfig, task: Task | None = None) -> Task:
    """The task that a configuration names, or the one that is given, with what the configuration changes of it.

    Raises:
        ValueError: there is no such task, or it cannot be changed so; or parts of the given one do not fit together.
    """
    building = {name: getattr(config, name) for name in ("cone", "horizon", "model")}
    building = {name: value for name, value in building.items() if value is not None}
    if task is None:
        task = make_task(config.task, **building)
    elif building:
        raise ValueError(f"{', '.join(building)}: only for a task that is built by its name; build this one so")
    else:
        check_shapes(task)
    changes = {"sigma": config.sigma, "noise": config.noise}
    return task.replace(onset=config.onset, **{name: value for name, value in changes.items() if value is not None})


def at_theta(task: Task, theta: Sequence[float] | None) -> Task:
    """The task at other parameters; as it is for None.

    Raises:
        ValueError: they are not as many as the policy has, or not finite.
    """
    if theta is None:
        return task
    values = np.asarray(theta, float)
    if values.shape != (task.policy.num_params,) or not np.all(np.isfinite(values)):
        raise ValueError(
            f"theta has {values.size} numbers; {task.name} needs {task.policy.num_params}, all of them finite"
        )
    return task.replace(theta=jnp.asarray(values, task.theta.dtype))


def configured_estimators(config: EstimatorConfig, task: Task) -> tuple[Estimator, ...]:
    """A configuration's estimators with their options, checked against the task.

    Raises:
        ValueError: there is no such estimator, an option is out of range or missing, or an estimator cannot run on the
            task; or published constants are asked for where there are none, or beside others.
    """
    options = {name: getattr(config, name) for name in ("baseline", "max_norm", "window", "tolerance", "weights")}
    options |= bound_constants(config, task) | {"sigma": task.sigma}
    found = tuple(make_estimator(name, **options) for name in config.estimators)
    check_estimators(found, task)
    return found


def bound_constants(config: EstimatorConfig, task: Task) -> dict[str, Any]:
    """Constants of AoBG's bound: those of a configuration, or the published example's.

    Raises:
        ValueError: the published ones are asked for where there are none, or beside others.
    """
    names = ("gamma", "failure_probability", "variance_proxy", "radius")
    given = {name: getattr(config, name) for name in names}
    if not config.published:
        return given | {"gamma": task.gamma if config.gamma is None else config.gamma}
    if task.published is None:
        raise ValueError(f"{task.name} has no published constants of the bound; leave published out")
    defaults = {field.name: field.default for field in dataclasses.fields(EstimatorConfig)}
    if others := [name for name in names if given[name] != defaults[name]]:
        raise ValueError(f"published sets {', '.join(names)}: leave {', '.join(others)} out")
    return dataclasses.asdict(task.published)


def resolved_fields(config: EstimatorConfig, task: Task, samples: int) -> dict[str, Any]:
    """Fields of a configuration that the task or the devices decide where it leaves them open.

    Raises:
        ValueError: there are too few samples for the weights.
    """
    check_weights(config.weights, samples)
    chunk = chunk_for(samples, jax.local_devices()) if config.chunk_size is None else config.chunk_size
    return {
        "sigma": task.sigma,
        "noise": task.noise,
        **bound_constants(config, task),
        "horizon": task.horizon,
        "cone": {0: "pyramidal", 1: "elliptic"}[int(task.scene.host.opt.cone)],
        "chunk_size": chunk,
    }


def check_estimators(estimators: Iterable[Estimator], task: Task) -> None:
    """Refuse estimators whose formula does not hold for a task.

    Raises:
        ValueError: the noise is not Gaussian, or not on theta, where the formula needs it.
    """
    for estimator in estimators:
        if estimator.gaussian and task.noise != "gaussian":
            raise ValueError(f"{estimator.name!r} holds for Gaussian noise only; the noise is {task.noise}")
        if estimator.additive and not task.policy.additive:
            raise ValueError(
                f"{estimator.name!r} needs noise that is added to theta itself; {task.name} has a feedback policy"
            )
        if task.onset != "none" and "linearisation" in estimator.needs:
            raise ValueError(
                f"{estimator.name!r} needs the derivatives of single steps, which have no onset term; leave onset out"
            )
