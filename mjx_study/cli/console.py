"""Studies as the commands print them: text, and plain data for JSON."""

import itertools
import json
import math
import shlex
import shutil
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr

from estimators import ENOUGH_EFFECTIVE
from mjx_study.choices import FAMILIES, REFERENCE, is_file
from mjx_study.experiment.iteration import REASONS
from mjx_study.options.configuration import OPTIONS, SCENE_OPTIONS
from mjx_study.results.curves import curves_of, line_of
from mjx_study.results.kind import findings_of
from mjx_study.results.rows import Row, label_in, numbers_of, remains, rows_of
from mjx_study.results.variables import (
    COLUMNS,
    COORDINATES,
    DEBIASED,
    DERIVED,
    DESCENTS,
    DETAILS,
    GRADIENTS,
    HISTORY,
    MARKS,
    METRIC,
    START,
)
from mjx_study.table import format_table, number, percent, with_error

Column = tuple[str, Callable[[Row], str]]
DESCENT_COLUMNS: Final = ("final_cost", "best_cost", "alpha", "seed_rollouts", "seconds")
"""Columns of the table of `optimise`, a task's metrics after the second."""
CHOSEN: Final = ("theta", "gamma", "onset", "noise", "baseline", "weights", *SCENE_OPTIONS)
"""Options that the header of a table states where they are given."""
MOST_SHOWN: Final = 3  # maximum number of parameters printed


def _debiased(row: Row, name: str) -> str:
    value, debiased, error = (getattr(row, each) for each in (name, DEBIASED[name], f"{DEBIASED[name]}_se"))
    left, doubt = remains(name, value, debiased, error), _doubt(row)
    return f"{GRADIENTS[name].text(value)} -> {left.removesuffix('-') if doubt else left}{doubt}"


def _doubt(row: Row) -> str:
    """Mark of a number that rests on too few effective samples."""
    return "" if row.believable else "?"


def columns(confidence: float, label: Callable[[str], str], *, details: bool, scalar: bool) -> list[list[Column]]:
    """Columns of the comparison: those that identify a row, then groups that a table keeps together; a scalar parameter
    has no cosine."""
    quantities = GRADIENTS | COORDINATES | DERIVED

    def interval(row: Row) -> str:
        return f"{GRADIENTS['variance'].interval(row.variance, row.variance_lower, row.variance_upper)}{_doubt(row)}"

    def effective(row: Row) -> str:
        return number(row.effective_samples, 2) + (f" ({percent(row.top_share)})" if row.effective_samples else "")

    own: dict[str, Column] = {
        "stiffness": (f" [{quantities['stiffness'].unit}]", lambda row: number(row.stiffness or None)),
        "variance": (f" ({percent(confidence)} interval)", interval),
        "effective_samples": (f" ({quantities['top_share'].heading})", effective),
    }
    own |= {name: (f" -> {quantities[DEBIASED[name]].heading}", partial(_debiased, name=name)) for name in DEBIASED}

    def column(name: str) -> Column:
        variable = quantities[name]
        more, show = own.get(name, ("", lambda row: variable.text(getattr(row, name))))
        return variable.heading + more, show

    identity = [column("stiffness"), ("estimator", lambda row: label(row.estimator))]
    hidden = () if details and not scalar else ("cosine",) if details else DETAILS
    return [identity, *([column(name) for name in group if name not in hidden] for group in COLUMNS)]


def _blocks(rows: Sequence[Row], shown: list[list[Column]], width: int) -> Iterator[list[str]]:
    """Split the columns into as few tables as the width allows, each with the identifying columns."""
    identity, *parts = shown
    block: list[Column] = []
    for part in parts:
        if block and len(_table(rows, identity + block + part)[0]) > width:
            yield _table(rows, identity + block)
            block = []
        block = block + part
    yield _table(rows, identity + block)


def _table(rows: Sequence[Row], table: Sequence[Column]) -> list[str]:
    cells = [[show(row) for _, show in table] for row in rows]
    for (previous, current), row in zip(itertools.pairwise(rows), cells[1:], strict=True):
        if previous.stiffness == current.stiffness:
            row[0] = ""
    return format_table(cells, [heading for heading, _ in table])


def _chosen(config: dict[str, Any]) -> str:
    """Options that change what the estimators are, where given."""
    given = {name: config[name] for name in CHOSEN if config.get(name) not in (None, OPTIONS[name].default)}
    if (theta := given.get("theta")) is not None:
        given["theta"] = ", ".join(f"{each:g}" for each in theta[:MOST_SHOWN]) + (" ..." if theta[MOST_SHOWN:] else "")
    told = {name: ",".join(value) if isinstance(value, list) else value for name, value in given.items()}
    return "".join(f", {name.replace('_', ' ')} {value}" for name, value in told.items())


def gradient_lines(dataset: xr.Dataset, document: dict[str, Any], details: bool = False) -> list[str]:
    config, rows, lines = document["config"], rows_of(dataset), []
    label = partial(label_in, dataset)
    shown = columns(config["confidence"], label, details=details, scalar=dataset.sizes.get("param") == 1)
    for resolved, task in zip(document["resolved"], dataset["task"].values.tolist(), strict=True):
        lines.append(
            f"{task}: {', '.join(map(str, config['samples']))} samples in each batch, "
            f"sigma {', '.join(f'{sigma:g}' for sigma in dataset['sigma'].values)}, "
            f"{', '.join(map(str, resolved['horizon']))} steps of "
            f"{', '.join(f'{step:g}' for step in dataset['timestep'].values)} s, "
            f"{', '.join(dataset['cone'].values)} cone, "
            f"seed {config['seed']}, {document['environment']['precision']}{_chosen(config)}"
        )
    width = shutil.get_terminal_size((140, 24)).columns
    damping = config.get("damping"), [entry.get("damping", 0.0) for entry in document["resolved"]]
    for family in dict.fromkeys(row.contact for row in rows):
        lines += ["", f"{family}: {FAMILIES[family].described(*damping)}" if family in FAMILIES else family]
        lines += itertools.chain(*_blocks([row for row in rows if row.contact == family], shown, width))
    lines.append("")
    uncertainty = [row.reference_uncertainty for row in rows if math.isfinite(row.reference_uncertainty)]
    if uncertainty:
        pairs = dataset.get("reference_pairs", xr.DataArray(config["reference_samples"])).values
        lines += [
            f"Errors are against an unbiased zeroth-order reference gradient, {_range(pairs, '{:,.0f}'.format)} pairs "
            "of rollouts;",
            f"its own relative uncertainty is {_range(uncertainty, partial(number, digits=2))}: errors of that size "
            "are expected without any bias.",
            MARKS,
        ]
    lines.append("ms: computing time of one sample; variance x s: the variance times it, in seconds.")
    if not all(row.believable for row in rows):
        lines.append(
            f"?: fewer than {ENOUGH_EFFECTIVE:g} effective samples carry the batch's variance; trust neither the "
            "number nor its error."
        )
    return lines + [f"{sentence}." for sentence in document["findings"]]


def _range(values: Any, show: Callable[[float], str]) -> str:
    """The smallest and the largest finite value, or the only one."""
    low, high = show(float(np.nanmin(values))), show(float(np.nanmax(values)))
    return low if low == high else f"{low} to {high}"


def rows_as_json(dataset: xr.Dataset) -> dict[str, Any]:
    return {"findings": findings_of(dataset), "rows": [row.as_dict() for row in rows_of(dataset)]}


def curves(dataset: xr.Dataset) -> dict[str, Any]:
    found = [
        {"label": label, "contact": one["contact"].item(), "stiffness": one["stiffness"].item() or None}
        | {str(name): one[name].values for name in one if "entry" not in str(one[name].dims)}
        for label, one in curves_of(dataset)
    ]
    return {"findings": findings_of(dataset), "estimators": dataset["estimator"].values, "curves": found}


def curve_lines(dataset: xr.Dataset, document: dict[str, Any]) -> list[str]:
    config, found = document["config"], curves_of(dataset)
    low, high = found[0][1]["position"].values[[0, -1]]
    name, unit = line_of(dataset)
    where = f"t in theta + t d (d: {config['direction'] or 'random'})" if name == "t" else name
    samples, sigmas = ([f"{value:g}" for value in dataset[name].values] for name in ("samples", "sigma"))
    lines = [
        f"{', '.join(config['tasks'])}: {where} from {low:.3g} to {high:.3g}{f' {unit}' if unit else ''} in "
        f"{config['points']} points, sigma {', '.join(sigmas)},",
        f"{', '.join(samples)} samples at each, seed {config['seed']}, {document['environment']['precision']}"
        f"{_chosen(config)}",
        "",
    ]
    headings, rows = numbers_of(dataset) or ([], [])
    return [*lines, *format_table(rows, headings), "", *document["findings"]]


def descents(dataset: xr.Dataset) -> dict[str, Any]:
    config, resolved = json.loads(dataset.attrs["config"]), json.loads(dataset.attrs["resolved"])[0]
    one = dataset.isel({name: 0 for name in ("task", "timestep", "cone", "model", "sigma", "samples")})
    place = {name: one[name].item() for name in ("contact", "stiffness", "cone", "sigma", "samples")}
    place["stiffness"] = place["stiffness"] or None
    return {
        "config": config | resolved["recipe"] | place | {"task": config["tasks"][0], "noise": resolved["noise"]},
        "start_cost": [one["start_cost"].item(), one["start_cost_se"].item()],
        "start_metrics": {str(name)[len(START) :]: one[name].item() for name in one if str(name).startswith(START)},
        "runs": [_run(one.sel(estimator=name)) for name in config["estimators"]],
        "findings": findings_of(dataset),
    }


def _run(one: xr.Dataset) -> dict[str, Any]:
    final, stopped_at = one["final_cost"].values, one["stopped_at"].values
    known = np.flatnonzero(np.isfinite(one["seconds"].values))
    length = int(known[-1]) + 1 if len(known) else 0
    stopped = [
        {"seed": seed, "iteration": int(stopped_at[seed]), "reason": REASONS[int(one["reason"].values[seed])]}
        for seed in np.flatnonzero(np.isfinite(stopped_at)).tolist()
    ]
    return {
        "estimator": one["estimator"].item(),
        "final_cost": final,
        "final_cost_se": one["final_cost_se"].values,
        "metrics": {str(name)[len(METRIC) :]: one[name].values for name in one if str(name).startswith(METRIC)},
        "best_seed": int(np.nanargmin(final)) if np.any(np.isfinite(final)) else 0,
        "stopped": stopped,
        "rollouts_per_iteration": int(one["rollouts"]),
        "seconds": one["seconds"].values[:length],
        "history": {name: one[name].transpose("iteration", "seed").values[:length] for name in HISTORY},
        "theta": one["theta"].transpose("seed", "param").values,
    }


def descent_lines(dataset: xr.Dataset, document: dict[str, Any]) -> list[str]:
    config, label = document["config"], partial(label_in, dataset)
    where = "analytic reference" if config["contact"] == REFERENCE else config["contact"]
    if config["stiffness"]:
        where = f"{where}, K = {config['stiffness']:g} N/m"
    metrics = "".join(f", {name} {number(value, 3)}" for name, value in document["start_metrics"].items())
    decay = f" / i^{config['decay']:g}" if config["decay"] else ""
    seeds = f"seed {config['seed']}" if config["seeds"] == 1 else f"{config['seeds']} seeds from {config['seed']}"
    start, (mean, error) = DESCENTS["start_cost"], document["start_cost"]
    shown = [(DESCENTS | DERIVED)[name].heading for name in DESCENT_COLUMNS]
    costs = 1 + (config["seeds"] > 1)  # the best of one is that one
    headings = ["estimator", *shown[:costs], *document["start_metrics"], *shown[2:]]
    lines = [
        f"{config['task']}: {where}; {config['optimizer']}, learning rate {config['learning_rate']:g}{decay}, "
        f"{config['iterations']} iterations",
        f"{config['samples']} samples in each batch, {seeds}, "
        f"sigma {config['sigma']:g}; {start.heading} {with_error(mean, error, start.digits)}{metrics}",
        "",
        *format_table([_row(run, label(run["estimator"]), costs) for run in document["runs"]], headings),
    ]
    at_once = min(len(document["runs"]), len(document["environment"]["devices"]))
    if at_once > 1:
        lines.append(f"seconds: of wall clock, without compilation, while {at_once} estimators compute side by side.")
    for run in document["runs"]:
        for stop in run["stopped"]:
            who = f"{label(run['estimator'])}, seed {stop['seed']}"
            lines.append(f"{who}: stopped at iteration {stop['iteration']}, {stop['reason']}")
    if (paths := document.get("policies")) and not is_file(config["task"]):  # rollout moves a file as its MJCF says
        least = [np.nanmin(_finite(run["final_cost"]), initial=np.inf) for run in document["runs"]]
        best = shlex.join(["mjx-study", "rollout", config["task"], "--theta", paths[int(np.argmin(least))]])
        lines.append(f"to see the best policy: {best}")
    return lines + [f"{sentence}." for sentence in document["findings"]]


def _row(run: dict[str, Any], label: str, num_costs: int) -> list[str]:
    digits, costs = DESCENTS["final_cost"].digits, _finite(run["final_cost"])
    length = len(run["seconds"])
    weights = _finite([weight for row in run["history"]["alpha"][-max(1, length // 10) :] for weight in row])
    return [
        label,
        *(_with_spread(np.mean, costs, digits), _with_spread(np.min, costs, digits).partition(" ")[0])[:num_costs],
        *(_with_spread(np.mean, _finite(values), 3) for values in run["metrics"].values()),
        DESCENTS["alpha"].text(float(np.mean(weights))) if len(weights) else "-",
        str(run["rollouts_per_iteration"] * length),
        number(run["seconds"][-1], 2) if length else "-",
    ]


def _finite(values: list[float | None]) -> np.ndarray:
    return np.array([value for value in values if value is not None and math.isfinite(value)])


def _with_spread(of: Callable[[np.ndarray], float], values: np.ndarray, digits: int) -> str:
    if len(values) == 0:
        return "nan"
    return with_error(float(of(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None, digits)
