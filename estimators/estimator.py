"""The base class of estimators, and their options.

Nothing here computes. An estimator describes itself, so listing estimators must import neither JAX nor NumPy: the
modules of the built-in classes import both only when an estimate is computed.
"""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from estimators.choices import LEAVE_ONE_OUT, ORACLES, PLUG_IN, unknown
from estimators.intervals import Interval

if TYPE_CHECKING:
    import estimators.batches

Batches = Mapping[str, Any]
"""Batches by oracle name."""


def option(
    line: str, interval: str = "", *, choices: Collection[str] = (), default: Any = dataclasses.MISSING,
    example: Any = None, metavar: str = "NAME", unit: str = "",
) -> Any:  # fmt: skip
    """Declare an option of an estimator: a dataclass field that is checked on construction.

    Args:
        line: One line for the help, in which {} stands for the choices.
        interval: Range of its numbers, such as "(0, inf)".
        choices: Accepted names, in addition to numbers if there is an interval.
        default: Value unless another is given; without one, the option is required.
        example: Value in examples, for a required option.
        metavar: Placeholder for a value in the help.
        unit: Unit of its numbers.
    """
    described = {"line": line, "interval": interval, "choices": choices, "metavar": metavar, "unit": unit}
    return dataclasses.field(default=default, metadata=described | {"example": example})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimator(ABC):
    """A formula with its options, applied to batches that several estimators can share.

    A subclass is a frozen dataclass whose fields are its options; those declared by `option` are checked on
    construction. Instances are hashable and can be static under `jit`. The first line of the docstring is the
    description.

    Attributes:
        name: Name on the command line and in files.
        label: Legend label of a registered estimator, if other than the name.
        needs: Oracles in `ORACLES`, in the order of the arguments of `combine`.
        formula: Gradient of one sample, in Markdown with LaTeX.
        unbiased: When the estimate is unbiased, in Markdown.
        style: Colour and marker in figures; by default chosen by the name.
        gaussian: Whether the formula holds for Gaussian noise only.
        additive: Whether it holds for noise on theta itself only.
        separable: Whether each row of `parts` depends only on the same row of the batches.
    """

    name: ClassVar[str]
    label: ClassVar[str] = ""
    description: ClassVar[str] = ""
    needs: ClassVar[tuple[str, ...]]
    formula: ClassVar[str] = ""
    unbiased: ClassVar[str] = ""
    style: ClassVar[tuple[str, str] | None] = None
    gaussian: ClassVar[bool] = False
    additive: ClassVar[bool] = False
    separable: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        line = (cls.__doc__ or "").partition("\n")[0].removesuffix(".")
        cls.description = line[:1].lower() + line[1:]

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            interval, value = field.metadata.get("interval"), getattr(self, field.name)
            if isinstance(value, str):
                if (choices := field.metadata.get("choices")) and value not in choices:
                    more = ", or give a number" if interval else ""
                    raise ValueError(unknown(field.name.replace("_", " "), value, choices, more))
            elif interval and value not in Interval(interval):
                raise ValueError(f"{field.name} must be {Interval(interval)}; got {value}")

    @abstractmethod
    def combine(self, *args: Any, **kwargs: Any) -> "estimators.batches.GradientEstimate":
        """Combine the required batches, one per argument, into an estimate."""

    def __call__(self, batches: Batches) -> "estimators.batches.GradientEstimate":
        """Compute the estimate from drawn batches; those of order 0 and of order 1 are independent, of the same size.

        Raises:
            ValueError: A batch is missing, or batches differ in shape. Those that are not required are ignored.
        """
        return self.combine(*self.pick(batches))

    def pick(self, batches: Batches) -> list[Any]:
        """Return the required batches in the order of `needs`; a missing one is a ValueError."""
        for oracle in self.needs:
            if batches.get(oracle) is None:
                method, phrase = ORACLES[oracle].method, ORACLES[oracle].phrase
                raise ValueError(
                    f"{self.name!r} needs {phrase}; got none; pass what objective.{method} returns as {oracle!r}"
                )
        return [batches[oracle] for oracle in self.needs]

    @property
    def mergeable(self) -> bool:
        """Whether batches may come in blocks: the estimate is `join` of all blocks' merged `parts`."""
        apart = getattr(self, "baseline", None) != LEAVE_ONE_OUT and getattr(self, "weights", PLUG_IN) == PLUG_IN
        return self.separable and apart

    def parts(self, *args: Any, **kwargs: Any) -> "tuple[estimators.batches.GradientEstimate, ...]":
        """Return the one or two estimates that `join` combines; arguments as for `combine`."""
        return (self.combine(*args, **kwargs),)

    def join(self, *args: Any, **kwargs: Any) -> "estimators.batches.GradientEstimate":
        """Combine the parts, one per argument, into the estimate."""
        (estimate,) = args
        return estimate

    @classmethod
    def qualified_name(cls) -> str:
        """Name by which `find_estimator` finds the class: that under which it is registered, or `module:class`."""
        return cls.name if ESTIMATORS.get(cls.name) is cls else f"{cls.__module__}:{cls.__qualname__}"

    @classmethod
    def own_label(cls) -> str:
        """Label that the class itself has; one that it inherits is of another estimator."""
        return vars(cls).get("label", "")

    @classmethod
    def required(cls) -> tuple[str, ...]:
        """Options without a default."""
        return tuple(field.name for field in dataclasses.fields(cls) if field.default is dataclasses.MISSING)

    @classmethod
    def example(cls) -> "Estimator":
        """Return an instance, with the examples of its required options."""
        required = {field.name: field for field in dataclasses.fields(cls) if field.name in cls.required()}
        return cls(**{name: field.metadata.get("example") for name, field in required.items()})


ESTIMATORS: dict[str, type[Estimator]] = {}
"""Registered estimators by name; those of `estimators.builtin` once it is imported."""
EstimatorClass = TypeVar("EstimatorClass", bound=type[Estimator])


def register(estimator: EstimatorClass) -> EstimatorClass:
    """Add a class to `ESTIMATORS`, and so to commands, tables and figures; a decorator above that of the dataclass.

    Raises:
        ValueError: The class needs an unknown oracle, or its name is taken.
    """
    check_class(estimator, estimator.__name__)
    if estimator.name in ESTIMATORS:
        raise ValueError(f"there is already an estimator {estimator.name!r}: choose another name")
    ESTIMATORS[estimator.name] = estimator
    return estimator


def check_class(found: Any, name: str) -> Any:
    """Return an estimator or its class; a ValueError for anything else, or where something required is missing."""
    if not isinstance(found, Estimator) and not (isinstance(found, type) and issubclass(found, Estimator)):
        raise ValueError(f"{name} is neither an Estimator nor an Estimator class, but of type {type(found).__name__}")
    missing = [part for part in ("name", "needs") if not getattr(found, part, None)]
    missing += sorted(getattr(found, "__abstractmethods__", ()))
    if missing:
        raise ValueError(f"{name} has no {' and no '.join(missing)}: an Estimator needs them")
    if others := set(found.needs) - set(ORACLES):
        raise ValueError(f"{name} needs {', '.join(sorted(others))}; the oracles are {', '.join(ORACLES)}")
    return found
