"""Frozen dataclasses as pytrees with shapes checked on construction but not on unflattening."""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, TypeVar

import jax
from jax.tree_util import GetAttrKey

DataclassT = TypeVar("DataclassT")


def register_pytree(dataclass_type: type[DataclassT], static: tuple[str, ...] = ()) -> type[DataclassT]:
    """Register a dataclass as a pytree with every field a child, but for the `static` ones.

    `jax.tree_util.register_dataclass` rebuilds through `__init__`. JAX rebuilds trees around placeholders and batched
    arrays (`vmap`, `eval_shape`), which `__init__` would reject under run-time shape checking. Here unflattening only
    sets the fields: user code that calls the constructor is checked, transformations are not.
    """
    every = (field.name for field in fields(dataclass_type))  # pyright: ignore[reportArgumentType]
    names = tuple(name for name in every if name not in static)

    def flatten(tree: DataclassT) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return tuple(getattr(tree, name) for name in names), tuple(getattr(tree, name) for name in static)

    def flatten_with_keys(tree: DataclassT) -> tuple[tuple[tuple[Any, Any], ...], tuple[Any, ...]]:
        children, fixed = flatten(tree)
        return tuple((GetAttrKey(name), child) for name, child in zip(names, children, strict=True)), fixed

    def unflatten(fixed: tuple[Any, ...], children: Iterable[Any]) -> DataclassT:
        tree = object.__new__(dataclass_type)
        for name, child in zip((*names, *static), (*children, *fixed), strict=True):
            object.__setattr__(tree, name, child)
        return tree

    jax.tree_util.register_pytree_with_keys(dataclass_type, flatten_with_keys, unflatten, flatten)
    return dataclass_type
