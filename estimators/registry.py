"""Estimators by name: built-in, registered and user-defined ones."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import estimators.builtin  # noqa: F401  # registers its classes
from estimators.choices import ORACLES, unknown
from estimators.estimator import ESTIMATORS, Estimator, check_class
from estimators.user_code import MissingModuleError, find_attribute, importable_here


def find_estimator(name: str | Estimator) -> Estimator | type[Estimator]:
    """Look up an estimator by name; an unknown one is a ValueError.

    Args:
        name: Key in `ESTIMATORS`, or `module:attribute` for a user-defined class or object, importable from the current
            directory too. An estimator is returned as is.
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
            return check_class(found, name)
    raise ValueError(unknown("estimator", name, ESTIMATORS, ", or module:name of your own") + reason)


def make_estimator(which: str | Estimator, **options: Any) -> Estimator:
    """Return an estimator, looked up as by `find_estimator`, with those of the options that it has and are not None.

    Raises:
        ValueError: There is no such estimator, or a required option is missing or out of range.
    """
    found = find_estimator(which)
    if isinstance(found, Estimator):
        return found
    names = {field.name for field in dataclasses.fields(found)}
    given = {name: value for name, value in options.items() if name in names and value is not None}
    for name in found.required():
        if name not in given:
            raise ValueError(f"{found.name!r} needs the option `{name}`; set it")
    return found(**given)


def oracles_of(estimators: Iterable[Estimator | type[Estimator]], *others: str) -> tuple[str, ...]:
    """Return the oracles that the estimators need, plus the others given, in the order of `ORACLES`."""
    needed = {*others, *(oracle for estimator in estimators for oracle in estimator.needs)}
    return tuple(name for name in ORACLES if name in needed)


def options_of_estimators(*names: str) -> dict[str, dataclasses.Field[Any]]:
    """Return the options that registered estimators declare, by default all of them; the first declaration of each."""
    found: dict[str, dataclasses.Field[Any]] = {}
    for estimator in map(ESTIMATORS.__getitem__, names or ESTIMATORS):
        for field in dataclasses.fields(estimator):
            if "line" in field.metadata:
                found.setdefault(field.name, field)
    return found


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


def markdown_table() -> str:
    """Table of all registered estimators, as in docs/estimators.md."""
    rows = [f"| `{name}` | {each.formula} | {each.unbiased} |" for name, each in ESTIMATORS.items()]
    return "\n".join(["| name | sample | unbiased |", "|---|---|---|", *rows])
