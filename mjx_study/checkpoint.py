"""Runs of an optimisation on disk, from which they go on."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_study.descent import Descent, Record
from mjx_study.results import write_whole


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A run on disk."""

    arrays: dict[str, np.ndarray]

    def restored(self, like: Descent) -> tuple[Descent, list[Record], list[float]]:
        """State, records and seconds; `like` has the state's structure."""
        leaves, structure = jax.tree.flatten(like)
        state = structure.unflatten([jnp.asarray(self.arrays[f"state_{index}"]) for index in range(len(leaves))])
        columns = [self.arrays[f"history_{field.name}"] for field in dataclasses.fields(Record)]
        records = [Record(*map(jnp.asarray, row)) for row in zip(*columns, strict=True)]
        return state, records, list(map(float, self.arrays["seconds"]))


def checkpoint_path(folder: Path, name: str) -> Path:
    """Where a run of an estimator is kept."""
    return folder / f"run-{name}.npz"


def save_checkpoint(
    path: Path, identity: dict[str, Any], state: Descent, records: list[Record], seconds: list[float]
) -> None:
    """Write a run so that it can go on; the file is either the old one or the new one, never half of one.

    Args:
        path: of the file.
        identity: what must not differ for the run to go on, as plain data.
        state, records, seconds: the run so far; at least one iteration.
    """
    arrays = {f"state_{index}": np.asarray(leaf) for index, leaf in enumerate(jax.tree.leaves(state))}
    for field in dataclasses.fields(Record):
        column = np.array([getattr(record, field.name) for record in records])
        arrays[f"history_{field.name}"] = column
    arrays |= {"seconds": np.array(seconds), "config": np.array(json.dumps(identity, sort_keys=True))}
    arrays["digest"] = np.array(_digest(arrays))
    write_whole(path, lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]


def load_checkpoint(path: Path, identity: dict[str, Any]) -> Checkpoint | None:
    """A run that can go on, or None where there is none.

    Raises:
        ValueError: the file is damaged, or of another configuration.
    """
    if not path.exists():
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
        digest = str(arrays.pop("digest"))
    except Exception as error:  # numpy, zipfile and zlib raise what they like
        raise ValueError(f"{path} is damaged ({error}); move it away to start again") from error
    if digest != _digest(arrays):
        raise ValueError(f"{path} is damaged (its digest does not match); move it away to start again")
    theirs, ours = json.loads(str(arrays["config"])), json.loads(json.dumps(identity))
    different = sorted(key for key in theirs | ours if theirs.get(key) != ours.get(key))
    if different:
        told = ", ".join(f"{key} {theirs.get(key)} there and {ours.get(key)} here" for key in different[:3])
        raise ValueError(f"{path.parent} holds another run ({told}); choose another folder")
    return Checkpoint(arrays)


def _digest(arrays: dict[str, np.ndarray]) -> str:
    sha = hashlib.sha256()
    for key in sorted(arrays):
        sha.update(key.encode() + str(arrays[key].dtype).encode() + np.ascontiguousarray(arrays[key]).tobytes())
    return sha.hexdigest()
