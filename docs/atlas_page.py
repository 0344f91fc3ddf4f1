"""What the atlas says: dimensionless groups, verdicts, rules with how often they are right, figures, docs/atlas.md.

Everything on the page is made from docs/atlas.npz, which docs/make_atlas.py computed.
"""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import jax.numpy as jnp
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from estimators import ENOUGH_EFFECTIVE
from estimators.confidence import coverage_interval
from mjx_study.diagnose import SMOOTH, WIDTHS
from mjx_study.study.findings import NARROW, NOTABLE, SHARE_OFF

Table = Any
"""A pandas.DataFrame with a row for each cell; pandas comes without types."""
HERE: Final = Path(__file__).parent
PAGE: Final = HERE / "atlas.md"
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
    "travel": ("h v / width", "travel in a step over the depth of the impedance's rise"),
    "crossing": ("h v / spread", "steps' travel over the guard's spread: 1 / onset_spread"),
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
BINS: Final = 8


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
    cost = (table.gradient_seconds / table.value_seconds).groupby(programs).transform("median")
    table["cost"] = cost
    saved = table.zobg_variance - table.fobg_variance * cost
    table["worth"] = table.zobg_variance / (table.fobg_variance * cost)
    table["until"] = np.where(saved > 0, saved / table.fobg_bias**2, 0.0)
    table.attrs = about
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


def _met(table: Table) -> Any:
    return table.meets & (table.stable == 1)


def _plain(table: Table) -> Any:
    """Cells where bodies meet, the step is stable, and plain first order is off: there is something to cure."""
    return _met(table) & (table.fobg_off == 1)


RULES: Final = (
    Rule("unstable step: variance above", "limit", 1.0, "above", lambda table: table.task != ""),
    Rule("force jumps at first touch: mean off", "strength", SMOOTH, "fobg_off", _met),
    Rule(
        "smooth onset, travel over width: mean off",
        "travel",
        1 / WIDTHS,
        "fobg_off",
        lambda table: _met(table) & (table.contact == "smooth_onset"),
    ),
    Rule("noise narrower than steps: term does not cure", "crossing", 1 / NARROW, "fobg_onset_off", _plain),
    Rule("bound on the term's error: term does not cure", "strength", 2 * NOTABLE, "fobg_onset_off", _plain),
)


def share(right: np.ndarray) -> str:
    """A share with its 95 % Wilson interval and the number of cells."""
    if not len(right):
        return "- (0)"
    middle, low, high = coverage_interval(jnp.asarray(right), 0.95)
    return f"{middle:.0%} ({low:.0%} to {high:.0%}; {len(right)})"


def halves(table: Table) -> tuple[Table, Table]:
    """Even and odd points of each family's sequence: no contact model is in both."""
    even = table["index"] // len(table.attrs["families"]) % 2 == 0
    return table[even], table[~even]


def rules_table(table: Table) -> str:
    """How often the thresholds of diagnose are right, and those fitted to one half, on the other half."""
    fit, test = halves(table)
    head = ("rule", "threshold", "where it holds", "where it does not", "fitted", "where it holds", "where it does not")
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
    head = ("group", "range", "cells", "variance above", "mean off", "off with the term")
    met, rows = table[_met(table)], []
    for group, (symbol, _) in GROUPS.items():
        some = table if group in ("limit", "h_b", "h2_k", "impedance", "periods", "params") else met
        values = some[group][np.isfinite(some[group])]
        edges = np.unique(np.quantile(values, np.linspace(0, 1, 5))) if len(values) else np.zeros(0)
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            part = some[(some[group] >= low) & ((some[group] < high) | (high == edges[-1]) & (some[group] == high))]
            inner = part[_met(part)]
            decided = [part.above, inner.fobg_off, inner[inner.fobg_off == 1].fobg_onset_off]
            shares = [share(each.dropna().to_numpy() == 1) for each in decided]
            rows.append([f"`{symbol}`", f"{low:.2g} to {high:.2g}", len(part), *shares])
    return markdown(head, rows)


def bound_table(table: Table) -> str:
    """How often the error that the term leaves is within the bound that findings state."""
    rows = []
    for name, part in table[_plain(table) & (table.onset_spread >= NARROW)].groupby("task"):
        excess = part.left - SHARE_OFF * part.strength
        told = (excess.abs() > QUANTILE * part.left_error) & np.isfinite(excess)
        rows.append(
            [
                f"`{name}`",
                len(part),
                share((excess[told] <= 0).to_numpy()),
                f"{part.left[np.isfinite(part.left)].median():.2g}",
            ]
        )
    return markdown(("task", "cells", "within the bound, where that is decided", "share left, median"), rows)


def groups_table(table: Table) -> str:
    """How well each group alone tells a verdict: the chance that it ranks a cell with it above one without."""
    met, cured = table[_met(table)], table[_plain(table)]
    chances = []
    for group in GROUPS:
        for some, verdict in ((table, "above"), (met, "fobg_off"), (cured, "fobg_onset_off")):
            kept = some[np.isfinite(some[group]) & np.isfinite(some[verdict])]
            ranks, truth = kept[group].rank(), kept[verdict] == 1
            pairs = int(truth.sum()) * int((~truth).sum())
            chances.append((ranks[truth].sum() - truth.sum() * (truth.sum() + 1) / 2) / pairs if pairs else np.nan)
    head = ("group", "", "variance above", "mean off", "off with the term")
    named = [[f"`{symbol}`", meaning] for symbol, meaning in GROUPS.values()]
    shown = [f"{each:.2f}" if np.isfinite(each) else "-" for each in chances]
    return markdown(head, [[*name, *shown[3 * place : 3 * place + 3]] for place, name in enumerate(named)])


def timestep_table(table: Table) -> str:
    """Verdicts by task and timestep."""
    rows = []
    for (name, timestep), part in table.groupby(["task", "timestep"]):
        inner = part[_met(part)]
        decided = [part.above, inner.fobg_off, inner[inner.fobg_off == 1].fobg_onset_off]
        rows.append([f"`{name}`", f"{1e3 * timestep:g} ms", len(part)])
        rows[-1] += [share(each.dropna().to_numpy() == 1) for each in decided]
    return markdown(("task", "timestep", "cells", "variance above", "mean off", "off with the term"), rows)


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
        "gradient / rollout",
    )
    return markdown(head, rows)


def samples_table(table: Table) -> str:
    """How much first order gains, and how many zeroth-order samples it takes to overtake its bias."""
    rows = []
    stable = table[(table.stable == 1) & np.isfinite(table.ratio)]
    for name, part in stable.groupby("contact", sort=False):
        worth = part.worth.quantile([0.25, 0.5, 0.75])
        off = part[(part.fobg_off == 1) & part.meets]
        until = off.until.quantile([0.25, 0.5, 0.75]) if len(off) else worth * np.nan
        rows.append([f"`{name}`", len(part), *(f"{each:.2g}" for each in worth), len(off)])
        rows[-1] += [f"{each:.2g}" if np.isfinite(each) else "-" for each in until]
    quarters = ("quarter", "median", "three quarters")
    head = ("contact", "stable cells", *quarters, "of these off", *quarters)
    return markdown(head, rows)


def markdown(head: Any, rows: Any) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


TABLES: Final = {
    "cells": cells_table,
    "groups": groups_table,
    "index": index_table,
    "rules": rules_table,
    "bound": bound_table,
    "timestep": timestep_table,
    "samples": samples_table,
}


def binned(axes: Axes, values: Any, verdict: Any, colour: str, label: str) -> None:
    """The share of a verdict in bins of equal numbers of cells, with Wilson intervals."""
    kept = np.isfinite(values) & (values > 0) & np.isfinite(verdict)
    values, verdict = values[kept], verdict[kept]
    if len(values) < 3 * BINS:
        return
    for part in np.array_split(np.argsort(values.to_numpy()), BINS):
        chosen = verdict.to_numpy()[part] == 1
        middle, low, high = coverage_interval(jnp.asarray(chosen), 0.95)
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
    axes.plot([], [], color=colour, marker="o", label=label)


def panels(rows: int, columns: int, width: float = 3.4, height: float = 2.8) -> tuple[Figure, list[Axes]]:
    figure = Figure((width * columns, height * rows), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns)))


def scatter(axes: Axes, table: Table, x: str, y: str, limits: tuple[float, float]) -> None:
    """A point for each cell, clipped to the limits, coloured by contact family."""
    for name, part in table.groupby("contact", sort=False):
        axes.scatter(part[x], part[y].clip(*limits), s=3, color=COLOURS[name], label=name, alpha=0.5, linewidths=0)
    axes.set(xscale="log", yscale="log", xlabel=GROUPS[x][0] if x in GROUPS else x, ylim=limits)


def variance_figure(table: Table) -> Figure:
    """Ratio of variances against the share of the stability limit, a panel for each task."""
    names = list(dict.fromkeys(table.task))
    figure, axes = panels(2, -(-len(names) // 2))
    for each, name in zip(axes, names, strict=False):
        scatter(each, table[(table.task == name) & table.ratio.notna()], "limit", "ratio", (1e-7, 1e7))
        each.axhline(1, color="black", linewidth=0.6)
        each.axvline(1, color="black", linewidth=0.6, linestyle=":")
        each.set_title(name)
    axes[0].legend(markerscale=3, fontsize=7)
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
            binned(axes[place + 4], part[group], part.fobg_off, COLOURS[name], name)
        axes[place + 4].set(xscale="log", xlabel=GROUPS[group][0], ylim=(-0.03, 1.03))
    axes[0].set_ylabel("relative bias of first order")
    axes[4].set_ylabel(f"share off by more than {TOLERANCE:.0%}")
    axes[1].legend(markerscale=3, fontsize=7)
    return figure


def onset_figure(table: Table) -> Figure:
    """What the onset term leaves of what it adds, where plain first order is off."""
    some = table[_plain(table)]
    figure, axes = panels(1, 3)
    for each, group in zip(axes, ("strength", "crossing", "limit"), strict=True):
        for name, part in some.groupby("task", sort=False):
            each.scatter(part[group], part.left.clip(1e-3, 10), s=5, label=name, alpha=0.6, linewidths=0)
        each.set(xscale="log", yscale="log", xlabel=GROUPS[group][0], ylim=(1e-3, 10))
    strength = np.geomspace(1e-3, 1, 50)
    axes[0].plot(strength, SHARE_OFF * strength, color="black", linewidth=0.8, label="stated by findings")
    axes[1].axvline(1 / NARROW, color="black", linewidth=0.6, linestyle=":")
    axes[0].set_ylabel("bias left / what the term adds")
    axes[0].legend(markerscale=2, fontsize=7)
    return figure


def timestep_figure(table: Table) -> Figure:
    """Shares of the three verdicts by timestep, a line for each task."""
    figure, axes = panels(1, 3)
    verdicts = {"variance above": "above", "mean off": "fobg_off", "off with the term": "fobg_onset_off"}
    for each, (title, column) in zip(axes, verdicts.items(), strict=True):
        some = table if column == "above" else table[_met(table)] if column == "fobg_off" else table[_plain(table)]
        for name, part in some.groupby("task", sort=False):
            points = []
            for timestep, cells in part.groupby("timestep"):
                decided = cells[column].dropna().to_numpy() == 1
                if len(decided) >= BINS:
                    points.append((1e3 * timestep, *coverage_interval(jnp.asarray(decided), 0.95)))
            if points:
                x, middle, low, high = np.array(points).T
                each.errorbar(
                    x,
                    middle,
                    np.maximum([middle - low, high - middle], 0),
                    marker="o",
                    markersize=4,
                    capsize=2,
                    label=name,
                )
        each.set(xscale="log", xlabel="timestep [ms]", title=title, ylim=(-0.03, 1.03))
    axes[0].set_ylabel("share of cells")
    axes[0].legend(fontsize=7)
    return figure


def samples_figure(table: Table) -> Figure:
    """What first order gains in variance times seconds, and after how many rollouts its bias costs it the lead."""
    figure, axes = panels(1, 2, 4.4)
    scatter(axes[0], table[table.worth.notna()], "limit", "worth", (1e-7, 1e7))
    axes[0].axhline(1, color="black", linewidth=0.6)
    axes[0].set_ylabel("variance x seconds,\nzeroth / first order")
    scatter(axes[1], table[_plain(table) & (table.until > 0)], "strength", "until", (1e-1, 1e5))
    axes[1].set_ylabel("rollouts until\nzeroth order is ahead")
    axes[1].legend(markerscale=3, fontsize=7)
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
        start, end = f"<!-- table: {name} -->\n", "\n<!-- end -->"
        before, found, rest = text.partition(start)
        assert found, f"the page has no table {name}"
        text = f"{before}{start}{make(table)}{end}{rest.partition(end.lstrip())[2]}"
    return text


def make_page(path: Path, save: Callable[[Figure, Path], None]) -> None:
    """Figures and tables of docs/atlas.md."""
    table = read(path)
    for name, make in FIGURES.items():
        save(make(table), HERE / f"atlas_{name}.png")
    PAGE.write_text(written(PAGE.read_text(), table))
