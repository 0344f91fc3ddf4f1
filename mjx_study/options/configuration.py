"""The configuration of a study: every option is declared here once.

The command line, its help, TOML files and Python are checked against these declarations. A dataclass holds them rather
than a pydantic model, since the parser needs them and pydantic alone would add two thirds to the time of `--version`.
"""

import dataclasses
import itertools
from collections import ChainMap, Counter
from collections.abc import Collection, Mapping
from dataclasses import MISSING
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar, Union, runtime_checkable

from estimators.choices import DENSITIES
from estimators.registry import ESTIMATORS, options_of_estimators
from mjx_study.choices import CONES, FAMILIES, INTEGRATORS, KINDS, ONSETS, REFERENCE, SOLVERS
from mjx_study.limits import MOST_PARAMS
from mjx_study.options.option import MAX_VALUES, OptionError, Rows, check_span, declared, options_of, reject_untaken

if TYPE_CHECKING:
    import estimators.estimator

Config = TypeVar("Config")
ESTIMATOR_OPTIONS: Final = {name: field for name, field in options_of_estimators().items() if name != "sigma"}
"""Options that estimators declare, by name; `sigma` is that of the noise."""
REQUIRED_OPTIONS: Final = tuple(name for name, field in ESTIMATOR_OPTIONS.items() if field.default is MISSING)
"""Those without which an estimator that has them cannot be made."""
CONTACTS: Final[Collection[str]] = ChainMap[str, Any]({REFERENCE: None}, FAMILIES)
"""Contact families of a study, those added later included, and the analytic reference."""
UNSET_TASK: Final = "the task's"
UNSET_MJCF: Final = "the MJCF's"
DEFAULT_KIND: Final = "gradients"
ASKED_BY: Final = {"descents": "iterations", "landscapes": "points"}
"""Options that ask for a kind of study where none is given."""
NEEDED: Final = {"landscapes": "points"}  # options without which there is no such study
SAMPLES: Final = 100
"""Samples per batch unless the configuration or a recipe sets another number."""
AXES: Final = (
    *("tasks", "estimators", "contact", "stiffness", "solref", "solimp"),
    *("timestep", "cone", "sigma", "samples", "backward"),
)
"""Options whose values must be distinct."""
MAY_BE_EMPTY: Final = ("contact", "solref", "solimp")
SCENE_OPTIONS: Final = {
    "integrator": "integrator",
    "solver": "solver",
    "solver_iterations": "iterations",
    "solver_ls_iterations": "ls_iterations",
    "disable_flag": "disable_flags",
}
"""Options that override an MJCF's <option>, so that a model can be adapted to MJX without editing its file, and the
arguments of `load_scene` that they set."""
BUILDER_OPTIONS: Final = ("horizon", "model", *SCENE_OPTIONS)
"""Options passed to the builder of a task."""


def of_estimators(name: str, **changes: Any) -> Any:
    """Declare an option as the estimators that have it do, with changes."""
    field = ESTIMATOR_OPTIONS[name]
    about = {"default": None if field.default is MISSING else field.default, **field.metadata} | changes
    about.pop("example")
    return declared(**about)


def with_options_of_estimators(configuration: type[Config]) -> type[Config]:
    """Add the options that estimators declare and a configuration does not; None for an estimator's default."""
    for name, field in ESTIMATOR_OPTIONS.items():
        if name not in configuration.__annotations__:
            kind: Any = field.type
            configuration.__annotations__[name] = kind | None
            usual = "" if field.default is MISSING else str(field.default)
            setattr(configuration, name, of_estimators(name, default=None, unset=usual))
    return configuration


@runtime_checkable
class NamedTask(Protocol):
    """A task given as an object, a `mjx_study.Task`."""

    @property
    def name(self) -> str: ...


@dataclasses.dataclass(frozen=True)
class Settings:
    """Options of a configuration with their defaults in place of None; those of other kinds of study have no effect."""

    kind: str
    points: int = 1
    reference_samples: int = 600
    evaluation_samples: int = 200


def read_solref(text: str) -> Rows:
    """Every number of the first column with every one of the second; columns are separated by ;."""
    columns = [OPTIONS["theta"].parse(column) for column in text.split(";")]
    if len(columns) != 2:
        raise ValueError(f"must be two columns separated by ;, such as -1000,-10000;-5, got {len(columns)}")
    if len(columns[0]) * len(columns[1]) > MAX_VALUES:
        raise ValueError(f"takes at most {MAX_VALUES} contact models, got {len(columns[0]) * len(columns[1])}")
    return tuple(itertools.product(*columns))


def read_solimp(text: str) -> Rows:
    """Rows of numbers, separated by ;."""
    return tuple(OPTIONS["theta"].parse(row) for row in text.split(";"))


@dataclasses.dataclass(frozen=True, kw_only=True)
@with_options_of_estimators
class StudyConfig:
    """Everything that determines a study of gradient estimates, descents or landscapes.

    A field that is None takes the default in parentheses. Landscapes need `points`, and descents `iterations` or
    `kind`. Tasks and estimators given as objects keep their options.
    """

    tasks: tuple[str | NamedTask, ...] = dataclasses.field(
        metadata={"metavar": "TASK", "line": "names of tasks, or tasks", "allows_user_code": True}
    )
    kind: str | None = declared(
        None, "KIND", "kind of study: {}", choices=KINDS, unset="from --iterations and --points"
    )
    estimators: tuple[Union[str, "estimators.estimator.Estimator"], ...] = declared(
        ("zobg", "fobg", "aobg"), "NAME", "see `mjx-study estimators`", choices=ESTIMATORS, allows_user_code=True
    )
    theta: tuple[float, ...] | None = declared(
        None, "X", "policy parameters", "(-inf, inf)", unset=UNSET_TASK, most=MOST_PARAMS
    )
    network: tuple[int, ...] | None = declared(
        None, "N", "hidden widths of a tanh network that replaces the policy", "[1, 100000]", study="descents"
    )
    contact: tuple[str, ...] | None = declared(None, "FAMILY", "contact family: {}", choices=CONTACTS, unset=UNSET_TASK)
    stiffness: tuple[float, ...] | None = declared(
        None, "K", "contact stiffness", "(0, inf)", unit="N/m", unset=UNSET_TASK
    )
    damping: float | None = declared(None, "B", "contact damping", "[0, inf)", unit="N s/m", unset="the family's")
    smoothing: float | None = declared(
        None, "KAPPA", "smoothing of laws other than MuJoCo's", "[0, inf)", unit="J", unset="the family's"
    )
    solref: Rows = declared(
        (), "A;B", "contact models in MuJoCo's terms, every A with every B", "(-inf, inf)", read_rows=read_solref
    )
    solimp: Rows = declared(
        (), "D0,D1,W,M,P", "solimp to combine with them; several separated by ;", "(-inf, inf)", read_rows=read_solimp
    )
    timestep: tuple[float, ...] | None = declared(None, "H", "timestep", "(0, 1)", unit="s", unset=UNSET_MJCF)
    cone: tuple[str, ...] | None = declared(None, "CONE", "friction cone: {}", choices=CONES, unset=UNSET_MJCF)
    sigma: tuple[float, ...] | None = declared(
        None, "S", "standard deviation of the noise", "(0, inf)", unset=UNSET_TASK
    )
    samples: tuple[int, ...] | None = declared(
        None, "N", "samples in each batch", "[3, 1e7]", unset=f"{SAMPLES}; of descents, the task's"
    )
    confidence: float = declared(0.95, "P", "confidence level of the intervals", "(0, 1)", study="gradients")
    seeds: int = declared(1, "N", "number of batches, or of descents", "[1, 100000]")
    iterations: int | None = declared(
        None, "N", "iterations of the optimiser", "[1, 10000000]", study="descents", unset=UNSET_TASK
    )
    points: int | None = declared(None, "N", "points on the line", "[2, 100000]", study="landscapes")
    span: tuple[float, ...] | None = declared(
        None, "LO,HI", "range of the line", "(-inf, inf)", study="landscapes", unset=UNSET_TASK
    )
    direction: str | None = declared(None, "DIR", "random, or a parameter's index", study="landscapes", unset="random")
    optimizer: str | None = declared(None, "NAME", "optax optimiser", study="descents", unset=UNSET_TASK)
    learning_rate: float | None = declared(None, "R", "learning rate", "(0, inf)", study="descents", unset=UNSET_TASK)
    decay: float | None = declared(
        None, "A", "learning rate / i^A at iteration i", "[0, 2]", study="descents", unset=UNSET_TASK
    )
    stiffness_schedule: str | None = declared(
        None, "CALL", "factor on the stiffness by iteration, an optax schedule", study="descents", unset="1"
    )
    sigma_schedule: str | None = declared(
        None, "CALL", "factor on sigma by iteration, an optax schedule", study="descents", unset="1"
    )
    reference_samples: int | None = declared(
        None,
        "N",
        "pairs of rollouts for each reference",
        "[3, 1e7]",
        study="gradients",
        unset="600 to 19,200, until its uncertainty is 5 %",
    )
    evaluation_samples: int | None = declared(
        None, "N", "rollouts for the cost of a final policy", "[2, 1e7]", study="descents", unset="200"
    )
    seed: int = declared(0, "N", "random seed", "[0, 4294967295]")
    noise: str | None = declared(None, "NAME", "noise density: {}", choices=DENSITIES, unset=UNSET_TASK)
    baseline: str = of_estimators("baseline")
    gamma: float | None = of_estimators("gamma", default=None, unset=UNSET_TASK)
    published: bool = declared(
        False, "", "use the published example's gamma, failure probability, variance proxy and radius"
    )
    failure_probability: float = of_estimators("failure_probability")
    variance_proxy: str = of_estimators("variance_proxy")
    radius: str | float = of_estimators("radius")
    max_norm: float | None = of_estimators("max_norm")
    window: int | None = of_estimators("window")
    tolerance: float = of_estimators("tolerance")
    weights: str = of_estimators("weights")
    onset: str = declared("none", "NAME", "onset term of first-order gradients: none, linear, or shift", choices=ONSETS)
    backward: tuple[str, ...] = declared(
        ("none",), "FAMILY", "contact whose derivatives are taken", choices=("none", *FAMILIES)
    )
    backward_stiffness: float | None = declared(
        None, "K", "stiffness of --backward", "(0, inf)", unit="N/m", unset="unchanged"
    )
    backward_margin: float | None = declared(
        None, "M", "distance where --backward begins", "(0, inf)", unit="m", unset=UNSET_MJCF
    )
    horizon: int | None = declared(None, "H", "number of steps", "[1, 1000000]", unset=UNSET_TASK)
    model: str | None = declared(None, "FILE.xml", "MJCF that replaces that of the task")
    integrator: str | None = declared(None, "NAME", "integrator: {}", choices=INTEGRATORS, unset=UNSET_MJCF)
    solver: str | None = declared(None, "NAME", "constraint solver: {}", choices=SOLVERS, unset=UNSET_MJCF)
    solver_iterations: int | None = declared(None, "N", "iterations of the solver", "[1, 100000]", unset=UNSET_MJCF)
    solver_ls_iterations: int | None = declared(
        None, "N", "iterations of the solver's line search", "[1, 100000]", unset=UNSET_MJCF
    )
    disable_flag: tuple[str, ...] | None = declared(None, "FLAG", "flags to disable, named as in the MJCF's <flag>")
    chunk_size: int | None = declared(
        None, "N", "samples per device and call; native code has its own", "[1, 1e7]", unset="by the samples"
    )
    block_size: int | None = declared(
        None, "N", "samples held at once", "[2, 1e7]", study="gradients", unset="all, if they fit"
    )

    def __post_init__(self) -> None:
        for name, option in OPTIONS.items():
            if (value := self._named(name)) is not None or option.default is not None:
                option.check(value)
        for name in AXES:
            values = self._named(name)
            if repeated := [str(value) for value, count in Counter(values or ()).items() if count > 1]:
                raise OptionError(name, f"has {', '.join(sorted(repeated))} twice")
            if values is not None and not values and name not in MAY_BE_EMPTY:
                raise OptionError(name, "must have at least one value")
        if self.theta is not None and len(self.tasks) > 1:
            raise OptionError("theta", "is for a single task: give one task, or omit it")
        if self.contact is not None:
            given = {name: getattr(self, name) for name in ("stiffness", "damping", "smoothing")}
            reject_untaken(self.contact, **given)
        check_span(self.span)
        self._check_derivatives()
        self._check_kind()

    def _check_derivatives(self) -> None:
        if self.surrogate and self.onset != "none":
            raise OptionError("onset", "corrects exact derivatives: omit it or {}", "backward")
        for name in () if self.surrogate else ("backward_stiffness", "backward_margin"):
            if getattr(self, name) is not None:
                raise OptionError(name, "needs a contact family in {}", "backward")

    def _check_kind(self) -> None:
        kind = self.settings.kind
        if self.iterations is not None and self.points is not None:
            raise OptionError("iterations", "is for descents and {} for landscapes: omit one of them", "points")
        if kind in NEEDED and not self.given(NEEDED[kind]):
            raise OptionError(NEEDED[kind], f"must be given for {kind}")
        for name, option in OPTIONS.items():
            if option.study in ("", kind) or not self.given(name):
                continue
            if self.kind is not None:
                raise OptionError(name, f"is for {option.study}, and {{}} is {kind}: omit one of them", "kind")
            if option.study not in ASKED_BY:
                raise OptionError(name, f"is for {option.study}: omit it")
            raise OptionError(name, f"is for {option.study}: give {{}} as well", ASKED_BY[option.study])

    def _named(self, name: str) -> Any:
        """Value of a field, with names in place of objects."""
        value = getattr(self, name)
        if name in ("tasks", "estimators") and not isinstance(value, str):
            return self.task_names if name == "tasks" else self.estimator_names
        return value

    @property
    def settings(self) -> Settings:
        """The options whose defaults depend on the kind of study, with these in place of None."""
        given = {field.name: getattr(self, field.name) for field in dataclasses.fields(Settings)}
        asked = (kind for kind, option in ASKED_BY.items() if getattr(self, option) is not None)
        given["kind"] = self.kind or next(asked, DEFAULT_KIND)
        return Settings(**{name: value for name, value in given.items() if value is not None})

    def given(self, name: str) -> bool:
        """Whether a field differs from its default."""
        return getattr(self, name) != OPTIONS[name].default

    def resolved(self) -> dict[str, Any]:
        """Return all fields, with the defaults of the study's kind in place of None."""
        settings, fields = vars(self.settings), dict(vars(self))
        return fields | {
            name: value for name, value in settings.items() if name == "kind" or OPTIONS[name].study == settings["kind"]
        }

    @property
    def estimator_names(self) -> tuple[str, ...]:
        """Names of the estimators; `module:class` for user-defined objects."""
        return tuple(each if isinstance(each, str) else each.qualified_name() for each in self.estimators)

    @property
    def task_names(self) -> list[str]:
        return [each.name if isinstance(each, NamedTask) else each for each in self.tasks]

    @property
    def surrogate(self) -> bool:
        """Whether any contact model uses the derivatives of another."""
        return any(family != "none" for family in self.backward)


OPTIONS: Final = options_of(StudyConfig)
"""Every option of a study by its name."""
StudyConfig.__doc__ = "\n".join(
    [
        f"{StudyConfig.__doc__}",
        "    Attributes:",
        *(f"        {name}: {each.describe()}" for name, each in OPTIONS.items()),
    ]
)


def as_arguments(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options that are not None, as arguments of `make_task` and `load_scene`."""
    return {SCENE_OPTIONS.get(name, name): value for name, value in options.items() if value is not None}
