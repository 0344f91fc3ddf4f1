"""Methods of a study's Dataset: `data.mjx_study.table()`, `.findings()`, `.warnings()`, `.plot()`, `.report()`."""

import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from mjx_study.plots.study import plot_study
from mjx_study.report import report
from mjx_study.study.findings import findings, rows_of
from mjx_study.study.run import warnings_of


@xr.register_dataset_accessor("mjx_study")
class StudyAccessor:
    def __init__(self, dataset: xr.Dataset):
        self._dataset = dataset

    def table(self) -> pd.DataFrame:
        """Return a row per contact model, seed and estimator, without variables over iterations, points or theta."""
        if "variance" in self._dataset:
            return pd.DataFrame([row.as_dict() for row in rows_of(self._dataset)])
        long = {"iteration", "point", "param", "solref_entry", "solimp_entry"}
        short = [name for name, variable in self._dataset.data_vars.items() if not long & set(variable.dims)]
        return self._dataset[short].to_dataframe().reset_index()

    def findings(self) -> list[str]:
        return findings(self._dataset)

    def warnings(self) -> tuple[str, ...]:
        return warnings_of(self._dataset)

    def plot(self) -> dict[str, Figure]:
        return plot_study(self._dataset)

    def report(self) -> str:
        return report(self._dataset)
