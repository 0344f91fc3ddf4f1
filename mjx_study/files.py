"""Read user-supplied files and validate them against a schema; errors name the file and the key in one line."""

import dataclasses
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from estimators.catalogue import suggestion
from mjx_study.disk import read_bytes
from mjx_study.option import BUILDER_OPTIONS, OPTIONS

Schema = TypeVar("Schema", bound=BaseModel)
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]


def read_json(path: Path, schema: type[Schema]) -> Schema:
    """Read a JSON file; ValueError as for `read_bytes`, or if it violates the schema."""
    return _validated(path, read_bytes(path), schema)


def _validated(path: Path, content: bytes, schema: Any) -> Any:
    try:
        return TypeAdapter(schema).validate_json(content)
    except ValidationError as error:
        raise ValueError(f"{path}: {told(error)}") from None


def read_toml(path: Path, schema: type[BaseModel]) -> dict[str, Any]:
    """Read the options set by a TOML file; ValueError as for `read_json`, or if it is not TOML."""
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
    """A policy written by `optimise`: its parameters, and the setting in which they were found."""

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
