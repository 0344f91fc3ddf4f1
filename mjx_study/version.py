"""Versions of installed packages, this one included."""

from importlib import metadata
from typing import Final

NAME: Final = "mjx-study"
UNKNOWN: Final = "0+unknown"
"""Version of a copy of this package that is not installed."""


def version_of(package: str) -> str:
    """Version of an installed package; `UNKNOWN` for this one where it is not installed, else PackageNotFoundError."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        if package != NAME:
            raise
        return UNKNOWN
