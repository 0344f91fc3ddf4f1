"""Frozen dataclasses as pytrees with shapes checked on construction but not on unflattening."""

from collections.abc import Iterable
from dataclasses import fields
from typing import Any, TypeVar

import jax
from jax.tree_util import GetAttrKey

DataclassT = TypeVar("DataclassT")


def register_pytree(dataclass_type: type[DataclassT]) -> type[DataclassT]:
    """Register a dataclass as a pytree with every field a child.

    `jax.tree_util.register_dataclass` rebuilds through `__init__`. JAX rebuilds trees around placeholders and batched
    arrays (`vmap`, `eval_shape`), which `__init__` would reject under run-time shape checking. Here unflattening only
    sets the fields: user code that calls the constructor is checked, transformations are not.
    """
    names = tuple(field.name for field in fields(dataclass_type))  # pyright: ignore[reportArgumentType]

    def flatten(tree: DataclassT) -> tuple[tuple[Any, ...], None]:
        return tuple(getattr(tree, name) for name in names), None

    def flatten_with_keys(tree: DataclassT) -> tuple[tuple[tuple[Any, Any], ...], None]:
        return tuple((GetAttrKey(name), getattr(tree, name)) for name in names), None

    def unflatten(_: None, children: Iterable[Any]) -> DataclassT:
        tree = object.__new__(dataclass_type)
        for name, child in zip(names, children, strict=True):
            object.__setattr__(tree, name, child)
        return tree

    jax.tree_util.register_pytree_with_keys(dataclass_type, flatten_with_keys, unflatten, flatten)
    return dataclass_type
