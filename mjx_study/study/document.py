"""The schema of study.json; files from elsewhere are validated before use."""

import json
import math
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from mjx_study.files import Finite, told
from mjx_study.option import OPTIONS

MOST_NUMBERS: Final = 500_000_000
"""Maximum size of a variable of a study."""
Name = Annotated[str, Field(min_length=1, max_length=1000)]
Count = Annotated[int, Field(ge=1, le=10_000_000)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore")


class _Config(_Part):
    kind: Literal["gradients", "descents", "landscapes"]
    tasks: list[Name] = Field(min_length=1)
    estimators: list[Annotated[Name, AfterValidator(OPTIONS["estimators"].check)]] = Field(min_length=1)
    seeds: int = Field(ge=1, le=int(OPTIONS["seeds"].interval.high))  # type: ignore[union-attr]
    iterations: Count | None
    points: Count | None = None
    confidence: Annotated[float, Field(gt=0, lt=1)] = 0.95


class _Axes(_Part):
    task: list[Name] = Field(min_length=1)
    timestep: list[Finite] = Field(min_length=1)
    cone: list[Name] = Field(min_length=1)
    model: list[Name] = Field(min_length=1)
    sigma: list[Finite] = Field(min_length=1)
    samples: list[Count] = Field(min_length=1)


class _Model(_Part):
    contact: str
    stiffness: Finite


class _Cell(_Part):
    label: str
    at: dict[str, Annotated[int, Field(ge=0)]]
    solref: Annotated[list[Finite], Field(min_length=2, max_length=2)] | None = None
    solimp: Annotated[list[Finite], Field(min_length=5, max_length=5)] | None = None


class _Resolved(_Part):
    horizon: list[Count]
    noise: Name
    estimators: dict[str, dict[str, Any]]
    parameters: Count = 1


class _Environment(_Part):
    versions: dict[str, str]


class StudyDocument(_Part):
    """The parts of a study.json that are read; other keys may hold anything."""

    config: _Config
    contents: dict[str, str]
    versions: dict[str, str]
    warnings: list[str]
    environment: _Environment
    revision: str | None = None
    command: str | None = None
    models: list[_Model]
    axes: _Axes
    resolved: list[_Resolved]
    cells: list[_Cell] = Field(min_length=1)

    @model_validator(mode="after")
    def _fits_together(self) -> "StudyDocument":
        axes = {name: len(values) for name, values in vars(self.axes).items()}
        for name, values in vars(self.axes).items():
            if len(set(values)) < len(values):
                raise ValueError(f"axes.{name} has a value twice")
        if len(self.resolved) != axes["task"]:
            raise ValueError(f"there are {len(self.resolved)} entries of resolved, and {axes['task']} tasks")
        if len(self.models) != axes["model"]:
            raise ValueError(f"there are {len(self.models)} models, and {axes['model']} values of axes.model")
        for index, cell in enumerate(self.cells):
            if list(cell.at) != list(axes) or any(place >= axes[name] for name, place in cell.at.items()):
                raise ValueError(f"cells.{index}.at is no place on the axes")
        config = self.config
        inner = config.seeds * len(config.estimators) * max(config.iterations or 1, config.points or 1)
        if math.prod(axes.values()) * inner > MOST_NUMBERS:
            raise ValueError(f"a variable would have more than {MOST_NUMBERS} numbers, which is the limit")
        return self


class _Format(BaseModel):
    model_config = ConfigDict(strict=True)

    format: int


def read_format(content: bytes | str) -> int:
    """Read the format number of a study.json.

    Raises:
        ValueError: there is none.
    """
    try:
        return _Format.model_validate_json(content).format
    except ValidationError as error:
        raise ValueError(told(error)) from None


def read_document(content: bytes | str) -> dict[str, Any]:
    """Read a study.json as plain data.

    Raises:
        ValueError: it violates the schema; the message names the key.
    """
    try:
        StudyDocument.model_validate_json(content)
    except ValidationError as error:
        raise ValueError(told(error)) from None
    return json.loads(content)
