"""Claims that measurements can refute: a statistic, and its values for which a claim or its opposite holds."""

import dataclasses
import hashlib
import math
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from mjx_study.choices import laws_of
from mjx_study.claims.laboratory import Effort, Statistic
from mjx_study.identity import VERSIONED, code_of
from mjx_study.runtime import precision
from mjx_study.version import version_of

DEFINITIONS: Final = Path(__file__).with_name("claims.toml")
VERDICTS: Final = ("holds", "fails", "reversed", "undecided")
Range = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Criterion:
    """A statistic, and its values for which a claim or its opposite holds, fixed before measurement."""

    quantity: str
    holds: Range
    reversed: Range | None = None

    def verdict(self, interval: Range) -> str:
        """Return one of `VERDICTS`."""
        low, high = interval
        if not (math.isfinite(low) or math.isfinite(high)):
            return "undecided"
        if self.holds[0] <= low and high <= self.holds[1]:
            return "holds"
        if self.reversed is not None and self.reversed[0] <= low and high <= self.reversed[1]:
            return "reversed"
        return "fails" if high < self.holds[0] or low > self.holds[1] else "undecided"

    def lines(self) -> str:
        holds = f"holds {_range(self.holds)}"
        return holds if self.reversed is None else f"{holds}, reversed {_range(self.reversed)}"


@dataclasses.dataclass(frozen=True)
class Claim:
    """A statement that measurements can refute.

    Attributes:
        place: section of the paper that states it, or the open question that it answers.
        systems: systems to measure, each with its contact families.
        measure: computes the statistic of the criterion for a system and family, with `options`.
        show: command that demonstrates it.
    """

    id: str
    place: str
    statement: str
    criterion: Criterion
    systems: Mapping[str, tuple[str, ...]]
    measure: Callable[..., Statistic]
    show: str = ""
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def of_laws(self) -> bool:
        """Whether the claim is about contact laws other than MuJoCo's, which need the extra `laws`."""
        return bool(laws_of(family for _, family in self.cases))

    @property
    def cases(self) -> list[tuple[str, str]]:
        """Pairs of system and family, each with its own verdict."""
        return [(system, family) for system, families in self.systems.items() for family in families]

    def key(self, effort: Effort) -> str:
        """Digest of what the claim requires, whatever its wording, the effort and the precision."""
        return _digest(self.id, self.criterion.holds, self.criterion.reversed, self.systems, effort, precision())

    def made_by(self) -> str:
        """Digest of the code that measures the claim, and of library versions."""
        versions = [version_of(name) for name in VERSIONED if name != "mjx-study"]
        return _digest(code_of(self.measure.__module__), versions, sorted(self.options.items()))


def load_claims(modules: Mapping[str, ModuleType]) -> dict[str, Claim]:
    """Read claims by id, in the order of `claims.toml`; the functions that measure them are in `modules`."""
    definitions = tomllib.loads(DEFINITIONS.read_text())
    families, systems = definitions["families"], definitions["systems"]

    def claim(name: str, fields: dict[str, Any]) -> Claim:
        fields = definitions["ranges"].get(fields.get("range"), {}) | fields
        module, function = fields["measure"].split(".")
        chosen = systems[fields["systems"]] if isinstance(fields["systems"], str) else fields["systems"]
        expanded = {
            system: tuple(each for group in groups for each in families.get(group, [group]))
            for system, groups in chosen.items()
        }
        ranges: dict[str, Any] = {
            part: tuple(map(_bound, fields[part])) for part in ("holds", "reversed") if part in fields
        }
        return Claim(
            name,
            fields.get("place", "this project"),
            fields["statement"],
            Criterion(fields["quantity"], **ranges),
            expanded,
            getattr(modules[module], function),
            fields.get("show", f"mjx-study claims --quick --only {name}"),
            fields.get("options", {}),
        )

    return {name: claim(name, fields) for name, fields in definitions["claims"].items()}


def _bound(value: float | str) -> float:
    """A number, or the logarithm of one such as "-log10 1.25"."""
    if isinstance(value, str):
        sign, _, number = value.partition("log10 ")
        return math.copysign(math.log10(float(number)), -1 if sign else 1)
    return value


def _range(part: Range) -> str:
    low, high = part
    if math.isinf(high):
        return f"above {low:g}"
    return f"below {high:g}" if math.isinf(low) else f"from {low:g} to {high:g}"


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]
