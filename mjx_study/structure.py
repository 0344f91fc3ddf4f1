"""The structure of pytrees as plain data: containers, and dataclasses and named tuples of known packages by name.

Reading one imports nothing and runs no code but the constructors of tuples: a class must be loaded already, and belong
to a package whose classes programs of this package return.
"""

import dataclasses
import sys
from typing import Any, Final

import jax

PACKAGES: Final = ("estimators", "mjx_study", "mujoco", "optax")
"""Packages whose classes may be named."""


def describe(structure: Any) -> Any:
    """Return a structure as JSON types; ValueError if it holds anything else than dicts with texts as keys, lists,
    tuples, None, and classes of `PACKAGES`."""
    tree = structure.unflatten(range(structure.num_leaves))
    found = _describe(tree)
    if restore(found) != structure:
        raise ValueError("the structure has parts beside its leaves")
    return found


def restore(described: Any) -> Any:
    """Invert `describe`; ValueError if the description is of no structure that it returns."""
    return jax.tree.structure(_restore(described))


def _describe(tree: Any) -> Any:
    if tree is None or type(tree) is int:
        return tree
    if type(tree) is dict and all(isinstance(name, str) for name in tree):
        return {"dict": {name: _describe(value) for name, value in tree.items()}}
    if type(tree) in (list, tuple):
        return {type(tree).__name__: [_describe(each) for each in tree]}
    kind = type(tree)
    if (names := _fields(kind)) is not None:
        return {"class": [kind.__module__, kind.__qualname__], "fields": [_describe(getattr(tree, n)) for n in names]}
    raise ValueError(f"a {kind.__qualname__} is no part of a structure")


def _restore(described: Any) -> Any:
    match described:
        case None | int():
            return described
        case {"dict": dict() as items, **rest} if not rest:
            return {name: _restore(value) for name, value in items.items()}
        case {"list": list() as items, **rest} if not rest:
            return [_restore(each) for each in items]
        case {"tuple": list() as items, **rest} if not rest:
            return tuple(_restore(each) for each in items)
        case {"class": [str() as module, str() as name], "fields": list() as items, **rest} if not rest:
            return _instance(getattr(sys.modules.get(module), name, None), [_restore(each) for each in items])
    raise ValueError("not the description of a structure")


def _instance(kind: Any, values: list[Any]) -> Any:
    names = _fields(kind)
    if names is None or len(names) != len(values):
        raise ValueError(f"{kind} is no class of so many fields")
    if issubclass(kind, tuple):
        return tuple.__new__(kind, values)
    made = object.__new__(kind)
    for name, value in zip(names, values, strict=True):
        object.__setattr__(made, name, value)
    return made


def _fields(kind: Any) -> tuple[str, ...] | None:
    """Names of the fields of a named tuple or dataclass of `PACKAGES`; None for any other class."""
    if not isinstance(kind, type) or kind.__module__.partition(".")[0] not in PACKAGES:
        return None
    if issubclass(kind, tuple):
        return getattr(kind, "_fields", None)
    return tuple(field.name for field in dataclasses.fields(kind)) if dataclasses.is_dataclass(kind) else None
