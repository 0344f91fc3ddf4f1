"""Every option, described once: name, type, range, unit and one line of help.

The command line, TOML files and Python configurations are validated against these descriptions. A configuration sets
defaults and may narrow ranges.
"""

import dataclasses
import math
import sys
from collections.abc import Collection, Mapping
from numbers import Integral, Real
from typing import Any, ClassVar, Final

from estimators.choices import BASELINES, DENSITIES, VARIANCE_PROXIES, WEIGHTS, suggestion, unknown
from estimators.registry import ESTIMATORS
from mjx_study.choices import CONES, FAMILIES, INTEGRATORS, KINDS, ONSETS, REFERENCE, SOLVERS

MOST_VALUES: Final = 10_000
"""Maximum number of values in a list or range."""
WANTED: Final[dict[type, tuple[type, str]]] = {
    bool: (bool, "true or false"),
    str: (str, "text"),
    int: (Integral, "a whole number"),
    float: (Real, "a number"),
}
"""Type of a value by its option's kind, and the words for it."""


@dataclasses.dataclass(frozen=True)
class Interval:
    """An interval in standard notation, such as "(0, 1]"; a square bracket at an infinite end includes infinity."""

    text: str

    @property
    def low(self) -> float:
        return float(self.text[1:-1].split(",")[0])

    @property
    def high(self) -> float:
        return float(self.text[1:-1].split(",")[1])

    def __contains__(self, value: Any) -> bool:
        if abs(value) > sys.float_info.max and isinstance(value, Integral):  # too large for a float
            return False
        above = value >= self.low if self.text[0] == "[" else value > self.low
        below = value <= self.high if self.text[-1] == "]" else value < self.high
        return bool(above and below)

    def __str__(self) -> str:
        bracket, low, high = self.text[0], _plain(self.low), _plain(self.high)
        lower = f"at least {low}" if bracket == "[" else "positive" if self.low == 0 else f"greater than {low}"
        upper = "finite" if self.high == math.inf else f"less than {high}"
        upper = upper if self.text[-1] == ")" else f"at most {high}"
        parts = [lower] * (self.low > -math.inf) + [upper] * (self.high < math.inf or self.text[-1] == ")")
        return " and ".join(parts)


@dataclasses.dataclass(frozen=True)
class Option:
    """Description of an option.

    Attributes:
        name: name of the configuration field.
        kind: int, float, str or bool; bool is a flag on the command line.
        metavar: placeholder for a value in the help.
        line: one line for the help, in which {} stands for the choices.
        interval: range of its numbers.
        unit: unit of its numbers.
        choices: accepted names, in addition to numbers if there is an interval.
        own: whether it also accepts a user-defined `module:name`.
        label: noun for a value in messages; by default the name.
        many: whether it takes a list; set by the configuration that contains it.
        unset: default shown in the help if the configuration has none.
    """

    name: str
    kind: type
    metavar: str
    line: str
    interval: Interval | None = None
    unit: str = ""
    choices: Collection[str] = ()
    own: bool = False
    label: str = ""
    many: bool = False
    unset: str = ""

    @property
    def flag(self) -> str:
        return f"--{self.name.replace('_', '-')}"

    def within(self, interval: str) -> "Option":
        """Return the option with another range."""
        return dataclasses.replace(self, interval=Interval(interval))

    def check(self, value: Any) -> Any:
        """Check and return a value, or a list with all its values; a ValueError's text follows the option's name."""
        if self.many and not isinstance(value, tuple | list):
            raise ValueError(f"must be a list, got {_short(value)}")
        if self.many and len(value) > MOST_VALUES:
            raise ValueError(f"must be at most {MOST_VALUES} values, got {len(value)}")
        for each in value if self.many else (value,):
            self._check_one(each)
        return value

    def parse(self, text: str) -> Any:
        """Parse and check text: a number, a name, or a list of them, which may include ranges FROM:TO:COUNT[:log]."""
        if not self.many:
            return self.check(self._parse_one(text.strip() if self.kind is not str else text))
        parts = [part.strip() for part in text.split(",") if part.strip()]
        return self.check(tuple(each for part in parts for each in self._parse_part(part)))

    def read(self, value: Any) -> Any:
        """Read and check a value from a file: a number, a name, or a list of them; lists may be text as for `parse`."""
        if not self.many:
            return self._typed(self.check(value))
        if isinstance(value, str):
            return self.parse(value)
        return tuple(self._typed(each) for each in self.check(value if isinstance(value, list) else [value]))

    def describe(self, default: Any = None) -> str:
        """Return the help text: line, unit and default."""
        default = ",".join(map(str, default)) if isinstance(default, tuple) else default
        told = self.unset if default is None else f"{default:g}" if isinstance(default, float) else str(default)
        line = self.line.format(", ".join(self.choices))
        return line + (f" [{self.unit}]" if self.unit else "") + (f" (default: {told})" if told else "")

    def _typed(self, value: Any) -> Any:
        return self.kind(value) if self.kind is float and isinstance(value, Integral) else value

    def _check_one(self, value: Any) -> None:
        wanted, words = WANTED[self.kind]
        if self.choices and isinstance(value, str):
            if value not in self.choices and not (self.own and ":" in value):
                label = self.label or self.name.replace("_", " ")
                other = ", or give a number" if self.interval else ", or module:name of your own" if self.own else ""
                raise ValueError(unknown(label, value, self.choices, other))
        elif not isinstance(value, wanted) or (isinstance(value, bool) and self.kind is not bool):
            raise ValueError(f"must be {words}, got {_short(value)}")
        elif self.interval is not None and value not in self.interval:
            raise ValueError(f"must be {self.interval}, got {_plain(value)}")

    def _parse_one(self, text: str) -> Any:
        if self.kind is str or text in self.choices:
            return text.lower() if text.lower() in self.choices else text  # MuJoCo writes RK4, Newton
        try:
            value = int(text) if self.kind is int else float(text)
        except ValueError:
            return _whole(text) if self.kind is int else text
        refuse_overflow(text, value)
        return value

    def _parse_part(self, text: str) -> list[Any]:
        if self.kind is str or ":" not in text:
            return [self._parse_one(text)]
        values = expand_range(text)
        return [_whole(value) for value in values] if self.kind is int else values


def refuse_overflow(text: str, value: float | int) -> None:
    """Raise ValueError for a number such as 1e400, which Python reads as infinity."""
    if value in (math.inf, -math.inf) and "inf" not in text.lower():
        raise ValueError(f"must be at most {sys.float_info.max:.2g} in size, got {_short(text)}")


def _whole(value: str | float) -> Any:
    """Convert a whole number such as 1e5 to int; return anything else unchanged."""
    try:
        number = float(value)
    except ValueError:
        return value
    refuse_overflow(str(value), number)
    return int(number) if number.is_integer() else value


def _plain(value: Any) -> str:
    """Format a number briefly for messages."""
    try:
        return f"{int(value)}" if value == int(value) and abs(value) < 1e16 else f"{value:g}"
    except (OverflowError, ValueError):
        return _short(value)


def _short(value: Any) -> str:
    """Truncated repr of a value."""
    try:
        text = repr(value)
    except ValueError:  # an integer with more digits than Python prints
        return "a number with thousands of digits"
    return text if len(text) <= 60 else f"{text[:50]}..."


def expand_range(text: str) -> list[float]:
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
            f"{_short(text)} is neither a number nor a range FROM:TO:COUNT or FROM:TO:COUNT:log, COUNT at least 2"
        ) from None
    if count > MOST_VALUES:
        raise ValueError(f"the range {_short(text)} must be of at most {MOST_VALUES} values")
    shares = [index / (count - 1) for index in range(count)]
    if log:
        ratio, sign = math.log(stop / start), math.copysign(1.0, start)
        inner = [sign * float(f"{abs(start) * math.exp(share * ratio):.12g}") for share in shares]
    else:
        inner = [float(f"{start + share * (stop - start):.12g}") for share in shares]
    return [start, *inner[1:-1], stop]


def _number(name: str, kind: type, interval: str, metavar: str, line: str, **more: Any) -> Option:
    return Option(name, kind, metavar, line, Interval(interval), **more)


def _choice(name: str, choices: Collection[str], metavar: str, line: str, **more: Any) -> Option:
    return Option(name, str, metavar, line, choices=choices, **more)


TASKS: Final = "the task's"
MJCF: Final = "the MJCF's"
CONTACTS: Final = (*FAMILIES, REFERENCE)
"""Contact families of a study, and the analytic reference."""
OPTIONS: Final[dict[str, Option]] = {
    option.name: option
    for option in (
        _number("seed", int, "[0, 4294967295]", "N", "random seed"),
        _number("devices", int, "[1, 256]", "N", "CPU devices", unset="one per core"),
        _number("sigma", float, "(0, inf)", "S", "standard deviation of the noise", unset=TASKS),
        _choice("noise", DENSITIES, "NAME", "noise density", unset=TASKS),
        _choice("baseline", BASELINES, "NAME", "baseline of zeroth-order estimates"),
        Option("published", bool, "", "use the published example's values of the next four options"),
        _number("gamma", float, "(0, inf]", "G", "AoBG's accuracy bound; inf for none", unset=TASKS),
        _number("failure_probability", float, "(0, 1)", "P", "failure probability of epsilon"),
        _choice("variance_proxy", VARIANCE_PROXIES, "S2", "variance in epsilon: {}"),
        _number("radius", float, "[0, inf)", "R", "R in epsilon, or max_deviation", choices=("max_deviation",)),
        _number("max_norm", float, "(0, inf)", "G", "fobg_clipped: norm at which samples are clipped"),
        _number("window", int, "[1, 1000000]", "H", "fobg_truncated: steps between cuts"),
        _number("tolerance", float, "[0, 1)", "C", "ddcg: tolerance of its discontinuity test"),
        _choice("weights", WEIGHTS, "NAME", "weights of interpolations: plug_in, or cross_fitted (unbiased)"),
        _choice("onset", ONSETS, "NAME", "onset term of first-order gradients: none, linear, or jump (costly)"),
        _choice("backward", ("none", *FAMILIES), "FAMILY", "contact whose derivatives are taken", label="family"),
        _number("backward_stiffness", float, "(0, inf)", "K", "stiffness of --backward", unit="N/m", unset="unchanged"),
        _number("backward_margin", float, "(0, inf)", "M", "distance where --backward begins", unit="m", unset=MJCF),
        _choice("kind", KINDS, "KIND", "kind of study", unset="from --iterations and --points"),
        _choice("estimators", ESTIMATORS, "NAME", "see `mjx-study estimators`", label="estimator", own=True),
        _choice("contact", CONTACTS, "FAMILY", "contact family: {}", label="contact family", unset=TASKS),
        _number("stiffness", float, "(0, inf)", "K", "contact stiffness", unit="N/m", unset=TASKS),
        _number("damping", float, "[0, inf)", "B", "contact damping", unit="N s/m", unset="the family's"),
        _choice("cone", CONES, "CONE", "friction cone: {}", unset=MJCF),
        _number("timestep", float, "(0, 1)", "H", "timestep", unit="s", unset=MJCF),
        _number("horizon", int, "[1, 1000000]", "H", "number of steps", unset=TASKS),
        Option("model", str, "FILE.xml", "MJCF that replaces the task's own"),
        _number("theta", float, "(-inf, inf)", "X", "policy parameters", unset=TASKS),
        _number("samples", int, "[1, 1e7]", "N", "samples in each batch", unset=TASKS),
        _number("reference_samples", int, "[3, 1e7]", "N", "pairs of rollouts for each reference", unset="600"),
        _number("evaluation_samples", int, "[2, 1e7]", "N", "rollouts for the cost of a final policy", unset="200"),
        _number("chunk_size", int, "[1, 1e7]", "N", "samples per device and call", unset="by the samples"),
        _number("block_size", int, "[2, 1e7]", "N", "samples held at once", unset="all, if they fit"),
        _number("confidence", float, "(0, 1)", "P", "confidence level of the intervals"),
        _number("seeds", int, "[1, 100000]", "N", "number of batches, or of descents"),
        _number("iterations", int, "[1, 10000000]", "N", "iterations of the optimiser", unset=TASKS),
        Option("optimizer", str, "NAME", "optax optimiser", unset="sgd"),
        _number("learning_rate", float, "(0, inf)", "R", "learning rate", unset=TASKS),
        _number("decay", float, "[0, 2]", "A", "learning rate / i^A", unset=TASKS),
        Option("stiffness_schedule", str, "CALL", "factor on the stiffness by iteration, an optax schedule", unset="1"),
        Option("sigma_schedule", str, "CALL", "factor on sigma by iteration, an optax schedule", unset="1"),
        _number("network", int, "[1, 100000]", "N", "hidden widths of a tanh network that replaces the policy"),
        _number("points", int, "[2, 100000]", "N", "points on the line"),
        _number("span", float, "(-inf, inf)", "LO,HI", "range of the line", unset=TASKS),
        _number("solref", float, "(-inf, inf)", "A;B", "contact models in MuJoCo's terms, every A with every B"),
        _number("solimp", float, "(-inf, inf)", "D0,D1,W,M,P", "solimp to combine with them; several separated by ;"),
        Option("direction", str, "DIR", "random, or a parameter's index", unset="random"),
        _number("states", int, "[1, 1000]", "N", "states to check"),
        _choice("integrator", INTEGRATORS, "NAME", "integrator: {}", unset=MJCF),
        _choice("solver", SOLVERS, "NAME", "constraint solver: {}", unset=MJCF),
        _number("solver_iterations", int, "[1, 100000]", "N", "iterations of the solver", unset=MJCF),
        _number("solver_ls_iterations", int, "[1, 100000]", "N", "and of its line search", unset=MJCF),
        Option("disable_flag", str, "FLAG", "flags to disable, named as in the MJCF's <flag>"),
        _number("frames", int, "[1, 100]", "N", "frames in the film strip"),
        _number("slow", float, "(0, 1000]", "FACTOR", "slow-motion factor"),
    )
}  # fmt: skip
"""Every option by its name."""
SCENE_OPTIONS: Final = {
    "integrator": "integrator",
    "solver": "solver",
    "solver_iterations": "iterations",
    "solver_ls_iterations": "ls_iterations",
    "disable_flag": "disable_flags",
}
"""Options that override an MJCF's <option>, so that a model can be adapted to MJX without editing its file, and the
arguments of `load_scene` that they set."""
BUILDER_OPTIONS: Final = ("horizon", "model", *SCENE_OPTIONS)
"""Options passed to the builder of a task."""


def as_arguments(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options that are not None, as arguments of `make_task` and `load_scene`."""
    return {SCENE_OPTIONS.get(name, name): value for name, value in options.items() if value is not None}


@dataclasses.dataclass(frozen=True)
class Checked:
    """Base of configurations: frozen dataclasses whose fields are options, each checked on construction.

    Attributes:
        ranges: narrower intervals for some of the options.
    """

    ranges: ClassVar[dict[str, str]] = {}

    def __new__(cls, **given: Any) -> "Checked":
        """Suggest a name for a misspelt one."""
        names = [field.name for field in dataclasses.fields(cls)]
        for name in given:
            if name not in names:
                raise TypeError(f"{cls.__name__} has no option {name!r}{suggestion(name, names)}")
        return super().__new__(cls)

    @classmethod
    def option(cls, name: str) -> Option:
        """Return an option with this configuration's range, marked as a list if it is one here."""
        option = OPTIONS[name].within(cls.ranges[name]) if name in cls.ranges else OPTIONS[name]
        return dataclasses.replace(option, many="tuple" in str(cls.__annotations__[name]))

    @classmethod
    def default(cls, name: str) -> Any:
        return next(field.default for field in dataclasses.fields(cls) if field.name == name)

    def _named(self, name: str) -> Any:
        """Value of a field as options describe it, with names in place of objects."""
        return getattr(self, name)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = self._named(field.name)
            if field.name in ("solref", "solimp"):
                for row in value:
                    check(self.option(field.name), row)
            elif field.name in OPTIONS and not (value is None and field.default is None):
                check(self.option(field.name), value)


def check(option: Option, value: Any) -> Any:
    """Check a value and return it; a ValueError names the option."""
    try:
        return option.check(value)
    except ValueError as error:
        named = str(error) if str(error).startswith("unknown ") else f"{option.name} {error}"
        raise ValueError(named) from None
