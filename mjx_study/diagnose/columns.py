"""Columns of the tables of `gradcheck --mean` and of `diagnose`, with their meaning in the help."""

from operator import itemgetter
from typing import Final

from mjx_study.table import Column, number, percent


def _share(name: str, heading: str, meaning: str) -> Column:
    return Column(heading, lambda row: "-" if row[name] is None else percent(row[name], 1), meaning)


def _number(name: str, heading: str, meaning: str) -> Column:
    return Column(heading, lambda row: number(row[name]), meaning)


def _attribute(name: str, form: str, heading: str, meaning: str) -> Column:
    return Column(heading, lambda each: format(getattr(each, name), form), meaning)


MEANS: Final[tuple[Column, ...]] = (
    _number("difference", "difference", "difference of the mean cost between the ends of the path"),
    _number("gap", "gap", "integral of the estimator's mean along the path, minus the difference"),
    _number("half_width", "±", "half-width of the gap's 99.9 % interval"),
    _number("quadrature", "quadrature", "part of the half-width that comes from the quadrature"),
    _share("relative_gap", "share", "gap as a share of the difference"),
    _share("detectable", "finds", "smallest share certain to be detected"),
    Column("verdict", itemgetter("verdict"), "right (within 5 %), biased, or undecided: too few samples"),
)
"""Columns of `gradcheck --mean`, for `MeanCheck.as_dict`."""
TOUCHES: Final[tuple[Column, ...]] = (
    _attribute("time", ".3g", "t [s]", "time at which the contact begins"),
    _attribute("speed", ".2g", "v [m/s]", "approach speed"),
)
"""Columns of the contacts of a diagnosis, for `ContactSummary`."""
DISTANCE: Final = Column("d [mm]", lambda each: f"{1e3 * each.distance:.2g}", "distance at that time, under other laws")
"""The same under laws other than MuJoCo's."""
CONTACTS: Final[tuple[Column, ...]] = (
    _attribute("damping", ".2g", "h b", "damping of the contact over one step h"),
    _attribute("stiffness", ".2g", "h^2 k", "its stiffness over one step"),
    _attribute("travel", ".2g", "h v / width", "travel per step over the depth over which the impedance rises"),
    _attribute("impedance", "g", "impedance", "d_0, at first touch: 0 is a smooth onset, MuJoCo's 0.9 a jump"),
    Column("step", lambda each: "stable" if each.stable else "UNSTABLE", "unstable if h^2 k >= 4 - 2 h b"),
)
"""The same under MuJoCo's law."""
ESTIMATES: Final[tuple[Column, ...]] = (
    Column("error", itemgetter(0), "bias and standard deviation after a second of computing, relative"),
    Column("95 % interval", itemgetter(1), "interval of the error, from that of the variance"),
    Column("mean", itemgetter(2), "right (within 5 %), off by a share, unbiased in theory, or undecided"),
    Column("ms", itemgetter(3), "computing time of one sample, without compilation"),
)
"""Columns of the estimators of a diagnosis, for tuples of texts."""
