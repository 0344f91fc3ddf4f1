"""Options that estimators declare, as those of a configuration."""

from dataclasses import MISSING
from typing import Any, Final, TypeVar

from estimators.registry import options_of_estimators
from mjx_study.options.option import declared

ConfigT = TypeVar("ConfigT")
ESTIMATOR_OPTIONS: Final = {name: field for name, field in options_of_estimators().items() if name != "sigma"}
"""Options that estimators declare, by name; `sigma` is that of the noise."""
REQUIRED_OPTIONS: Final = tuple(name for name, field in ESTIMATOR_OPTIONS.items() if field.default is MISSING)
"""Those without which an estimator that has them cannot be made."""


def of_estimators(name: str, **changes: Any) -> Any:
    """Declare an option as the estimators that have it do, with changes."""
    field = ESTIMATOR_OPTIONS[name]
    about = {"default": None if field.default is MISSING else field.default, **field.metadata} | changes
    about.pop("example")
    return declared(**about)


def with_options_of_estimators(configuration: type[ConfigT]) -> type[ConfigT]:
    """Add the options that estimators declare and a configuration does not; None for an estimator's default."""
    for name, field in ESTIMATOR_OPTIONS.items():
        if name not in configuration.__annotations__:
            kind: Any = field.type
            configuration.__annotations__[name] = kind | None
            usual = "" if field.default is MISSING else str(field.default)
            setattr(configuration, name, of_estimators(name, default=None, unset=usual))
    return configuration
