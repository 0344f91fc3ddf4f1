"""Measure, with real contact physics, whether the gradients of a differentiable simulator are worth having.

A study of gradient estimators through MuJoCo MJX: scenes, contact models in physical units, a differentiable step,
tasks as objectives, and comparisons of estimators over them. Call `configure` first for float64 and all cores.
"""

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjx_study._public import *  # noqa: F403

_spec = find_spec("estimators")
if _spec is None or _spec.origin is None or Path(_spec.origin).parent.parent != Path(__file__).parent.parent:
    raise ImportError(
        f"{_spec and _spec.origin} hides the package `estimators` of mjx-study: rename it, or work in another folder"
    )
estimators = sys.modules["mjx_study.estimators"] = import_module("estimators")


def __getattr__(name: str) -> Any:
    if name == "__all__" or not name.startswith("_"):
        public = import_module("mjx_study._public")
        if hasattr(public, name):
            return getattr(public, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *import_module("mjx_study._public").__all__})
