"""Read user-supplied files and validate them against a schema; errors name the file and the key in one line."""

import dataclasses
import functools
import hashlib
import json
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from estimators.choices import suggestion
from mjx_study.disk import read_bytes
from mjx_study.options.option import BUILDER_OPTIONS, OPTIONS

Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
_ADAPTER: Final = functools.cache(TypeAdapter)


def validated(schema: Any, content: bytes | str) -> Any:
    """Read JSON of a type; a ValueError names the first key that violates it."""
    try:
        return _ADAPTER(schema).validate_json(content)
    except ValidationError as error:
        raise ValueError(told(error)) from None


def _validated(path: Path, content: bytes, schema: Any) -> Any:
    try:
        return validated(schema, content)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def digest_of_json(document: Mapping[str, Any]) -> str:
    """Digest of plain data, without that under the key "digest"."""
    rest = {name: value for name, value in document.items() if name != "digest"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def read_toml(path: Path, schema: type[BaseModel]) -> dict[str, Any]:
    """Read the options set by a TOML file; ValueError as for `read_bytes`, or if it is not TOML or violates the
    schema."""
    content = read_bytes(path)
    try:
        found = schema.model_validate(tomllib.loads(content.decode()))
    except ValidationError as error:
        raise ValueError(f"{path}: {told(error, schema.model_fields)}") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not TOML: {error}") from error
    return {name: getattr(found, name) for name in found.model_fields_set}


def told(error: ValidationError, names: Iterable[str] = ()) -> str:
    """Describe the first violation of a schema, which may have such names, with its key, and count the others."""
    found = error.errors(include_url=False, include_input=False)
    first = found[0]
    key = ".".join(map(str, first["loc"]))
    raised = first.get("ctx", {}).get("error")  # from a validator of ours; pydantic adds words to its message
    reason = str(raised) if isinstance(raised, ValueError) else first["msg"]
    if first["type"] == "extra_forbidden":
        reason = f"there is no such option{suggestion(key, names)}"
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return f"{key}{': ' * bool(key)}{' '.join(reason.split())}{more}"


class PolicyFile(BaseModel):
    """A policy written by `optimise`: its parameters, the setting in which they were found, and a digest of it all."""

    model_config = ConfigDict(strict=True)

    task: str
    theta: list[Finite] = Field(min_length=1)
    contact: str | None = None
    stiffness: float | None = None
    damping: float | None = None
    cone: str | None = None
    timestep: float | None = None
    horizon: int | None = None
    model: str | None = None
    integrator: str | None = None
    solver: str | None = None
    solver_iterations: int | None = None
    solver_ls_iterations: int | None = None
    disable_flag: list[str] | None = None
    network: list[int] | None = None
    digest: str | None = None

    @field_validator("contact", "stiffness", "damping", "timestep", "cone", "network", *BUILDER_OPTIONS)
    @classmethod
    def _check(cls, value: Any, info: Any) -> Any:
        option = OPTIONS[str(info.field_name)]
        if value is None or (option.name == "stiffness" and value == 0):  # no contact has one
            return None
        return dataclasses.replace(option, many=isinstance(value, list)).check(value)


def read_theta(path: Path) -> tuple[tuple[float, ...], PolicyFile | None]:
    """Read parameters from a policy file, which is returned as well, a .json list or a .npy array; else ValueError."""
    if path.suffix != ".json":
        return _read_array(path), None
    content = read_bytes(path)
    if content.lstrip().startswith(b"{"):
        policy = _validated(path, content, PolicyFile)
        if policy.digest not in (None, digest_of_json(json.loads(content))):
            raise ValueError(f"{path} is damaged (its digest does not match); if you changed it, remove its digest")
        return tuple(policy.theta), policy
    return tuple(_validated(path, content, list[Finite])), None


def _read_array(path: Path) -> tuple[float, ...]:
    magic = read_bytes(path)[:6]
    try:
        if magic != np.lib.format.MAGIC_PREFIX:
            raise ValueError("not a .npy file")
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # does not allocate an impossible shape
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            raise ValueError("not an array of numbers")
        with np.errstate(over="ignore"):
            values = np.asarray(array, float)  # in which a long double may be infinite
        if not np.all(np.isfinite(values)):
            raise ValueError("not finite")
        return tuple(values.reshape(-1).tolist())
    except Exception as error:  # numpy may raise anything
        raise ValueError(f"{path} is not a .npy array of finite numbers") from error
