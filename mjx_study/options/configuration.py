"""The configuration of a study; `resolution` derives a task's settings from it."""

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol, Union, runtime_checkable

from estimators.choices import PLUG_IN, PUBLISHED_TOLERANCE
from estimators.registry import ESTIMATORS
from mjx_study.choices import refuse_untaken
from mjx_study.options.option import Checked

if TYPE_CHECKING:
    import estimators.estimator

DEFAULT_KIND: Final = "gradients"
OF_KIND: Final[dict[str, tuple[str, ...]]] = {
    "gradients": ("reference_samples", "block_size", "confidence"),
    "descents": ("iterations", "optimizer", "learning_rate", "decay", "stiffness_schedule", "sigma_schedule",
                 "evaluation_samples", "network"),
    "landscapes": ("points", "span", "direction"),
}  # fmt: skip
"""Options specific to one kind of study."""
ASKED_BY: Final = {"descents": "iterations", "landscapes": "points"}
"""Options that ask for a kind of study where none is given."""
NEEDED: Final = {"landscapes": "points"}
"""Options without which there is no such study."""


@runtime_checkable
class NamedTask(Protocol):
    """A task given as an object, a `mjx_study.Task`."""

    @property
    def name(self) -> str: ...


SEEDS: Final = {"landscapes": 1}
"""Number of seeds where it is not given, for kinds of study in which it is not 10."""
SAMPLES: Final = 100
"""Samples per batch unless the configuration or a recipe sets another number."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Options of a configuration with their defaults in place of None; those of other kinds of study have no effect.

    Attributes:
        points: number of thetas at which batches are drawn: one, unless along a line.
    """

    kind: str
    points: int = 1
    reference_samples: int = 600
    optimizer: str = "sgd"
    evaluation_samples: int = 200


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyConfig(Checked):
    """Everything that determines a study of gradient estimates, descents or landscapes.

    Attributes:
        tasks: names of tasks, or tasks.
        kind: gradients, descents or landscapes; None to infer it from iterations and points.
        estimators: names of estimators, or estimators, which have options of their own.
        theta: parameters at which gradients are estimated or descents start, for a single task; None for the task's.
        network: hidden widths of a network that replaces the task's policy in descents; None for the task's policy.
        contact: contact families, and "reference" for the analytic system; None for each task's. Empty to use only
            `solref` and `solimp`.
        stiffness: contact stiffnesses [N/m], for the families that have one; None for each task's.
        damping: contact damping [N s/m]; None for each family's.
        solref, solimp: contact models in MuJoCo's own parameters, every solref with every solimp, in addition to the
            families; if only one is given, the other is MuJoCo's default.
        timestep: timesteps [s]; None for the MJCF's. Rollouts keep the task's duration unless horizon is given.
        cone: friction cones, pyramidal or elliptic; None for the MJCF's.
        sigma: standard deviations of the noise; None for each task's.
        samples: batch sizes; None for 100, or in descents for each task's recipe.
        confidence: confidence level of the intervals within a batch.
        seeds: number of batches per size, or of descents; in landscapes, of batches pooled at each point. None for 10,
            or 1 in landscapes.
        iterations: number of iterations of a descent; None for each task's recipe.
        points: number of points of a landscape, on a line through theta; None for no landscapes.
        span, direction: range and direction of that line; None for each task's range and a random direction.
        optimizer: name of an optax optimiser, "sgd" by default.
        learning_rate, decay: learning_rate / i^decay at iteration i; None for each task's recipe.
        stiffness_schedule, sigma_schedule: factors by iteration of a descent, as calls of optax schedules, of the
            contact stiffness (at most 1; the damping ratio is kept) and of sigma; None for 1. Evaluations use 1.
        reference_samples: number of rollout pairs per reference gradient; None for 600 in studies of gradients.
        evaluation_samples: number of rollouts that evaluate a final policy; None for 200 in descents.
        seed: random seed.
        noise: name of the noise density; None for each task's.
        baseline: baseline of zeroth-order estimates: zero_noise, leave_one_out or none.
        gamma: accuracy bound of the alpha-order estimate, in the unit of the gradient; None for each task's.
        published: use the published example's gamma and next three options, on the scale of the task's cost.
        failure_probability: failure probability of the confidence radius epsilon.
        variance_proxy: variance used in epsilon: variance, second_moment or upper_bound.
        radius: R in epsilon: max_deviation, or a bound in the unit of the gradient.
        max_norm: norm at which samples of the clipped first-order estimate are clipped, in the unit of the gradient.
        window: number of steps between cuts of the truncated first-order estimate.
        tolerance: tolerance of the discontinuity test of "ddcg".
        weights: weights of interpolating estimators: plug_in or cross_fitted.
        onset: onset term of first-order gradients: none, linear (`mjx_study.simulation.onset`), or jump, which costs
            four rollouts per onset (`mjx_study.simulation.branches`).
        backward: contact families whose derivatives replace the exact ones at the same states, each in turn (surrogate
            gradients); "none" for exact derivatives.
        backward_stiffness: stiffness of these families [N/m]; None for that of the simulated contact model.
        backward_margin: distance at which contact begins in their derivatives [m]; None for the MJCF's.
        horizon: number of steps; None for each task's.
        model: an MJCF that replaces the task's own; None for the task's.
        integrator, solver, solver_iterations, solver_ls_iterations, disable_flag: overrides of the MJCF's <option>,
            as in `mjx_study.load_scene`; None for the MJCF's.
        chunk_size: samples per device and call; None to choose it by the number of samples.
        block_size: samples held at once in studies of gradients; larger batches are split into blocks whose statistics
            are merged. None for whole batches if they fit in the memory limit.
    """

    ranges: ClassVar = {"samples": "[3, 1e7]"}

    tasks: tuple[str | NamedTask, ...]
    kind: str | None = None
    estimators: tuple[Union[str, "estimators.estimator.Estimator"], ...] = ("zobg", "fobg", "aobg")
    theta: tuple[float, ...] | None = None
    network: tuple[int, ...] | None = None
    contact: tuple[str, ...] | None = None
    stiffness: tuple[float, ...] | None = None
    damping: float | None = None
    solref: tuple[tuple[float, ...], ...] = ()
    solimp: tuple[tuple[float, ...], ...] = ()
    timestep: tuple[float, ...] | None = None
    cone: tuple[str, ...] | None = None
    sigma: tuple[float, ...] | None = None
    samples: tuple[int, ...] | None = None
    confidence: float = 0.95
    seeds: int | None = None
    iterations: int | None = None
    points: int | None = None
    span: tuple[float, ...] | None = None
    direction: str | None = None
    optimizer: str | None = None
    learning_rate: float | None = None
    decay: float | None = None
    stiffness_schedule: str | None = None
    sigma_schedule: str | None = None
    reference_samples: int | None = None
    evaluation_samples: int | None = None
    seed: int = 0
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
    backward: tuple[str, ...] = ("none",)
    backward_stiffness: float | None = None
    backward_margin: float | None = None
    horizon: int | None = None
    model: str | None = None
    integrator: str | None = None
    solver: str | None = None
    solver_iterations: int | None = None
    solver_ls_iterations: int | None = None
    disable_flag: tuple[str, ...] | None = None
    chunk_size: int | None = None
    block_size: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("tasks", "estimators"):
            if isinstance(getattr(self, name), str):
                raise ValueError(f"{name} must be a list, got {getattr(self, name)!r}")
        if not self.tasks:
            raise ValueError("no task given")
        if self.theta is not None and len(self.tasks) > 1:
            raise ValueError("`theta` is for a single task; give one task, or omit it")
        if not self.estimators:
            raise ValueError(f"no estimator given; choose from {', '.join(ESTIMATORS)}")
        refuse_repeats("estimator", self.estimator_names)
        refuse_repeats("contact family", self.contact or ())
        if self.contact is not None:
            refuse_untaken(self.contact, stiffness=self.stiffness, damping=self.damping)
        for name in ("tasks", "stiffness", "solref", "solimp", "timestep", "cone", "sigma", "samples", "backward"):
            values = getattr(self, name)
            refuse_repeats(name, values or ())
            if values == () and name not in ("solref", "solimp"):
                raise ValueError(f"no {name} given: give at least one, or omit it")
        if self.surrogate and self.onset != "none":
            raise ValueError("the onset term corrects exact derivatives: omit `onset` or `backward`")
        for name in () if self.surrogate else ("backward_stiffness", "backward_margin"):
            if getattr(self, name) is not None:
                raise ValueError(f"`{name}` needs a contact family in `backward`")
        if self.iterations is not None and self.points is not None:
            raise ValueError("`iterations` are for descents and `points` for landscapes: give one of them")
        kind = self.settings.kind
        if kind in NEEDED and not self.given(NEEDED[kind]):
            raise ValueError(f"{kind} need `{NEEDED[kind]}`: give their number")
        for other, options in OF_KIND.items():
            given = [f"`{name}`" for name in options if self.given(name)]
            if other != kind and given:
                listed = f"{' and '.join(given)} {'is' if len(given) == 1 else 'are'}"
                asked = f"give `{ASKED_BY[other]}` as well" if other in ASKED_BY else None
                advice = asked if self.kind is None else f"`kind` is {kind}"
                raise ValueError(f"{listed} for {other}: {advice or 'omit it'}")
        check_span(self.span)

    def _named(self, name: str) -> Any:
        return self.estimator_names if name == "estimators" else super()._named(name)

    @property
    def settings(self) -> Settings:
        """The options whose defaults depend on the kind of study, with these in place of None."""
        given = {field.name: getattr(self, field.name) for field in dataclasses.fields(Settings)}
        asked = (kind for kind, option in ASKED_BY.items() if getattr(self, option) is not None)
        given["kind"] = self.kind or next(asked, DEFAULT_KIND)
        return Settings(**{name: value for name, value in given.items() if value is not None})

    def given(self, name: str) -> bool:
        """Whether a field differs from its default."""
        return getattr(self, name) != self.default(name)

    def resolved(self) -> dict[str, Any]:
        """Return all fields, with the defaults of the study's kind in place of None."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        settings = vars(self.settings)
        return fields | {
            name: settings[name] for name in ("kind", *OF_KIND.get(settings["kind"], ())) if name in settings
        }

    @property
    def estimator_names(self) -> tuple[str, ...]:
        """Names of the estimators; `module:class` of objects of your own."""
        return tuple(each if isinstance(each, str) else each.qualified_name() for each in self.estimators)

    @property
    def task_names(self) -> list[str]:
        """Names of the tasks."""
        return [which if isinstance(which, str) else which.name for which in self.tasks]

    @property
    def surrogate(self) -> bool:
        """Whether any contact model uses the derivatives of another."""
        return any(family != "none" for family in self.backward)

    @property
    def batches(self) -> int:
        """Number of seeds, given or by default."""
        return self.seeds or SEEDS.get(self.settings.kind, 10)


def refuse_repeats(label: str, values: Sequence[object]) -> None:
    """Raise ValueError for a value that occurs twice."""
    repeated = {str(value) for value, count in Counter(values).items() if count > 1}
    if repeated:
        raise ValueError(f"{label} given twice: {', '.join(sorted(repeated))}")


def check_span(span: Sequence[float] | None) -> None:
    """Raise ValueError unless span is None or two numbers in ascending order."""
    if span is not None and not (len(span) == 2 and 0 < span[1] - span[0] < math.inf):
        raise ValueError("`span` must be two numbers, the lower one first; got " + ", ".join(map(str, span)))
