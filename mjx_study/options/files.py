"""Files that users supply: options in TOML, parameters, and policies; errors name the file and the key in one line."""

import dataclasses
import hashlib
import io
import json
import math
import tomllib
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from estimators.choices import suggestion
from mjx_study.disk import read_bytes
from mjx_study.options.configuration import BUILDER_OPTIONS, OPTIONS
from mjx_study.options.option import OptionError

POLICY_OPTIONS: Final = (
    *("contact", "stiffness", "damping", "smoothing", "timestep", "cone", "network"),
    *BUILDER_OPTIONS,
)
"""Options under which a policy was found."""
HEADERS: Final = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
"""Readers of .npy headers, by version of the format."""


@cache
def _adapter(schema: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter(schema)


def validated(schema: Any, content: bytes | str) -> Any:
    """Read JSON of a type; a ValueError names the first key that violates it, and counts the others."""
    from pydantic import ValidationError

    try:
        return _adapter(schema).validate_json(content)
    except ValidationError as error:
        found = error.errors(include_url=False, include_input=False)
    first = found[0]
    key = ".".join(map(str, first["loc"]))
    raised = first.get("ctx", {}).get("error")  # from a validator of ours; pydantic adds words to its message
    reason = str(raised) if isinstance(raised, ValueError) else first["msg"]
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    raise ValueError(f"{key}{': ' * bool(key)}{' '.join(reason.split())}{more}")


def digest_of_json(document: Mapping[str, Any]) -> str:
    """Digest of plain data, without that under the key "digest"."""
    rest = {name: value for name, value in document.items() if name != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def read_toml(path: Path) -> dict[str, Any]:
    """Read the options set by a TOML file; ValueError as for `read_bytes`, or if it is not TOML, or an option is
    unknown or invalid."""
    content = read_bytes(path)
    with _naming_file(path):
        try:
            found = tomllib.loads(content.decode())
        except (ValueError, RecursionError) as error:
            raise ValueError(f"not TOML: {error}") from None
        for name in found:
            if name not in OPTIONS:
                raise ValueError(f"there is no option {name!r}{suggestion(name, OPTIONS)}")
        return {name: OPTIONS[name].read(value) for name, value in found.items()}


def read_theta(path: Path) -> tuple[tuple[float, ...], dict[str, Any]]:
    """Read parameters from a policy file, a .json list or a .npy array; else ValueError.

    Of a policy written by `optimise`, its task and those of `POLICY_OPTIONS` under which it was found are returned too.
    """
    if path.suffix != ".json":
        return _read_array(path), {}
    content = read_bytes(path)
    with _naming_file(path):
        try:
            found = json.loads(content)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"not JSON: {error}") from None
        policy = _policy_of(found) if isinstance(found, dict) else {}
        theta = OPTIONS["theta"].check(found.get("theta") if policy else found)
        if not theta:
            raise ValueError("there are no parameters")
        return tuple(map(float, theta)), policy


def _policy_of(document: dict[str, Any]) -> dict[str, Any]:
    if document.get("digest") not in (None, digest_of_json(document)):
        raise ValueError("the digest does not match, so the file is damaged; if you changed it, remove its digest")
    if not isinstance(task := document.get("task"), str):
        raise ValueError(f"task must be the name of a task, got {task!r:.60}")
    options = {name: value for name in POLICY_OPTIONS if (value := document.get(name)) is not None}
    if options.get("stiffness") == 0:  # no contact has one
        del options["stiffness"]
    if isinstance(contact := options.get("contact"), str):
        options["contact"] = contact.partition(", backward")[0]  # without the model of surrogate gradients
    for name, value in options.items():
        dataclasses.replace(OPTIONS[name], many=name in ("network", "disable_flag")).check(value)
    return options | {"task": task}


@contextmanager
def _naming_file(path: Path) -> Generator[None]:
    """Begin errors with a file's name, and spell options as its keys."""
    try:
        yield
    except ValueError as error:
        reason = error.spelled(str) if isinstance(error, OptionError) else str(error)
        raise ValueError(f"{path}: {' '.join(reason.split())}") from None


def _read_array(path: Path) -> tuple[float, ...]:
    content = read_bytes(path)
    try:
        array = read_npy(content)
        with np.errstate(over="ignore"):
            values = np.asarray(array, float)  # in which a long double may be infinite
        if array.dtype.kind not in "fiu" or not np.all(np.isfinite(values)):
            raise ValueError("not an array of finite numbers")
    except Exception as error:  # numpy may raise anything
        raise ValueError(f"{path} is not a .npy array of finite numbers") from error
    return tuple(values.reshape(-1).tolist())


def read_npy(content: bytes) -> np.ndarray:
    """Read a .npy file, read-only; ValueError unless its header promises as many bytes as follow."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(f"an array is in version {'.'.join(map(str, version))} of NumPy's format")
    shape, by_column, dtype = HEADERS[version](stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ValueError("an array differs in size from its header")
    flat = np.frombuffer(content, dtype, offset=stream.tell()) if dtype.itemsize else np.zeros(math.prod(shape), dtype)
    return flat.reshape(shape, order="F" if by_column else "C")
