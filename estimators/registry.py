"""Built-in (`estimators.builtin`) and user-defined estimators by name, and a uniform way to run them."""

import dataclasses
from typing import Any, TypeVar

from jaxtyping import Array, Float, Key

from estimators.catalogue import CATALOGUE, Entry
from estimators.estimator import ORACLES, Estimator, draw
from estimators.places import MissingModuleError, find_attribute, importable_here
from estimators.types import GradientEstimate, Objective

ESTIMATORS: dict[str, type[Estimator]] = {}
"""Estimators by name; `estimators.catalogue.CATALOGUE` describes them."""
EstimatorClass = TypeVar("EstimatorClass", bound=type[Estimator])


def register(estimator: EstimatorClass) -> EstimatorClass:
    """Add a class to `ESTIMATORS` and the catalogue; a decorator to apply above that of the dataclass.

    Raises:
        ValueError: The class needs an unknown oracle, or its name is taken.
    """
    _check_class(estimator, estimator.__name__)
    if estimator.name in ESTIMATORS:
        raise ValueError(f"there is already an estimator {estimator.name!r}: choose another name")
    ESTIMATORS[estimator.name] = estimator
    name, label = estimator.name, estimator.label
    entry = Entry(name, label, estimator.needs, estimator.description, estimator.required())
    CATALOGUE.setdefault(name, entry)
    return estimator


def find_estimator(name: str) -> Estimator | type[Estimator]:
    """Look up an estimator by name.

    Args:
        name: Key in `ESTIMATORS`, or `module:attribute` for a user-defined class or object, importable from the current
            directory too.

    Raises:
        ValueError: There is no such estimator.
    """
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
    raise ValueError(
        f"estimator must be one of {', '.join(ESTIMATORS)}, or module:name of your own{reason}; got {name!r}"
    )


def _check_class(found: Any, place: str) -> Any:
    if not isinstance(found, Estimator) and not (isinstance(found, type) and issubclass(found, Estimator)):
        raise ValueError(f"{place} is neither an Estimator nor an Estimator class, but of type {type(found).__name__}")
    missing = [part for part in ("name", "needs") if not getattr(found, part, None)]
    missing += sorted(getattr(found, "__abstractmethods__", ()))
    if missing:
        raise ValueError(f"{place} has no {' and no '.join(missing)}: an Estimator needs them")
    if unknown := set(found.needs) - set(ORACLES):
        raise ValueError(f"{place} needs {', '.join(sorted(unknown))}; the oracles are {', '.join(ORACLES)}")
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
            raise ValueError(f"{found.name!r} needs the option {name}; set it")
    return found(**given)


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
