"""What readers know of a kind of study; its module is registered in `mjx_study.choices.KINDS`."""

import dataclasses
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pandas as pd
import xarray as xr

from mjx_study.choices import KINDS
from mjx_study.results.variables import COORDINATES, DERIVED, Variable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LONG = {"iteration", "point", "param", "solref_entry", "solimp_entry"}
"""Dimensions that a table has no rows for."""


@dataclasses.dataclass(frozen=True)
class Drawing:
    """A figure of a study: a function of a part of its Dataset and a title, which returns None if there is nothing to
    show; its caption in a report; and the outer dimension, besides the contact model, that the part keeps."""

    draw: "Callable[[xr.Dataset, str], Figure | None]"
    caption: str
    keep: str = ""


class StudyResults(ABC):
    """What the Datasets of a kind of study hold and show.

    Attributes:
        name: name in configurations and manifests.
        title: name in reports.
        variables: variables of a cell.
        optional: variables that a cell may lack.
        columns: quantities in the table of a report.
        compared: variable whose ratio of two estimators is mapped over stiffness and another parameter; None for none.
        computed: variable that is finite in every computed cell.
        finite: variable that has a finite number unless all samples are lost.
        findings: what the numbers of a Dataset with at least one cell support, as sentences.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    variables: ClassVar[Mapping[str, Variable]]
    optional: ClassVar[Collection[str]] = ()
    columns: ClassVar[tuple[str, ...]]
    compared: ClassVar[str | None] = None
    computed: ClassVar[str] = "residual"
    finite: ClassVar[str]
    findings: ClassVar["staticmethod[[xr.Dataset], list[str]]"]

    @property
    def quantities(self) -> dict[str, Variable]:
        """Variables, coordinates, and quantities of tables."""
        return {**self.variables, **COORDINATES, **DERIVED}

    def axes(self, config: Mapping[str, Any]) -> dict[str, Sequence[int]]:
        """Dimensions within a cell besides seed, estimator and param, by the configuration in a manifest."""
        return {}

    def sizes(self, config: Mapping[str, Any], parameters: int) -> dict[str, int]:
        """Size of every dimension within a cell, of a task with that many parameters."""
        axes = {name: len(along) for name, along in self.axes(config).items()}
        own = {"seed": config["seeds"], "estimator": len(config["estimators"]), "param": parameters}
        return {"solref_entry": 2, "solimp_entry": 5, **own, **axes}

    @abstractmethod
    def drawings(self, dataset: xr.Dataset) -> dict[str, Drawing]:
        """Figures, by name."""

    def summarised(self, dataset: xr.Dataset) -> xr.Dataset:
        """Add the quantities of the report's table that the Dataset does not hold."""
        return dataset

    def table(self, dataset: xr.Dataset) -> pd.DataFrame:
        """A row per contact model, seed and estimator, without variables over iterations, points or theta."""
        short = [name for name, variable in dataset.data_vars.items() if not LONG & set(variable.dims)]
        return dataset[short].to_dataframe().reset_index()


def find_kind(name: str) -> Any:
    """The kind of study of a name: a `StudyResults` for readers, a `mjx_study.experiment.study.StudyKind` for plans."""
    return import_module(KINDS[name]).KIND


def kind_of(dataset: xr.Dataset) -> StudyResults:
    return find_kind(json.loads(dataset.attrs["config"])["kind"])


def findings_of(dataset: xr.Dataset) -> list[str]:
    """Return the findings supported by a study's intervals, as sentences; none if no cell is computed."""
    with np.errstate(over="ignore", invalid="ignore"):  # numbers of a motion that explodes
        return kind_of(dataset).findings(dataset) if dataset.data_vars else []
