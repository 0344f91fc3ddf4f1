"""The estimator protocol, and the batches that estimators use."""

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Final

import jax
from jaxtyping import Array, Float, Key

from estimators.catalogue import LEAVE_ONE_OUT, PLUG_IN, Entry
from estimators.types import GradientEstimate, Objective


@dataclasses.dataclass(frozen=True)
class Oracle:
    """A kind of batch.

    Attributes:
        name: In `ORACLES`, and in an estimator's `needs`.
        order: 0 if only values are needed, 1 if derivatives; batches of one order share their samples.
        method: Of the objective, called with theta and keys.
        phrase: What messages call the batch.
    """

    name: str
    order: int
    method: str
    phrase: str


ORACLES: Final[dict[str, Oracle]] = {
    oracle.name: oracle
    for oracle in (
        Oracle("evaluation", 0, "evaluate", "a zeroth-order batch"),
        Oracle("pair", 0, "evaluate_pair", "a zeroth-order batch of pairs"),
        Oracle("steps", 0, "evaluate_steps", "a zeroth-order batch step by step"),
        Oracle("step_pair", 0, "evaluate_step_pair", "a zeroth-order batch of pairs step by step"),
        Oracle("differentiation", 1, "differentiate", "a first-order batch"),
        Oracle("corrected", 1, "differentiate_corrected", "a first-order batch corrected where contact begins"),
        Oracle("step_differentiation", 1, "differentiate_steps", "a first-order batch step by step"),
        Oracle("linearisation", 1, "linearise", "a first-order batch with the derivatives of its steps"),
    )
}

Batches = Mapping[str, Any]
"""Batches by the name of their oracle."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimator(ABC):
    """A formula with its options: a function from batches already drawn, which several estimators can share.

    A subclass is a frozen dataclass whose fields are its options, checked when it is made. It is hashable, so that it
    can be static under `jit`.

    Attributes:
        label: For a legend, where that is not the name.
        description: One line; the first of the docstring, unless the catalogue has it.
        needs: Oracles in `ORACLES`, in the order in which `combine` takes their batches.
        gaussian: Whether the formula holds for Gaussian noise only.
        additive: Whether it holds for noise on theta itself only.
        separable: Whether each row of `parts` depends on the batches' samples of that row alone.
    """

    name: ClassVar[str]
    label: ClassVar[str] = ""
    description: ClassVar[str] = ""
    needs: ClassVar[tuple[str, ...]]
    gaussian: ClassVar[bool] = False
    additive: ClassVar[bool] = False
    separable: ClassVar[bool] = False

    def __init_subclass__(cls, entry: Entry | None = None) -> None:
        """Take name, label, needs and description from an entry of the catalogue, where one is given."""
        line = (cls.__doc__ or "").partition("\n")[0].removesuffix(".")
        cls.description = line[:1].lower() + line[1:]
        if entry is not None:
            cls.name, cls.label, cls.needs, cls.description = entry.name, entry.label, entry.needs, entry.description

    @abstractmethod
    def combine(self, *args: Any, **kwargs: Any) -> GradientEstimate:
        """The estimate from the batches that are needed, each an argument."""

    def __call__(self, batches: Batches) -> GradientEstimate:
        """Make an estimate of batches already drawn.

        Args:
            batches: By the names in `ORACLES`; those of order 0 independent of those of order 1 and of the same size.
                What is not needed is not looked at.

        Raises:
            ValueError: A batch is missing, or batches differ in shape.
        """
        return self.combine(*self.pick(batches))

    def pick(self, batches: Batches) -> list[Any]:
        """The batches that are needed, in the order of `needs`.

        Raises:
            ValueError: One is missing.
        """
        for oracle in self.needs:
            if batches.get(oracle) is None:
                method, phrase = ORACLES[oracle].method, ORACLES[oracle].phrase
                raise ValueError(
                    f"{self.name!r} needs {phrase}; got none; pass what objective.{method} returns as {oracle!r}"
                )
        return [batches[oracle] for oracle in self.needs]

    @property
    def mergeable(self) -> bool:
        """Whether a batch may come in blocks: `join` of the merged `parts` of all of them is the estimate."""
        apart = getattr(self, "baseline", None) != LEAVE_ONE_OUT and getattr(self, "weights", PLUG_IN) == PLUG_IN
        return self.separable and apart

    def parts(self, *args: Any, **kwargs: Any) -> tuple[GradientEstimate, ...]:
        """The estimates, one or two, that `join` makes the estimate of; arguments as of `combine`."""
        return (self.combine(*args, **kwargs),)

    def join(self, *args: Any, **kwargs: Any) -> GradientEstimate:
        """The estimate from its parts, each an argument."""
        (estimate,) = args
        return estimate

    @classmethod
    def required(cls) -> tuple[str, ...]:
        """Options without a default."""
        return tuple(field.name for field in dataclasses.fields(cls) if field.default is dataclasses.MISSING)


def oracles_of(estimators: Iterable[Estimator | type[Estimator]], *others: str) -> tuple[str, ...]:
    """Oracles that some estimators need, and others, in the order of `ORACLES`."""
    needed = {*others, *(oracle for estimator in estimators for oracle in estimator.needs)}
    return tuple(name for name in ORACLES if name in needed)


def draw(
    oracles: Iterable[str], objective: Objective, theta: Float[Array, " params"], key: Key[Array, ""], num_samples: int
) -> dict[str, Any]:
    """Draw batches, those of order 0 from one set of keys and those of order 1 from another.

    Args:
        oracles: Names in `ORACLES`; all of one order share their samples.
        objective: What to draw from.
        theta: Where, [param].
        key: Source of all randomness; used up.
        num_samples: Samples in each batch, >= 1.

    Returns:
        The batches by name.

    Raises:
        ValueError: The objective lacks what an oracle calls.
    """
    return draw_at(oracles, objective, theta, sample_keys(key, num_samples))


def sample_keys(key: Key[Array, ""], num_samples: int) -> list[Key[Array, " samples"]]:
    """Keys of the samples of each order, as `draw` makes them of one key."""
    return [jax.random.split(order_key, num_samples) for order_key in jax.random.split(key)]


def draw_at(
    oracles: Iterable[str],
    objective: Objective,
    theta: Float[Array, "*samples params"],
    keys: Sequence[Key[Array, " samples"]],
) -> dict[str, Any]:
    """`draw` with the keys of `sample_keys`; theta may be one for each sample where the objective takes that."""
    batches = {}
    for name in oracles:
        oracle = ORACLES[name]
        method = getattr(objective, oracle.method, None)
        if method is None:
            raise ValueError(f"{type(objective).__name__} has no {oracle.method}, which {oracle.phrase} comes from")
        batches[name] = method(theta, jax.random.clone(keys[oracle.order]))  # shared on purpose
    return batches
