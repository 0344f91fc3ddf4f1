"""Measure, with real contact physics, whether the gradients of a differentiable simulator are worth having.

A study of gradient estimators through MuJoCo MJX: scenes, contact models in physical units, a differentiable step,
tasks as objectives, and comparisons of estimators over them. Call `configure` first for float64 and all cores.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjx_study._public import *  # noqa: F403


def __getattr__(name: str) -> Any:
    if name == "__all__" or not name.startswith("_"):
        public = import_module("mjx_study._public")
        if hasattr(public, name):
            return getattr(public, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *import_module("mjx_study._public").__all__})
