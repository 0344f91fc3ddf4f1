"""A study as one self-contained HTML page: warnings, figures, tables, configuration, and the command that made it; and
the methods of its Dataset."""

import base64
import io
import json
from collections.abc import Mapping

import jinja2
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure

from mjx_study.plots.study import drawings_of, plot_study
from mjx_study.results.kind import Drawing, findings_of, kind_of
from mjx_study.results.rows import meanings_of, numbers_of, shown
from mjx_study.results.warnings import warnings_of
from mjx_study.table import plural


@xr.register_dataset_accessor("mjx_study")
class StudyAccessor:
    """Methods of a study's Dataset: `data.mjx_study.table()`, `.findings()`, `.warnings()`, `.plot()`, `.report()`."""

    def __init__(self, dataset: xr.Dataset):
        self._dataset = dataset

    def table(self) -> pd.DataFrame:
        """Return a row per contact model, seed and estimator, without variables over iterations, points or theta."""
        return kind_of(self._dataset).table(self._dataset)

    def findings(self) -> list[str]:
        """Return what the study's intervals support, as sentences."""
        return findings_of(self._dataset)

    def warnings(self) -> tuple[str, ...]:
        """Return warnings about contact models, lost samples and missing cells."""
        return warnings_of(self._dataset)

    def plot(self) -> dict[str, Figure]:
        """Draw the figures that the study has data for, by name."""
        return plot_study(self._dataset)

    def report(self) -> str:
        """Return the study as one HTML page."""
        return render_report(self._dataset)


@np.errstate(over="ignore", invalid="ignore")  # numbers of a motion that explodes
def render_report(dataset: xr.Dataset) -> str:
    config, environment = (json.loads(dataset.attrs[name]) for name in ("config", "environment"))
    kind, drawings = kind_of(dataset), drawings_of(dataset)
    versions = environment.pop("versions")
    revision = {"revision": dataset.attrs["revision"]} if "revision" in dataset.attrs else {}
    provenance = environment | versions | revision
    pages = jinja2.Environment(loader=jinja2.PackageLoader("mjx_study"), autoescape=True, keep_trailing_newline=True)
    return pages.get_template("report.html").render(
        tasks=", ".join(config["tasks"]),
        kind=kind.title,
        models=dataset.sizes["model"],
        warnings=warnings_of(dataset),
        findings=findings_of(dataset),
        figures=[_figure(name, figure, drawings) for name, figure in plot_study(dataset).items()],
        summary=_summary(dataset),
        numbers=numbers_of(dataset),
        meanings=meanings_of(dataset),
        config=[[key, shown(value)] for key, value in sorted(config.items()) if value not in (None, [], "")],
        provenance=[[name, shown(value)] for name, value in provenance.items()],
        command=dataset.attrs.get("command"),
    )


def _figure(name: str, figure: Figure, drawings: Mapping[str, Drawing]) -> tuple[str, str, str]:
    """Name, caption and image of a figure."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    caption = next(drawing.caption for key, drawing in drawings.items() if name.startswith(key))
    return name, caption, base64.b64encode(file.getvalue()).decode()


def _summary(dataset: xr.Dataset) -> str:
    seeds, samples = dataset.sizes.get("seed", 1), int(dataset["samples"][-1])
    seed = f"Medians over {seeds} seeds, counts summed" if seeds > 1 else "One seed"
    return (
        f"{seed}; {plural(samples, 'sample')} in a batch; ± one standard error; -: not defined, or explained by noise."
    )
