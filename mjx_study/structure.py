"""The structure of pytrees as text, for the private files of `caches`: reading one imports its classes."""

import pickle
from typing import Any

import jax


def describe(structure: Any) -> str:
    """Return a structure as text; ValueError if it cannot be pickled, or has parts beside its leaves."""
    try:
        found = pickle.dumps(structure.unflatten(range(structure.num_leaves))).decode("latin-1")
        whole = restore(found) == structure
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(f"the structure cannot be kept: {error}") from error
    if not whole:
        raise ValueError("the structure has parts beside its leaves")
    return found


def restore(described: str) -> Any:
    """Invert `describe`."""
    return jax.tree.structure(pickle.loads(described.encode("latin-1")))
