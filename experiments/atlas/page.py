"""Tables and figures of docs/atlas.md."""

import itertools
from collections.abc import Callable
from typing import Final

import numpy as np

from estimators.confidence import coverage_interval
from experiments import DOCS
from experiments.atlas.design import LAWS, REFUSED, SMOOTHING
from experiments.atlas.figures import BINS, FIGURES, TASKS, laws_figure
from experiments.atlas.jumps import results
from experiments.atlas.run import RESULTS
from experiments.atlas.table import (
    GROUPS,
    RULES,
    VERDICTS,
    Table,
    bodies_meet,
    halves,
    noise_is_wide,
    plain_is_off,
    read,
    verdicts,
)
from experiments.pages import save_figure, write_tables
from mjx_study.choices import FAMILIES
from mjx_study.diagnose.advice import SMOOTH_SHARE
from mjx_study.table import markdown_table

PAGE: Final = DOCS / "atlas.md"
OF_THE_DESIGN: Final = ("limit", "h_b", "h2_k", "impedance", "periods", "params")
"""Groups that are known without a rollout; for the others, only cells where bodies meet count."""
STRENGTHS: Final = (0.03, 0.8)  # onset strengths that separate the columns of the table of bounds
BESIDE: Final = ("mujoco", "smooth_onset", "penalty")  # families of MuJoCo's law beside which others are listed


def share(right: np.ndarray) -> str:
    """Format a share in percent, with its 95 % Wilson interval and the number of cells."""
    if not len(right):
        return "-"
    middle, low, high = (100 * each for each in coverage_interval(right, 0.95))
    return f"{middle:.0f} ({low:.0f}-{high:.0f}; {len(right)})"


def rules_table(table: Table) -> str:
    """Format how often the thresholds of diagnose, and those fitted to one half, are right on the other half."""
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
    return markdown_table(rows, head)


def jump_table(table: Table) -> str:
    """Format how often plain first order is off where force jumps at first touch, and where it does not."""
    rows = []
    for name in TASKS:
        part = table[bodies_meet(table) & (table.task == name)]
        jumps = part.jump > SMOOTH_SHARE
        rows.append([f"`{name}`"])
        for selected in (part[~jumps], part[jumps]):
            rows[-1] += [share(selected.fobg_off.dropna().to_numpy() == 1), int(selected.fobg_off.isna().sum())]
    head = ("task", "off, no jump", "undecided", "off, force jumps", "undecided")
    return markdown_table(rows, head)


def bound_table(table: Table) -> str:
    """Format how often the error that the term leaves is within the bound of findings, by onset strength."""
    rows = []
    for name in TASKS:
        part = table[noise_is_wide(table) & (table.task == name)]
        if len(part) < BINS:
            continue
        rows.append([f"`{name}`", len(part), f"{part.left[np.isfinite(part.left)].median():.2g}"])
        for low, high in itertools.pairwise((0, *STRENGTHS, np.inf)):
            beyond = part.beyond[(part.strength >= low) & (part.strength < high)].dropna()
            rows[-1].append(share(beyond.to_numpy() == 0))
    inner = [f"{low:g} to {high:g}" for low, high in itertools.pairwise(STRENGTHS)]
    within = [f"below {STRENGTHS[0]:g}", *inner, f"above {STRENGTHS[-1]:g}"]
    return markdown_table(rows, ("task", "cells", "share left, median", *within))


def groups_table(table: Table) -> str:
    """Format the share of each verdict in the quarters of the cells by each dimensionless group."""
    rows = []
    for group, (symbol, meaning) in GROUPS.items():
        selected = table if group in OF_THE_DESIGN else table[bodies_meet(table)]
        values = selected[group]
        edges = np.unique(np.quantile(values[np.isfinite(values)], np.linspace(0, 1, 5)))
        parts = [
            selected[(values >= low) & ((values < high) | (high == edges[-1]) & (values == high))]
            for low, high in itertools.pairwise(edges)
        ]
        columns = zip(*(verdicts(part) for part in parts), strict=True)
        shares = [
            ", ".join(f"{100 * np.mean(each):.0f}" if len(each) else "-" for each in column) for column in columns
        ]
        rows.append([f"`{symbol}`, {meaning}", ", ".join(f"{edge:.2g}" for edge in edges), *shares])
    return markdown_table(rows, ("group", "limits of the quarters", *VERDICTS))


def cells_table(table: Table) -> str:
    """Format the contents of the file, and how many verdicts are decided."""
    rows = []
    for name, part in [*table.groupby("task"), ("all", table)]:
        met = part[bodies_meet(part)]
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
    return markdown_table(rows, head)


def samples_table(table: Table) -> str:
    """Format first order's gain, and the rollouts until zeroth order overtakes its bias."""
    rows = []
    for name in TASKS:
        part = table[(table.task == name) & (table.stable == 1) & np.isfinite(table.ratio)]
        worth = part.worth.quantile([0.25, 0.5, 0.75])
        off = part[plain_is_off(part)]
        rows.append([f"`{name}`", len(part), *(f"{each:.2g}" for each in worth), len(off)])
        selected = off.until.quantile([0.25, 0.5, 0.75]) if len(off) >= BINS else worth * np.nan
        rows[-1] += [f"{each:.2g}" if np.isfinite(each) else "-" for each in selected]
    quartiles = ("lower quartile", "median", "upper quartile")
    head = ("task", "stable cells", *quartiles, "of these, mean off", *quartiles)
    return markdown_table(rows, head)


TABLES: Final = {
    "cells": cells_table,
    "jump": jump_table,
    "groups": groups_table,
    "rules": rules_table,
    "bound": bound_table,
    "samples": samples_table,
}


def by_law(table: Table, laws: Table, say: Callable[[Table], str]) -> str:
    """Format a table of laws by task."""
    rows = []
    for name in (*BESIDE, *LAWS):
        of = laws if name in LAWS else table
        cells = (of[(of.contact == name) & (of.task == task)] for task in TASKS)
        said = ["refused" if (task, name) in REFUSED else say(each) for task, each in zip(TASKS, cells, strict=True)]
        rows.append([f"`{name}`", *said])
    return markdown_table(rows, ("law", *(f"`{task}`" for task in TASKS)))


def off_of(part: Table) -> str:
    """Format how often first order is off where bodies meet."""
    return share(part[bodies_meet(part)].fobg_off.dropna().to_numpy() == 1)


def ratio_of(part: Table) -> str:
    """Format the median ratio of variances in stable cells, and how often first order's is above."""
    stable = part[part.stable == 1]
    above = stable.above.dropna()
    if not len(above):
        return "-"
    return f"{stable.ratio.median():.1g} ({100 * above.mean():.0f} %; {len(above)})"


def smoothing_table(laws: Table) -> str:
    """Format both by the factor on a law's smoothing."""
    rows = []
    for name in LAWS:
        part = laws[laws.contact == name]
        level = np.argmin(np.abs(np.log(np.outer(part.smoothing, 1 / np.array(SMOOTHING)) / kappa(name))), axis=1)
        parts = [part[level == each] for each in range(len(SMOOTHING))]
        rows.append([f"`{name}`", f"{kappa(name):.0e}", *map(off_of, parts), *map(ratio_of, parts)])
    factors = [f"{factor:g} kappa" for factor in SMOOTHING]
    return markdown_table(rows, ("law", "kappa [J]", *(f"off, {each}" for each in factors), *factors))


def jumps_table(laws: Table) -> str:
    """Format what quadrature says of cells that 64 samples decide."""
    rows = []
    found = results(laws)
    for (task, off, law), part in found.groupby(["task", "fobg_off", "contact"], sort=False):
        large = part[part.large]
        said = [int((part.verdict == 1).sum()), int((part.verdict == 0).sum()), int(part.verdict.isna().sum())]
        rows.append([f"`{task}`", f"`{law}`", "off" if off else "right", len(part), *said])
        rows[-1] += [len(large), int(large.switches.astype(bool).sum())]
    head = ("task", "law", "64 samples", "cells", "off", "right", "undecided", "one large jump", "at a change of face")
    return markdown_table(sorted(rows, key=lambda row: (row[0], row[2])), head)


def kappa(law: str) -> float:
    """A law's default smoothing [J]."""
    return FAMILIES[law].smoothing


def tables(table: Table, laws: Table) -> dict[str, str]:
    """Return every table of the page by its name; those of laws if there are cells of them."""
    found = {name: make(table) for name, make in TABLES.items()}
    if len(laws):
        found |= {"laws_off": by_law(table, laws, off_of), "laws_variance": by_law(table, laws, ratio_of)}
        found |= {"laws_smoothing": smoothing_table(laws), "laws_jumps": jumps_table(laws)}
    return found


def write_page() -> None:
    """Regenerate the figures and tables of docs/atlas.md."""
    table, laws = (read(RESULTS, laws) for laws in (False, True))
    for name, make in FIGURES.items():
        save_figure(make(table), f"atlas_{name}")
    if len(laws):
        save_figure(laws_figure(table, laws), "atlas_laws")
    write_tables(PAGE, tables(table, laws))
