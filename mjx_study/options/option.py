"""Options: declared as fields of a configuration, and checked alike in text, in files and in Python."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Collection, Generator, Iterable, Sequence
from contextlib import contextmanager
from numbers import Integral, Real
from typing import Any, Final, get_args, get_origin

from estimators.choices import suggestion
from estimators.intervals import Interval, plain, short
from mjx_study.choices import REFERENCE, laws_of, takes_stiffness

KINDS: Final[dict[type, tuple[type, str]]] = {
    bool: (bool, "true or false"),
    str: (str, "text"),
    int: (Integral, "a whole number"),
    float: (Real, "a number"),
}
"""What a value may be an instance of, by the kind of its option, and the words for it."""
MAX_VALUES: Final = 10_000
"""Maximum number of values in a list or range."""
Rows = tuple[tuple[float, ...], ...]


class OptionError(ValueError):
    """Invalid value of an option, or options that do not go together.

    Attributes:
        option: name of the option, which the message begins with.
        reason: rest of the message, with {} for each of `others`.
        others: names of other options.
    """

    def __init__(self, option: str, reason: str, *others: str):
        super().__init__(option, reason, *others)
        self.option, self.reason, self.others = option, reason, others

    def spelled(self, spell: Callable[[str], str]) -> str:
        """The message, with options as the user knows them, such as flags."""
        message = f"{spell(self.option)} {self.reason}"
        for other in self.others:
            message = message.replace("{}", spell(other), 1)
        return message

    def __str__(self) -> str:
        return self.spelled(lambda name: f"`{name}`")


@dataclasses.dataclass(frozen=True)
class Option:
    """Declaration of an option.

    Attributes:
        name: name of the field of the configuration.
        kind: int, float, str or bool; bool is a flag on the command line.
        metavar: placeholder for a value in the help.
        line: one line for the help, in which {} stands for the choices.
        interval: range of its numbers, such as "(0, inf)".
        unit: unit of its numbers.
        choices: accepted names, in addition to numbers if there is an interval.
        allows_user_code: whether it also accepts a `module:name`.
        study: the kind of study that it is for; "" for all.
        many: whether it takes a list.
        read_rows: function that reads a list of lists of numbers from text, for an option that takes such lists.
        default: value of the field if it is not given.
        unset: default shown in the help if that is None.
        most: maximum number of values.
    """

    name: str
    kind: type
    metavar: str
    line: str
    interval: str = ""
    unit: str = ""
    choices: Collection[str] = ()
    allows_user_code: bool = False
    study: str = ""
    many: bool = False
    read_rows: Callable[[str], Rows] | None = None
    default: Any = None
    unset: str = ""
    most: int = MAX_VALUES

    @property
    def flag(self) -> str:
        return flag_of(self.name)

    def check(self, value: Any) -> Any:
        """Check and return a value, or a list with all its values; otherwise OptionError."""
        with self._naming_errors():
            for row in self._listed(value) if self.read_rows else (value,):
                for each in self._listed(row) if self.many else (row,):
                    self._check_one(each)
        return value

    def parse(self, text: str) -> Any:
        """Parse and check text: a number, a name, or a list of them, which may include ranges FROM:TO:COUNT[:log]."""
        with self._naming_errors():
            if self.read_rows:
                return self.check(self.read_rows(text))
            if self.many:
                parts = [part.strip() for part in text.split(",") if part.strip()]
                ranges = self.kind is not str
                lists = [
                    expand_range(each, self.kind) if ranges and ":" in each else [self._parse_one(each)]
                    for each in parts
                ]
                return self.check(tuple(itertools.chain(*lists)))
            return self.check(self._parse_one(text))

    def read(self, value: Any) -> Any:
        """Read and check a value from a file: as in Python, as text for `parse`, or one value in place of a list."""
        if isinstance(value, str) and (self.many or self.read_rows):
            return self.parse(value)
        if self.kind is str and isinstance(value, int) and not isinstance(value, bool):
            value = str(value)
        if self.many and not self.read_rows and not isinstance(value, list):
            value = [value]
        return self._typed(self.check(value))

    def describe(self) -> str:
        """Return the help text: line, unit and default."""
        default = ",".join(map(str, self.default)) if isinstance(self.default, tuple) else self.default
        shown = self.unset
        if default is not None and self.kind is not bool:
            shown = f"{default:g}" if isinstance(default, float) else str(default)
        line = self.line.format(", ".join(self.choices))
        return line + (f" [{self.unit}]" if self.unit else "") + (f" (default: {shown})" if shown else "")

    @contextmanager
    def _naming_errors(self) -> Generator[None]:
        try:
            yield
        except OptionError:
            raise
        except ValueError as error:
            raise OptionError(self.name, str(error)) from None

    def _listed(self, value: Any) -> Iterable[Any]:
        if not isinstance(value, tuple | list):
            raise ValueError(f"must be a list, got {short(value)}")
        if len(value) > self.most:
            raise ValueError(f"takes at most {self.most} values, got {len(value)}")
        return value

    def _check_one(self, value: Any) -> None:
        wanted, words = KINDS[self.kind]
        if self.choices and isinstance(value, str):
            if value not in self.choices and not (self.allows_user_code and ":" in value):
                listed = ", ".join(self.choices) + ", or module:name of your own" * self.allows_user_code
                listed += ", or give a number" * bool(self.interval)
                raise ValueError(
                    f"does not accept {short(value)}{suggestion(value, self.choices) or f'; choose from {listed}'}"
                )
        elif not isinstance(value, wanted) or (isinstance(value, bool) and self.kind is not bool):
            raise ValueError(f"must be {words}, got {short(value)}")
        elif self.interval and value not in Interval(self.interval):
            raise ValueError(f"must be {Interval(self.interval)}, got {plain(value)}")

    def _parse_one(self, text: str) -> Any:
        if self.kind is not str and text.strip() not in self.choices:
            return parse_number(text.strip(), self.kind)
        return text.lower() if text.lower() in self.choices else text  # MuJoCo writes RK4, Newton

    def _typed(self, value: Any) -> Any:
        if isinstance(value, list | tuple):
            return tuple(self._typed(each) for each in value)
        return float(value) if self.kind is float and isinstance(value, Integral) else value


def flag_of(name: str) -> str:
    """Spell an option's name as on the command line."""
    return "TASK" if name == "tasks" else f"--{name.replace('_', '-')}"


def declared(default: Any, metavar: str, line: str, interval: str = "", **more: Any) -> Any:
    """Declare a dataclass's field as an option; its type says whether it takes numbers, names or lists of them."""
    about = {"metavar": metavar, "line": line, "interval": interval, "default": default} | more
    return dataclasses.field(default=default, metadata=about)


def options_of(configuration: type) -> dict[str, Option]:
    """The options that a dataclass declares, by name."""
    found = {}
    for field in dataclasses.fields(configuration):
        parts = list(_parts(field.type))
        kind = next(kind for kind in (bool, float, int, str) if kind in parts)
        if field.metadata:
            found[field.name] = Option(field.name, kind, many=tuple in parts, **field.metadata)
    return found


def _parts(annotation: Any) -> Generator[Any]:
    """The classes that an annotation names, such as tuple and float."""
    yield get_origin(annotation) or annotation
    for each in get_args(annotation):
        yield from _parts(each)


def parse_number(text: str, kind: type) -> Any:
    """Read an int or float, 1e5 as an int too; other text is returned unchanged, for a check to refuse."""
    try:
        value = float(text)
    except ValueError:
        return text
    if kind is float:
        return value
    try:
        return int(text)
    except ValueError:
        return int(value) if value.is_integer() else text


def expand_range(text: str, kind: type) -> list[Any]:
    """Expand FROM:TO:COUNT (evenly spaced) or FROM:TO:COUNT:log (equal ratios); both ends are exact."""
    parts = text.split(":")
    log = parts[3:] == ["log"]
    try:
        if len(parts) not in (3, 4) or (len(parts) == 4 and not log):
            raise ValueError
        start, stop, count = float(parts[0]), float(parts[1]), int(parts[2])
        if count < 2 or not math.isfinite(stop - start) or (log and not 0 < stop / start < math.inf):
            raise ValueError
    except (ValueError, ZeroDivisionError):
        raise ValueError(
            f"takes numbers and ranges FROM:TO:COUNT or FROM:TO:COUNT:log, COUNT at least 2; got {short(text)}"
        ) from None
    if count > MAX_VALUES:
        raise ValueError(f"takes at most {MAX_VALUES} values, got the range {short(text)}")
    shares = [index / (count - 1) for index in range(count)]
    if log:
        ratio, sign = math.log(stop / start), math.copysign(1.0, start)
        inner = [sign * float(f"{abs(start) * math.exp(share * ratio):.12g}") for share in shares]
    else:
        inner = [float(f"{start + share * (stop - start):.12g}") for share in shares]
    values = [start, *inner[1:-1], stop]
    return [int(value) if kind is int and value.is_integer() else value for value in values]


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
