"""Rules about options that commands with and without a study share."""

import math
from collections.abc import Collection, Iterable, Sequence

from mjx_study.choices import REFERENCE, laws_of, takes_stiffness
from mjx_study.options.option import OptionError


def check_span(span: Sequence[float] | None) -> None:
    """Raise OptionError unless span is None or two numbers in ascending order."""
    if span is not None and not (len(span) == 2 and 0 < span[1] - span[0] < math.inf):
        raise OptionError("span", "must be two numbers, the lower one first; got " + ", ".join(map(str, span)))


def reject_untaken(families: Sequence[str], *, stiffness: object, damping: object, smoothing: object = None) -> None:
    """Raise OptionError for a stiffness, damping or smoothing, not None, that none of the contact families takes."""
    if smoothing is not None and not laws_of(families):
        raise OptionError("smoothing", "has no effect on MuJoCo's law: omit it, or add a family such as hunt_crossley")
    undamped = [family for family in families if family != REFERENCE]
    for name, value, able in (("stiffness", stiffness, families), ("damping", damping, undamped)):
        if value is not None and not takes_stiffness(able):
            chosen = f"contact {', '.join(families)}" if families else "solref or solimp alone"
            raise OptionError(name, f"has no effect on {chosen}: omit it, or add a family that takes one, e.g. mujoco")


def reject_unused(given: Collection[str], *uses: tuple[Iterable[str], bool, str]) -> None:
    """Raise OptionError for the first option that was given and has no effect; `uses` are names of options, whether
    they have one, and the reason if they have none."""
    for names, used, reason in uses:
        for name in names:
            if name in given and not used:
                raise OptionError(name, reason)
