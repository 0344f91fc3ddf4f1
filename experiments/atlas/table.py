"""The atlas as a table with dimensionless groups and verdicts, and rules that predict verdicts."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd

from estimators import ENOUGH_EFFECTIVE
from experiments.atlas.design import CELLS
from mjx_study.choices import DEFAULT_SOLIMP
from mjx_study.choices import FAMILIES as CONTACTS
from mjx_study.diagnose.advice import SMOOTH_SHARE, WIDTH_RATIO
from mjx_study.results.findings import ERROR_PER_STRENGTH, LEAST_SPREAD, MOST_STRENGTH

Table = Any
"""A pandas.DataFrame with a row for each cell; pandas comes without types."""
TOLERANCE: Final = 0.2  # share of the slope within which a mean counts as right
QUANTILE: Final = 2.58  # standard errors of the 99 % intervals that verdicts on means need
MARKOV: Final = 40.0
"""A mean of numbers >= 0 exceeds this many times its expectation with a probability of at most 1/40."""
GROUPS: Final = {
    "limit": ("(h^2 k + 2 h b) / 4", "stiffness and damping over one step, as a share of the stability limit"),
    "h_b": ("h b", "damping over one step"),
    "h2_k": ("h^2 k", "stiffness over one step"),
    "impedance": ("d_0", "impedance at first touch"),
    "jump": ("h b d_0 / d_width", "share of the approach speed that the damper takes in the first step"),
    "strength": ("onset strength", "share of the approach speed that an onset takes in one step"),
    "travel": ("h v / width", "travel in one step over the depth of the impedance's rise"),
    "crossing": ("h v / spread", "one step over the spread of the first onset: 1 / onset_spread"),
    "periods": ("T sqrt(k) / 2 pi", "horizon in periods of the contact's spring"),
    "params": ("P", "number of parameters"),
}
"""Dimensionless groups: symbol and meaning."""


def read(path: Path, laws: bool = False) -> Table:
    """Return the atlas with its groups and verdicts, one row per cell: under MuJoCo's law, or under the others.

    The others have no onset, so that their groups of it are those of the same rollouts under MuJoCo's default contact.
    """
    with np.load(path) as file:
        about = json.loads(str(file["about"]))
        every: Table = pd.DataFrame({name: file[name] for name in file.files if name != "about"}).astype({"index": int})
    table = every[(every["index"] >= CELLS) == laws].reset_index(drop=True)
    programs = table["program"].astype(int)
    table["task"] = [about["programs"][each][0] for each in programs]
    table["timestep"] = [about["programs"][each][1] for each in programs]
    table["contact"] = [about["families"][each] for each in table["family"].astype(int)]
    duration, table["params"] = (np.array(about[name], float)[programs] for name in ("durations", "params"))
    table["h_b"] = table.timestep * table.b
    table["h2_k"] = table.timestep**2 * table.k
    table["limit"] = (table.h2_k + 2 * table.h_b) / 4
    table["strength"] = table.onset_strength
    impedances = [CONTACTS[name].solimp or DEFAULT_SOLIMP for name in table.contact]
    table["jump"] = table.h_b * table.impedance / np.array(impedances)[:, 1]
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
        table[f"{name}_off"] = is_off(table, name)
    added = (table.fobg_bias - table.fobg_onset_bias).abs()
    table["left"] = table.fobg_onset_bias.abs() / added
    table["left_error"] = np.hypot(table.fobg_onset_bias_se, table.slope_se) / added
    excess = table.left - ERROR_PER_STRENGTH * table.strength
    decided = np.isfinite(excess) & (excess.abs() > QUANTILE * table.left_error)
    table["beyond"] = np.where(decided, (excess > 0).astype(float), np.nan)
    last = table.environment == table.groupby("task").environment.transform("max")
    spent = (table.gradient_seconds / table.value_seconds).where(last)
    table["cost"] = cost = spent.groupby(table.task).transform("median")
    saved = table.zobg_variance - table.fobg_variance * cost
    table["worth"] = table.zobg_variance / (table.fobg_variance * cost)
    table["until"] = np.where(saved > 0, saved / table.fobg_bias**2, 0.0)
    table.attrs["environments"] = json.dumps(about["environments"])  # as text: pandas copies it with every column
    return table


def is_off(table: Table, name: str) -> np.ndarray:
    """Return 1 where a mean is off by more than `TOLERANCE`, 0 where it is within, NaN where undecided."""
    bias, slope = table[f"{name}_bias"].abs(), table.slope.abs()
    half = QUANTILE * np.hypot(table[f"{name}_bias_se"], table.slope_se)
    error = QUANTILE * table.slope_se
    enough = (table[f"{name}_effective"] >= ENOUGH_EFFECTIVE) & (table[f"{name}_lost"] == 0)
    wrong, right = bias - half > TOLERANCE * (slope + error), bias + half <= TOLERANCE * (slope - error)
    return np.where(enough & wrong, 1.0, np.where(enough & right, 0.0, np.nan))


def anywhere(table: Table) -> Any:
    return table.program >= 0


def bodies_meet(table: Table) -> Any:
    return table.meets & (table.stable == 1)


def plain_is_off(table: Table) -> Any:
    """Select cells where bodies meet, the step is stable, and plain first order is off."""
    return bodies_meet(table) & (table.fobg_off == 1)


def term_acts(table: Table) -> Any:
    """Select those of them where force jumps, so that the onset term adds something."""
    return plain_is_off(table) & (table.jump > SMOOTH_SHARE)


def on_tasks(where: Callable[[Table], Any], *tasks: str) -> Callable[[Table], Any]:
    """Restrict a selection to some tasks."""
    return lambda table: where(table) & table.task.isin(tasks)


def noise_is_wide(table: Table) -> Any:
    """Select those of them where noise is as wide as the term needs."""
    return term_acts(table) & (table.onset_spread >= LEAST_SPREAD)


VERDICTS: Final = ("variance above", "mean off", "off with the term")


def verdicts(part: Table) -> list[Any]:
    """Return decided verdicts: variance above; mean off, where bodies meet; off with the term, where it acts."""
    decided = [part.above, part[bodies_meet(part)].fobg_off, part[term_acts(part)].fobg_onset_off]
    return [each.dropna().to_numpy() == 1 for each in decided]


@dataclasses.dataclass(frozen=True)
class Rule:
    """A threshold that predicts a verdict: above it 1 is expected, below it 0.

    Attributes:
        group: column to compare.
        threshold: threshold of `diagnose`.
        verdict: column with 1, 0 or NaN.
        rising: whether values above the threshold expect 1.
        where: selects the cells to which the rule applies.
    """

    name: str
    group: str
    threshold: float
    verdict: str
    where: Callable[[Table], Any]
    rising: bool = True

    def judged(self, table: Table) -> Table:
        """Return the decided cells to which the rule applies."""
        kept = self.where(table) & np.isfinite(table[self.group]) & np.isfinite(table[self.verdict])
        return table[kept]

    def hits(self, table: Table, threshold: float) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the rule is right in each cell with verdict 1, and in each with verdict 0."""
        expected = (table[self.group] > threshold) == self.rising
        truth = table[self.verdict] == 1
        return (expected[truth]).to_numpy(), (~expected[~truth]).to_numpy()

    def balanced(self, table: Table, threshold: float) -> float:
        """Return the mean of sensitivity and specificity."""
        return sum(float(np.mean(each)) if len(each) else 1.0 for each in self.hits(table, threshold)) / 2

    def fitted(self, table: Table) -> float:
        """Return the quantile with the best balanced share as threshold."""
        tried = np.unique(np.quantile(table[self.group], np.linspace(0.01, 0.99, 99)))
        return float(tried[int(np.argmax([self.balanced(table, each) for each in tried]))])


LAUNCHED: Final = ("momentum_transfer", "ball_wall")
FORCES: Final = ("pusher", "pusher_apart", "sliding_box")
RULES: Final = (
    Rule("unstable step: variance above; launch angle", "limit", 1.0, "above", on_tasks(anywhere, *LAUNCHED)),
    Rule("unstable step: variance above; many forces", "limit", 1.0, "above", on_tasks(anywhere, *FORCES)),
    Rule("force jumps at first touch: mean off", "jump", SMOOTH_SHARE, "fobg_off", bodies_meet),
    Rule(
        "smooth onset, travel over width: variance above",
        "travel",
        1 / WIDTH_RATIO,
        "above",
        lambda table: bodies_meet(table) & (table.contact == "smooth_onset"),
    ),
    Rule(
        "noise narrower than steps: mean off with the term", "crossing", 1 / LEAST_SPREAD, "fobg_onset_off", term_acts
    ),
    *(
        Rule(
            f"strong onset: term beyond its bound, `{name}`",
            "strength",
            MOST_STRENGTH,
            "beyond",
            on_tasks(noise_is_wide, name),
        )
        for name in LAUNCHED
    ),
)


def halves(table: Table) -> tuple[Table, Table]:
    """Return two random halves; no contact model is in both.

    Even and odd points would not do: in a Sobol sequence these are the two halves of a dimension, the damping ratio.
    """
    first = np.random.default_rng(0).permutation(table["index"].max() + 1)[table["index"]] % 2 == 0
    return table[first], table[~first]
