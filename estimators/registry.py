"""The estimator protocol, the batches that estimators use, and estimators by name: built-in and user-defined ones."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import jax
from jaxtyping import Array, Float, Key

from estimators.batches import GradientEstimate, Objective
from estimators.choices import CATALOGUE, LEAVE_ONE_OUT, ORACLES, PLUG_IN, Entry, unknown
from estimators.user_code import MissingModuleError, find_attribute, importable_here

Batches = Mapping[str, Any]
"""Batches by oracle name."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimator(ABC):
    """A formula with its options, applied to batches that several estimators can share.

    A subclass is a frozen dataclass whose fields are its options, checked on construction. Instances are hashable and
    can be static under `jit`.

    Attributes:
        label: Legend label, if other than the name.
        description: One line; by default the first line of the docstring or the catalogue's.
        needs: Oracles in `ORACLES`, in the order of the arguments of `combine`.
        gaussian: Whether the formula holds for Gaussian noise only.
        additive: Whether it holds for noise on theta itself only.
        separable: Whether each row of `parts` depends only on the same row of the batches.
    """

    name: ClassVar[str]
    label: ClassVar[str] = ""
    description: ClassVar[str] = ""
    needs: ClassVar[tuple[str, ...]]
    gaussian: ClassVar[bool] = False
    additive: ClassVar[bool] = False
    separable: ClassVar[bool] = False

    def __init_subclass__(cls, entry: Entry | None = None) -> None:
        """Take name, label, needs and description from a catalogue entry, if given."""
        line = (cls.__doc__ or "").partition("\n")[0].removesuffix(".")
        cls.description = line[:1].lower() + line[1:]
        if entry is not None:
            cls.name, cls.label, cls.needs, cls.description = entry.name, entry.label, entry.needs, entry.description

    @abstractmethod
    def combine(self, *args: Any, **kwargs: Any) -> GradientEstimate:
        """Combine the required batches, one per argument, into an estimate."""

    def __call__(self, batches: Batches) -> GradientEstimate:
        """Compute the estimate from drawn batches.

        Args:
            batches: Batches by name in `ORACLES`; those of order 0 and of order 1 are independent and of the same size.
                Batches that are not required are ignored.

        Raises:
            ValueError: A batch is missing, or batches differ in shape.
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

    def parts(self, *args: Any, **kwargs: Any) -> tuple[GradientEstimate, ...]:
        """Return the one or two estimates that `join` combines; arguments as for `combine`."""
        return (self.combine(*args, **kwargs),)

    def join(self, *args: Any, **kwargs: Any) -> GradientEstimate:
        """Combine the parts, one per argument, into the estimate."""
        (estimate,) = args
        return estimate

    @classmethod
    def place(cls) -> str:
        """Name by which `find_estimator` finds the class: that under which it is registered, or `module:class`."""
        return cls.name if ESTIMATORS.get(cls.name) is cls else f"{cls.__module__}:{cls.__qualname__}"

    @classmethod
    def required(cls) -> tuple[str, ...]:
        """Options without a default."""
        return tuple(field.name for field in dataclasses.fields(cls) if field.default is dataclasses.MISSING)


ESTIMATORS: dict[str, type[Estimator]] = {}
"""Estimators by name; `estimators.choices.CATALOGUE` describes them."""
EstimatorClass = TypeVar("EstimatorClass", bound=type[Estimator])


def register(estimator: EstimatorClass) -> EstimatorClass:
    """Add a class to `ESTIMATORS` and the catalogue; a decorator to apply above that of the dataclass.

    Raises:
        ValueError: The class needs an unknown oracle, or its name is taken.
    """
    _check_class(estimator, estimator.__name__)
    name = estimator.name
    if name in ESTIMATORS:
        raise ValueError(f"there is already an estimator {name!r}: choose another name")
    ESTIMATORS[name] = estimator
    entry = Entry(name, estimator.label, estimator.needs, estimator.description, estimator.required())
    CATALOGUE.setdefault(name, entry)
    return estimator


def label_of(name: str, onset: str = "none") -> str:
    """Label of an estimator in texts and figures, with the onset term that its first-order batch has; that of
    `module:name` is its name."""
    found = ESTIMATORS.get(name)
    label = (found.label if found else "") or name.rpartition(":")[2]
    if onset == "none" or found is None or not any(ORACLES[oracle].order for oracle in found.needs):
        return label
    term = "onset" if onset == "linear" else onset
    if "corrected" in found.needs:
        return label.replace("onset", term)
    return f"{label[:-1]}, {term})" if label.endswith(")") else f"{label} ({term})"


def find_estimator(name: str | Estimator) -> Estimator | type[Estimator]:
    """Look up an estimator by name; an unknown one is a ValueError.

    Args:
        name: Key in `ESTIMATORS`, or `module:attribute` for a user-defined class or object, importable from the current
            directory too. An estimator is its own.
    """
    if isinstance(name, Estimator):
        return name
    if name in ESTIMATORS:
        return ESTIMATORS[name]
    reason = ""
    if ":" in name:
        try:
            with importable_here():
                found = find_attribute(name, "estimator", Estimator)
        except MissingModuleError as error:
            reason = f" ({error})"
        else:
            return _check_class(found, name)
    raise ValueError(unknown("estimator", name, ESTIMATORS, ", or module:name of your own") + reason)


def _check_class(found: Any, place: str) -> Any:
    if not isinstance(found, Estimator) and not (isinstance(found, type) and issubclass(found, Estimator)):
        raise ValueError(f"{place} is neither an Estimator nor an Estimator class, but of type {type(found).__name__}")
    missing = [part for part in ("name", "needs") if not getattr(found, part, None)]
    missing += sorted(getattr(found, "__abstractmethods__", ()))
    if missing:
        raise ValueError(f"{place} has no {' and no '.join(missing)}: an Estimator needs them")
    if others := set(found.needs) - set(ORACLES):
        raise ValueError(f"{place} needs {', '.join(sorted(others))}; the oracles are {', '.join(ORACLES)}")
    return found


def make_estimator(which: str | Estimator, **options: Any) -> Estimator:
    """Return an estimator with its options set.

    Args:
        which: As for `find_estimator`; an object is returned as is.
        **options: Options of this or other estimators. Those it does not have and those that are None are ignored.

    Raises:
        ValueError: There is no such estimator, or a required option is missing or out of range.
    """
    found = find_estimator(which) if isinstance(which, str) else which
    if isinstance(found, Estimator):
        return found
    own = {field.name for field in dataclasses.fields(found)}
    given = {name: value for name, value in options.items() if name in own and value is not None}
    for name in found.required():
        if name not in given:
            raise ValueError(f"{found.name!r} needs the option `{name}`; set it")
    return found(**given)


def oracles_of(estimators: Iterable[Estimator | type[Estimator]], *others: str) -> tuple[str, ...]:
    """Return the oracles that the estimators need, plus the others given, in the order of `ORACLES`."""
    needed = {*others, *(oracle for estimator in estimators for oracle in estimator.needs)}
    return tuple(name for name in ORACLES if name in needed)


def draw(
    oracles: Iterable[str], objective: Objective, theta: Float[Array, " params"], key: Key[Array, ""], num_samples: int
) -> dict[str, Any]:
    """Draw batches by name in `ORACLES`; those of order 0 and those of order 1 use separate sets of keys.

    Args:
        oracles: Names in `ORACLES`; those of the same order share their samples.
        objective: Objective to sample.
        theta: Parameters, [param].
        key: Random key; consumed.
        num_samples: Samples per batch, >= 1.

    Raises:
        ValueError: The objective lacks a method that an oracle calls.
    """
    return draw_at(oracles, objective, theta, sample_keys(key, num_samples))


def sample_keys(key: Key[Array, ""], num_samples: int) -> list[Key[Array, " samples"]]:
    """Split a key into the sample keys of each order, as `draw` does."""
    return [jax.random.split(order_key, num_samples) for order_key in jax.random.split(key)]


def draw_at(
    oracles: Iterable[str],
    objective: Objective,
    theta: Float[Array, "*samples params"],
    keys: Sequence[Key[Array, " samples"]],
) -> dict[str, Any]:
    """Draw with keys from `sample_keys`; theta may have one row per sample if the objective supports it."""
    batches = {}
    for name in oracles:
        oracle = ORACLES[name]
        method = getattr(objective, oracle.method, None)
        if method is None:
            raise ValueError(f"{type(objective).__name__} has no method {oracle.method} for {oracle.phrase}")
        batches[name] = method(theta, jax.random.clone(keys[oracle.order]))  # shared on purpose
    return batches


def estimate(
    estimator: str | Estimator,
    objective: Objective,
    theta: Float[Array, " params"],
    key: Key[Array, ""],
    num_samples: int,
) -> GradientEstimate:
    """Draw only the batches that an estimator needs, and estimate grad F(theta).

    The two orders use independent keys; for the same key, each order's samples are the same for every estimator.

    Args:
        estimator: Estimator object, or the name of one whose options are left at their defaults.
        objective: F, with the methods that the estimator's oracles call.
        theta: Parameters, [param].
        key: Random key; consumed.
        num_samples: Samples per batch, >= 1.

    Raises:
        ValueError: The name is unknown, an option or a method of the objective is missing, `num_samples` is below 1, or
            theta has the wrong length.
    """
    estimator = make_estimator(estimator)
    if num_samples < 1:
        raise ValueError(f"num_samples must be at least 1, and at least 2 for a variance; got {num_samples}")
    if theta.shape != (objective.num_params,):
        raise ValueError(f"theta must have shape ({objective.num_params},), the objective's; got {theta.shape}")
    return estimator(draw(estimator.needs, objective, theta, key, num_samples))
