"""What the atlas says: dimensionless groups, verdicts, rules with how often they are right, figures, docs/atlas.md.

Everything on the page is made from experiments/data/atlas.npz, which experiments.atlas.measure computed.
"""

import dataclasses
import itertools
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from estimators import ENOUGH_EFFECTIVE
from estimators.confidence import coverage_interval
from experiments.pages import DOCS, save_figure, with_table
from mjx_study.diagnose import SMOOTH_SHARE, WIDTH_RATIO
from mjx_study.results.findings import ERROR_PER_STRENGTH, LEAST_SPREAD, MOST_STRENGTH
from mjx_study.table import percent

Table = Any
"""A pandas.DataFrame with a row for each cell; pandas comes without types."""
PAGE: Final = DOCS / "atlas.md"
TOLERANCE: Final = 0.2
"""Share of the slope within which a mean counts as right."""
QUANTILE: Final = 2.58
"""Standard errors of the 99 % intervals that verdicts on means need."""
MARKOV: Final = 40.0
"""A mean of numbers >= 0 exceeds this many times its expectation with a probability of at most 1/40."""
GROUPS: Final = {
    "limit": ("(h^2 k + 2 h b) / 4", "stiffness and damping over one step, as a share of the stability limit"),
    "h_b": ("h b", "damping over one step"),
    "h2_k": ("h^2 k", "stiffness over one step"),
    "impedance": ("d_0", "impedance at first touch"),
    "strength": ("onset strength", "share of the approach speed that an onset takes in one step"),
    "travel": ("h v / width", "travel in one step over the depth of the impedance's rise"),
    "crossing": ("h v / spread", "one step over the spread of the first onset: 1 / onset_spread"),
    "periods": ("T sqrt(k) / 2 pi", "horizon in periods of the contact's spring"),
    "params": ("P", "number of parameters"),
}
"""Dimensionless groups: symbol and meaning."""
COLOURS: Final = {
    "penalty": "#0072B2",
    "impedance": "#56B4E9",
    "mujoco": "#D55E00",
    "mujoco_stiff": "#E69F00",
    "smooth_onset": "#009E73",
}
TASKS: Final = {
    "momentum_transfer": "#0072B2",
    "ball_wall": "#E69F00",
    "pusher": "#009E73",
    "pusher_apart": "#CC79A7",
    "sliding_box": "#999999",
    "tennis": "#000000",
}
"""Colours, in the order of panels."""
BINS: Final = 8
SURE: Final = 5.0
"""Standard errors from zero from which a slope serves as the unit of a bias."""
STRENGTHS: Final = (0.03, 0.8)
"""Onset strengths between which the bound on the term's error is counted apart."""


def read(path: Path) -> Table:
    """The atlas with its groups and verdicts, a row for each cell."""
    with np.load(path) as file:
        about = json.loads(str(file["about"]))
        table = pd.DataFrame({name: file[name] for name in file.files if name != "about"}).astype({"index": int})
    programs = table["program"].astype(int)
    table["task"] = [about["programs"][each][0] for each in programs]
    table["timestep"] = [about["programs"][each][1] for each in programs]
    table["contact"] = [about["families"][each] for each in table["family"].astype(int)]
    duration, table["params"] = (np.array(about[name], float)[programs] for name in ("durations", "params"))
    table["h_b"] = table.timestep * table.b
    table["h2_k"] = table.timestep**2 * table.k
    table["limit"] = (table.h2_k + 2 * table.h_b) / 4
    table["strength"] = table.onset_strength
    table["travel"] = table.timestep * table.speed / table.width
    table["crossing"] = 1 / table.onset_spread
    table["periods"] = duration * np.sqrt(table.k) / (2 * np.pi)
    table["meets"] = (table.onsets >= about["samples"] / 2) & (table.at_start == 0)
    table["ratio"] = table.fobg_variance / table.zobg_variance
    enough = (table.fobg_effective >= ENOUGH_EFFECTIVE) & (table.zobg_effective >= ENOUGH_EFFECTIVE)
    above, below = table.fobg_lower > table.zobg_upper, table.fobg_upper < table.zobg_lower
    beyond = table.fobg_variance / MARKOV > table.zobg_upper
    table["above"] = np.where(enough & above | beyond, 1.0, np.where(enough & below, 0.0, np.nan))
    for name in ("fobg", "fobg_onset"):
        table[f"{name}_relative"] = table[f"{name}_bias"].abs() / table.slope.abs()
        table[f"{name}_off"] = _off(table, name)
    added = (table.fobg_bias - table.fobg_onset_bias).abs()
    table["left"] = table.fobg_onset_bias.abs() / added
    table["left_error"] = np.hypot(table.fobg_onset_bias_se, table.slope_se) / added
    excess = table.left - ERROR_PER_STRENGTH * table.strength
    told = np.isfinite(excess) & (excess.abs() > QUANTILE * table.left_error)
    table["beyond"] = np.where(told, (excess > 0).astype(float), np.nan)
    last = table.environment == table.groupby("task").environment.transform("max")
    spent = (table.gradient_seconds / table.value_seconds).where(last)
    table["cost"] = cost = spent.groupby(table.task).transform("median")
    saved = table.zobg_variance - table.fobg_variance * cost
    table["worth"] = table.zobg_variance / (table.fobg_variance * cost)
    table["until"] = np.where(saved > 0, saved / table.fobg_bias**2, 0.0)
    table.attrs["environments"] = json.dumps(about["environments"])  # as text: pandas copies it with every column
    return table


def _off(table: Table, name: str) -> np.ndarray:
    """1 where a mean is off by more than `TOLERANCE`, 0 where it is right within, NaN where that is undecided."""
    bias, slope = table[f"{name}_bias"].abs(), table.slope.abs()
    half = QUANTILE * np.hypot(table[f"{name}_bias_se"], table.slope_se)
    error = QUANTILE * table.slope_se
    enough = (table[f"{name}_effective"] >= ENOUGH_EFFECTIVE) & (table[f"{name}_lost"] == 0)
    wrong, right = bias - half > TOLERANCE * (slope + error), bias + half <= TOLERANCE * (slope - error)
    return np.where(enough & wrong, 1.0, np.where(enough & right, 0.0, np.nan))


@dataclasses.dataclass(frozen=True)
class Rule:
    """A threshold that predicts a verdict: above it 1 is expected, below it 0.

    Attributes:
        group: column that is compared.
        threshold: what diagnose takes.
        verdict: column with 1, 0 or NaN.
        rising: whether values above the threshold expect 1.
        where: cells that the rule is about.
    """

    name: str
    group: str
    threshold: float
    verdict: str
    where: Callable[[Table], Any]
    rising: bool = True

    def judged(self, table: Table) -> Table:
        """The decided cells that it is about."""
        kept = self.where(table) & np.isfinite(table[self.group]) & np.isfinite(table[self.verdict])
        return table[kept]

    def hits(self, table: Table, threshold: float) -> tuple[np.ndarray, np.ndarray]:
        """Whether it is right in each cell where the verdict is 1, and in each where it is 0."""
        expected = (table[self.group] > threshold) == self.rising
        truth = table[self.verdict] == 1
        return (expected[truth]).to_numpy(), (~expected[~truth]).to_numpy()

    def balanced(self, table: Table, threshold: float) -> float:
        """Mean of both shares, so that the more frequent verdict does not decide."""
        return sum(float(np.mean(each)) if len(each) else 1.0 for each in self.hits(table, threshold)) / 2

    def fitted(self, table: Table) -> float:
        """The threshold with the best balanced share, of the quantiles."""
        tried = np.unique(np.quantile(table[self.group], np.linspace(0.01, 0.99, 99)))
        return float(tried[int(np.argmax([self.balanced(table, each) for each in tried]))])


def _any(table: Table) -> Any:
    return table.program >= 0


def _met(table: Table) -> Any:
    return table.meets & (table.stable == 1)


def _plain(table: Table) -> Any:
    """Cells where bodies meet, the step is stable, and plain first order is off."""
    return _met(table) & (table.fobg_off == 1)


def _curable(table: Table) -> Any:
    """Of these, the cells where force jumps, so that the onset term adds something."""
    return _plain(table) & (table.strength > SMOOTH_SHARE)


def _on(where: Callable[[Table], Any], *tasks: str) -> Callable[[Table], Any]:
    """Cells of some tasks alone."""
    return lambda table: where(table) & table.task.isin(tasks)


def _wide(table: Table) -> Any:
    """Cells with something to cure where noise is as wide as the term needs."""
    return _curable(table) & (table.onset_spread >= LEAST_SPREAD)


LAUNCHED: Final = ("momentum_transfer", "ball_wall")
FORCES: Final = ("pusher", "pusher_apart", "sliding_box")
RULES: Final = (
    Rule("unstable step: variance above; launch angle", "limit", 1.0, "above", _on(_any, *LAUNCHED)),
    Rule("unstable step: variance above; many forces", "limit", 1.0, "above", _on(_any, *FORCES)),
    Rule("force jumps at first touch: mean off", "strength", SMOOTH_SHARE, "fobg_off", _met),
    Rule(
        "smooth onset, travel over width: variance above",
        "travel",
        1 / WIDTH_RATIO,
        "above",
        lambda table: _met(table) & (table.contact == "smooth_onset"),
    ),
    Rule("noise narrower than steps: mean off with the term", "crossing", 1 / LEAST_SPREAD, "fobg_onset_off", _curable),
    Rule(
        "strong onset: term beyond its bound, `momentum_transfer`",
        "strength",
        MOST_STRENGTH,
        "beyond",
        _on(_wide, "momentum_transfer"),
    ),
    Rule(
        "strong onset: term beyond its bound, `ball_wall`", "strength", MOST_STRENGTH, "beyond", _on(_wide, "ball_wall")
    ),
)


def share(right: np.ndarray) -> str:
    """A share with its 95 % Wilson interval and the number of cells."""
    if not len(right):
        return "- (0)"
    middle, low, high = coverage_interval(right, 0.95)
    return f"{percent(middle)} ({percent(low)} to {percent(high)}; {len(right)})"


def verdicts(part: Table) -> list[Any]:
    """Decided verdicts of some cells: variance above; mean off, where bodies meet; off with the term, where it acts."""
    decided = [part.above, part[_met(part)].fobg_off, part[_curable(part)].fobg_onset_off]
    return [each.dropna().to_numpy() == 1 for each in decided]


VERDICTS: Final = ("variance above", "mean off", "off with the term")


def halves(table: Table) -> tuple[Table, Table]:
    """Two random halves; no contact model is in both.

    Even and odd points would not do: in a Sobol sequence these are the two halves of a dimension, the damping ratio.
    """
    first = np.random.default_rng(0).permutation(table["index"].max() + 1)[table["index"]] % 2 == 0
    return table[first], table[~first]


def rules_table(table: Table) -> str:
    """How often the thresholds of diagnose are right, and those fitted to one half, on the other half."""
    fit, test = halves(table)
    head = ("rule", "threshold", "sensitivity", "specificity", "fitted", "sensitivity", "specificity")
    rows = []
    for rule in RULES:
        ours, theirs = rule.judged(fit), rule.judged(test)
        if not len(ours) or not len(theirs):
            rows.append([rule.name, f"{rule.threshold:.3g}", *["-"] * 5])
            continue
        fitted = rule.fitted(ours)
        shares = [[share(each) for each in rule.hits(theirs, value)] for value in (rule.threshold, fitted)]
        rows.append([rule.name, f"{rule.threshold:.3g}", *shares[0], f"{fitted:.2g}", *shares[1]])
    return markdown(head, rows)


def index_table(table: Table) -> str:
    """What to expect by dimensionless group: each in quarters of its cells."""
    head = ("group", "range", "cells", *VERDICTS)
    met, rows = table[_met(table)], []
    for group, (symbol, _) in GROUPS.items():
        some = table if group in ("limit", "h_b", "h2_k", "impedance", "periods", "params") else met
        values = some[group][np.isfinite(some[group])]
        edges = np.unique(np.quantile(values, np.linspace(0, 1, 5))) if len(values) else np.zeros(0)
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            part = some[(some[group] >= low) & ((some[group] < high) | (high == edges[-1]) & (some[group] == high))]
            rows.append([f"`{symbol}`", f"{low:.2g} to {high:.2g}", len(part), *map(share, verdicts(part))])
    return markdown(head, rows)


def jump_table(table: Table) -> str:
    """How often plain first order is off where force jumps at first touch, and where it does not."""
    rows = []
    for name in TASKS:
        part = table[_met(table) & (table.task == name)]
        jumps = part.strength > SMOOTH_SHARE
        rows.append([f"`{name}`"])
        for some in (part[~jumps], part[jumps]):
            rows[-1] += [share(some.fobg_off.dropna().to_numpy() == 1), int(some.fobg_off.isna().sum())]
    head = ("task", "off, no jump", "undecided", "off, force jumps", "undecided")
    return markdown(head, rows)


def bound_table(table: Table) -> str:
    """How often the error that the term leaves is within the bound that findings state, by onset strength."""
    rows = []
    for name in TASKS:
        part = table[_wide(table) & (table.task == name)]
        if not len(part):
            continue
        rows.append([f"`{name}`", len(part), f"{part.left[np.isfinite(part.left)].median():.2g}"])
        for low, high in itertools.pairwise((0, *STRENGTHS, np.inf)):
            told = part.beyond[(part.strength >= low) & (part.strength < high)].dropna()
            rows[-1].append(share(told.to_numpy() == 0))
    inner = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(STRENGTHS)]
    within = [f"below {STRENGTHS[0]:g}", *inner, f"above {STRENGTHS[-1]:g}"]
    return markdown(("task", "cells", "share left, median", *within), rows)


def groups_table(table: Table) -> str:
    """How well each group alone tells a verdict: the chance that it ranks a cell with it above one without."""
    met, cured = table[_met(table)], table[_curable(table)]
    chances = []
    for group in GROUPS:
        for some, verdict in ((table, "above"), (met, "fobg_off"), (cured, "fobg_onset_off")):
            kept = some[np.isfinite(some[group]) & np.isfinite(some[verdict])]
            ranks, truth = kept[group].rank(), kept[verdict] == 1
            pairs = int(truth.sum()) * int((~truth).sum())
            chances.append((ranks[truth].sum() - truth.sum() * (truth.sum() + 1) / 2) / pairs if pairs else np.nan)
    head = ("group", "", *VERDICTS)
    named = [[f"`{symbol}`", meaning] for symbol, meaning in GROUPS.values()]
    shown = [f"{each:.2f}" if np.isfinite(each) else "-" for each in chances]
    return markdown(head, [[*name, *shown[3 * place : 3 * place + 3]] for place, name in enumerate(named)])


def timestep_table(table: Table) -> str:
    """Verdicts by task and timestep."""
    rows = []
    for (name, timestep), part in table.groupby(["task", "timestep"]):
        rows.append([f"`{name}`", f"{1e3 * timestep:g} ms", len(part), *map(share, verdicts(part))])
    return markdown(("task", "timestep", "cells", *VERDICTS), rows)


def steps_table(table: Table) -> str:
    """What a smaller step does to contacts that are stable at the largest one, and to the stiffest quarter of all.

    Variances are over the squared gradient and times the number of steps, which is what a second of computing leaves.
    """
    rows = []
    for name, cells in table.groupby("task"):
        quarter = cells.stiffness.quantile([0.25, 0.75])
        parts = cells[cells.stiffness <= quarter[0.25]], cells[cells.stiffness >= quarter[0.75]]
        largest = cells.timestep.max()
        jumping = cells[_met(cells) & (cells.strength > SMOOTH_SHARE)]
        known = jumping[jumping.slope.abs() > SURE * jumping.slope_se]
        alike = known[largest**2 * known.k + 2 * largest * known.b < 4]
        for timestep in sorted(cells.timestep.unique()):
            rows.append([f"`{name}`", f"{1e3 * timestep:g} ms"])
            for part in parts:
                left = part.fobg_variance / part.norm**2 / part.timestep
                medians = left.groupby(part.timestep).median()
                here = part[part.timestep == timestep]
                rows[-1].append(share(here.above.dropna().to_numpy() == 1))
                rows[-1].append(f"{medians[timestep] / medians[largest]:.2g}")
            biases = alike.fobg_relative[alike.timestep == timestep]
            rows[-1].append(f"{biases.median():.2g} ({len(biases)})" if len(biases) >= BINS else "-")
    head = (
        "task",
        "timestep",
        "softest quarter: variance above",
        "variance x steps",
        "stiffest quarter: variance above",
        "variance x steps",
        "bias, median",
    )
    return markdown(head, rows)


def cells_table(table: Table) -> str:
    """What is in the file, and how much of it is decided."""
    rows = []
    for name, part in [*table.groupby("task"), ("all", table)]:
        met = part[_met(part)]
        decided = [f"{int(each.notna().sum())} of {len(each)}" for each in (part.above, met.fobg_off)]
        steps = ", ".join(f"{1e3 * each:g}" for each in sorted(part.timestep.unique()))
        cost = float(part.cost.median())
        rows.append([name if name == "all" else f"`{name}`", steps if name != "all" else "", len(part), *decided])
        rows[-1].append(f"{cost:.2g}" if name != "all" else "")
    head = (
        "task",
        "timesteps [ms]",
        "cells",
        "variance decided",
        "mean decided, where bodies meet",
        "gradients / rollout",
    )
    return markdown(head, rows)


def samples_table(table: Table) -> str:
    """How much first order gains, and how many rollouts it takes until zeroth order is ahead of its bias."""
    rows = []
    for name in TASKS:
        part = table[(table.task == name) & (table.stable == 1) & np.isfinite(table.ratio)]
        worth = part.worth.quantile([0.25, 0.5, 0.75])
        off = part[_plain(part)]
        rows.append([f"`{name}`", len(part), *(f"{each:.2g}" for each in worth), len(off)])
        some = off.until.quantile([0.25, 0.5, 0.75]) if len(off) >= BINS else worth * np.nan
        rows[-1] += [f"{each:.2g}" if np.isfinite(each) else "-" for each in some]
    quartiles = ("lower quartile", "median", "upper quartile")
    head = ("task", "stable cells", *quartiles, "of these, mean off", *quartiles)
    return markdown(head, rows)


def machines_table(table: Table) -> str:
    """Where the cells were computed."""
    rows = []
    for place, each in enumerate(json.loads(table.attrs["environments"])):
        versions = [each["versions"][name] for name in ("mujoco", "jax")]
        cells = int((table.environment == place).sum())
        rows.append([each["processor"], each["cores"], each["python"], *versions, each["precision"], cells])
    return markdown(("processor", "cores", "Python", "MuJoCo", "JAX", "precision", "cells"), rows)


def markdown(head: Any, rows: Any) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


TABLES: Final = {
    "machines": machines_table,
    "cells": cells_table,
    "jump": jump_table,
    "groups": groups_table,
    "index": index_table,
    "rules": rules_table,
    "bound": bound_table,
    "timestep": timestep_table,
    "steps": steps_table,
    "samples": samples_table,
}


def binned(axes: Axes, values: Any, verdict: Any, colour: str) -> None:
    """The share of a verdict in bins of equal numbers of cells, with Wilson intervals."""
    kept = np.isfinite(values) & (values > 0) & np.isfinite(verdict)
    values, verdict = values[kept], verdict[kept]
    if len(values) < 3 * BINS:
        return
    for part in np.array_split(np.argsort(values.to_numpy()), BINS):
        chosen = verdict.to_numpy()[part] == 1
        middle, low, high = coverage_interval(chosen, 0.95)
        at = float(np.exp(np.mean(np.log(values.to_numpy()[part]))))
        axes.errorbar(
            at,
            middle,
            np.maximum([[middle - low], [high - middle]], 0),
            color=colour,
            marker="o",
            markersize=4,
            capsize=2,
        )


def panels(rows: int, columns: int, width: float = 3.4, height: float = 2.8) -> tuple[Figure, list[Axes]]:
    figure = Figure((width * columns, height * rows + 0.3), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def key(figure: Figure, colours: Mapping[str, str], *more: Line2D) -> None:
    """A legend below the panels, outside them."""
    dots = [Line2D([], [], color=colour, marker="o", linewidth=0, label=name) for name, colour in colours.items()]
    columns = len(dots) if not more else 4
    figure.legend(handles=[*dots, *more], loc="outside lower center", ncols=columns, frameon=False)


def symbol_of(group: str) -> str:
    return GROUPS[group][0].replace("^2", "²")


def scatter(axes: Axes, table: Table, x: str, y: str, limits: tuple[float, float]) -> None:
    """A point for each cell, clipped to the limits, coloured by contact family."""
    for name, part in table.groupby("contact", sort=False):
        axes.scatter(part[x], part[y].clip(*limits), s=3, color=COLOURS[name], alpha=0.5, linewidths=0)
    axes.set(xscale="log", yscale="log", xlabel=symbol_of(x), ylim=limits)


def variance_figure(table: Table) -> Figure:
    """Ratio of variances against the share of the stability limit, a panel for each task."""
    figure, axes = panels(2, 3)
    for each, name in zip(axes, TASKS, strict=True):
        scatter(each, table[(table.task == name) & table.ratio.notna()], "limit", "ratio", (1e-7, 1e7))
        each.axhline(1, color="black", linewidth=0.6)
        each.axvline(1, color="black", linewidth=0.6, linestyle=":")
        each.set_title(name)
    key(figure, COLOURS)
    for each in axes[:: len(axes) // 2]:
        each.set_ylabel("variance, first / zeroth order")
    return figure


def bias_figure(table: Table) -> Figure:
    """Relative bias of plain first order, where decided, against four groups; shares of cells that are off below."""
    met = table[_met(table) & np.isfinite(table.fobg_off)]
    figure, axes = panels(2, 4, 3.0)
    for place, group in enumerate(("h_b", "strength", "crossing", "travel")):
        scatter(axes[place], met, group, "fobg_relative", (1e-3, 1e2))
        axes[place].axhline(TOLERANCE, color="black", linewidth=0.6)
        for name, part in met.groupby("contact", sort=False):
            binned(axes[place + 4], part[group], part.fobg_off, COLOURS[name])
        axes[place + 4].set(xscale="log", xlabel=symbol_of(group), ylim=(-0.03, 1.03))
    axes[0].set_ylabel("relative bias of first order")
    axes[4].set_ylabel(f"share off by more than {percent(TOLERANCE)}")
    key(figure, COLOURS)
    return figure


def onset_figure(table: Table) -> Figure:
    """What the onset term leaves of what it adds, where force jumps and plain first order is off."""
    some = table[_curable(table)]
    figure, axes = panels(1, 3)
    for each, group in zip(axes, ("strength", "crossing", "limit"), strict=True):
        for name, part in some.groupby("task", sort=False):
            each.scatter(part[group], part.left.clip(1e-3, 10), s=5, color=TASKS[name], alpha=0.6, linewidths=0)
        each.set(xscale="log", yscale="log", xlabel=symbol_of(group), ylim=(1e-3, 10))
    strength = np.array([SMOOTH_SHARE, MOST_STRENGTH])
    axes[0].plot(strength, ERROR_PER_STRENGTH * strength, color="black", linewidth=0.8)
    axes[1].axvline(1 / LEAST_SPREAD, color="black", linewidth=0.6, linestyle=":")
    axes[0].set_ylabel("bias left / what the term adds")
    key(
        figure,
        TASKS,
        Line2D([], [], color="black", linewidth=0.8, label="bound of findings"),
        Line2D([], [], color="black", linewidth=0.6, linestyle=":", label="narrowest noise"),
    )
    return figure


def timestep_figure(table: Table) -> Figure:
    """Shares of the three verdicts by timestep, a line for each task."""
    figure, axes = panels(1, 3)
    for name, cells in table.groupby("task", sort=False):
        steps = [(1e3 * timestep, verdicts(part)) for timestep, part in cells.groupby("timestep")]
        for place, each in enumerate(axes):
            decided = [(x, found[place]) for x, found in steps if len(found[place]) >= BINS]
            if not decided:
                continue
            x, middle, low, high = np.array([(x, *coverage_interval(told, 0.95)) for x, told in decided]).T
            bars = np.maximum([middle - low, high - middle], 0)
            each.errorbar(x, middle, bars, color=TASKS[name], marker="o", markersize=4, capsize=2)
    ticks = [1e3 * timestep for timestep in sorted(table.timestep.unique())]
    for each, title in zip(axes, VERDICTS, strict=True):
        each.set(xscale="log", xlabel="timestep [ms]", title=title, ylim=(-0.03, 1.03))
        each.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        each.minorticks_off()
    axes[0].set_ylabel("share of decided cells")
    key(figure, TASKS)
    return figure


def samples_figure(table: Table) -> Figure:
    """What first order gains in variance times seconds, and after how many rollouts its bias costs it the lead."""
    figure, axes = panels(1, 2, 4.4)
    for each, x, y, some, limits in (
        (axes[0], "limit", "worth", table[table.worth.notna()], (1e-7, 1e7)),
        (axes[1], "strength", "until", table[_plain(table)], (1e-1, 1e5)),
    ):
        for name, part in some.groupby("task", sort=False):
            each.scatter(part[x], part[y].clip(*limits), s=3, color=TASKS[name], alpha=0.5, linewidths=0)
        each.set(xscale="log", yscale="log", xlabel=symbol_of(x), ylim=limits)
    axes[0].axhline(1, color="black", linewidth=0.6)
    axes[0].set_ylabel("variance x seconds,\nzeroth / first order")
    axes[1].set_ylabel("rollouts until\nzeroth order is ahead")
    key(figure, TASKS)
    return figure


FIGURES: Final = {
    "variance": variance_figure,
    "bias": bias_figure,
    "onset": onset_figure,
    "timestep": timestep_figure,
    "samples": samples_figure,
}


def written(text: str, table: Table) -> str:
    """The page with its tables made again."""
    for name, make in TABLES.items():
        text = with_table(text, name, make(table))
    return text


def make_page(path: Path) -> None:
    """Figures and tables of docs/atlas.md."""
    table = read(path)
    for name, make in FIGURES.items():
        save_figure(make(table), DOCS / f"atlas_{name}.png")
    PAGE.write_text(written(PAGE.read_text(), table))
