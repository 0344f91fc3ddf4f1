"""Runs of an optimisation on disk, from which they go on."""

import dataclasses
import hashlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_study.disk import read_whole, write_whole
from mjx_study.study.identity import ACCEPT, differences, estimator_contents, versions
from mjx_study.study.iteration import Descent, Record

Versions = dict[str, str]
"""By the name of what computes, its version; see `mjx_study.study.identity.versions`."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A run on disk.

    Attributes:
        arrays: what the file holds.
        versions: all that computed a part of it, in turn.
    """

    arrays: dict[str, np.ndarray]
    versions: tuple[Versions, ...]

    def restored(self, like: Descent) -> tuple[Descent, list[Record], list[float]]:
        """State, records and seconds; `like` has the state's structure."""
        leaves, structure = jax.tree.flatten(like)
        state = structure.unflatten([jnp.asarray(self.arrays[f"state_{index}"]) for index in range(len(leaves))])
        columns = [self.arrays[f"history_{field.name}"] for field in dataclasses.fields(Record)]
        records = [Record(*map(jnp.asarray, row)) for row in zip(*columns, strict=True)]
        return state, records, list(map(float, self.arrays["seconds"]))


def checkpoint_path(folder: Path, name: str) -> Path:
    """Where a run of an estimator is kept."""
    return folder / f"run-{name.replace(':', '.')}.npz"


def save_checkpoint(
    path: Path,
    identity: dict[str, Any],
    versions: Sequence[Versions],
    state: Descent,
    records: list[Record],
    seconds: list[float],
) -> None:
    """Write a run so that it can go on; the file is either the old one or the new one, never half of one.

    Args:
        path: of the file.
        identity: what must not differ for the run to go on, as plain data.
        versions: all that computed a part of it, in turn.
        state, records, seconds: the run so far; at least one iteration.
    """
    arrays = {f"state_{index}": np.asarray(leaf) for index, leaf in enumerate(jax.tree.leaves(state))}
    for field in dataclasses.fields(Record):
        column = np.array([getattr(record, field.name) for record in records])
        arrays[f"history_{field.name}"] = column
    arrays |= {"seconds": np.array(seconds), "config": np.array(json.dumps(identity, sort_keys=True))}
    arrays["versions"] = np.array(json.dumps(list(versions)))
    arrays["digest"] = np.array(_digest(arrays))
    write_whole(path, lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]


def load_checkpoint(
    path: Path, identity: dict[str, Any], versions: Versions, iterations: int, *, accept_versions: bool = False
) -> Checkpoint | None:
    """A run that can go on, or None where there is none.

    Args:
        path: of the file.
        identity: what must not differ.
        versions: of what is going to compute.
        iterations: to which it is to go. A longer run is left alone: its state is that of its end, not of an iteration
            before.
        accept_versions: go on where other versions stopped.

    Raises:
        ValueError: the file is damaged, of another configuration, of other versions, or of more iterations.
    """
    if not path.exists():
        return None
    try:
        with np.load(io.BytesIO(read_whole(path)), allow_pickle=False) as stored:
            arrays = {key: stored[key] for key in stored.files}
        digest = str(arrays.pop("digest"))
    except Exception as error:  # numpy, zipfile and zlib raise what they like
        raise ValueError(f"{path} is damaged ({error}); move it away to start again") from error
    if digest != _digest(arrays):
        raise ValueError(f"{path} is damaged (its digest does not match); move it away to start again")
    if told := differences(json.loads(str(arrays["config"])), json.loads(json.dumps(identity))):
        raise ValueError(f"{path.parent} holds another run ({told}); choose another folder")
    done = len(arrays["seconds"])
    if done > iterations:
        raise ValueError(
            f"{path} holds {done} iterations, and {iterations} are asked for: give --iterations {done} or more, or "
            "another folder"
        )
    before = tuple(json.loads(str(arrays["versions"])))
    told = differences(before[-1], versions)
    if told and done < iterations and not accept_versions:
        raise ValueError(f"{path} was computed with other versions ({told}); {ACCEPT}")
    return Checkpoint(arrays, before)


class Checkpoints:
    """Runs in a folder: those that were there, and where they are saved.

    Attributes:
        kept: by estimator, what there was; None for nothing.
        unsaved: by estimator, why its last checkpoint could not be written. The run itself goes on.

    Raises:
        ValueError: a run of another configuration, of more iterations or of other versions, or a file that is not one.
    """

    def __init__(
        self,
        folder: Path,
        estimators: Sequence[str],
        identity: dict[str, Any],
        iterations: int,
        *,
        accept_versions: bool = False,
    ):
        self._paths = {name: checkpoint_path(folder, name) for name in estimators}
        self._identities = {name: identity | {"estimator": name} | estimator_contents(name) for name in estimators}
        self._versions = versions()
        self.kept = {
            name: load_checkpoint(
                path, self._identities[name], self._versions, iterations, accept_versions=accept_versions
            )
            for name, path in self._paths.items()
        }
        self._authors = {name: [] if run is None else list(run.versions) for name, run in self.kept.items()}
        self.unsaved: dict[str, str] = {}

    def save(self, name: str, state: Descent, records: list[Record], seconds: list[float]) -> None:
        """Write a run, at least one iteration further than it was."""
        if self._authors[name][-1:] != [self._versions]:
            self._authors[name].append(self._versions)
        self.unsaved.pop(name, None)
        try:
            save_checkpoint(self._paths[name], self._identities[name], self._authors[name], state, records, seconds)
        except OSError as error:
            self.unsaved[name] = f"cannot write {self._paths[name]}: {error.strerror or error}"

    @property
    def mixed(self) -> tuple[str, ...]:
        """Warnings about runs that more than one version computed."""
        return tuple(
            f"{name} was computed by different versions ({differences(authors[0], authors[-1])})"
            for name, authors in self._authors.items()
            if len(authors) > 1
        )


def _digest(arrays: dict[str, np.ndarray]) -> str:
    sha = hashlib.sha256()
    for key in sorted(arrays):
        sha.update(key.encode() + str(arrays[key].dtype).encode() + np.ascontiguousarray(arrays[key]).tobytes())
    return sha.hexdigest()
