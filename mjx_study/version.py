"""Version and summary of this package: a checkout's own, installed or not, or those of the installed distribution."""

import functools
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any, Final

NAME: Final = "mjx-study"
UNKNOWN: Final = "0+unknown"
"""Version of a copy of the package that is neither a checkout nor installed."""


def version_of(package: str) -> str:
    """Version of an installed package, or of this one wherever it is imported from.

    Raises:
        PackageNotFoundError: another package is not installed.
    """
    if package != NAME:
        return metadata.version(package)
    return _checkout().get("version") or _installed("Version", UNKNOWN)


def summary() -> str:
    """One line about this package."""
    return _checkout().get("description") or _installed("Summary", "Study gradients of a differentiable simulator")


def _installed(field: str, otherwise: str) -> str:
    try:
        return metadata.metadata(NAME)[field]
    except metadata.PackageNotFoundError:
        return otherwise


@functools.cache
def _checkout() -> dict[str, Any]:
    """Table `project` of the pyproject.toml beside this package; empty if there is none, or it is another project's."""
    try:
        project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    except (OSError, ValueError, KeyError):
        return {}
    return project if project.get("name") == NAME else {}
