"""Options of the commands: how they are parsed and checked, and what they describe."""

import argparse
import dataclasses
import itertools
import re
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NoReturn

from estimators.choices import suggestion, unknown
from mjx_study.choices import FAMILIES, PRECISIONS, TASK_DESCRIPTIONS, unknown_task
from mjx_study.cli.output import complain
from mjx_study.options.configuration import StudyConfig
from mjx_study.options.option import BUILDER_OPTIONS, CONTACTS, OPTIONS, TASKS, Option, refuse_overflow

if TYPE_CHECKING:
    import mjx_study.options.files
    import mjx_study.tasks.task


SIMILAR_FLAGS: Final = 0.75
"""Least similarity of a flag that is suggested, which its dashes add to."""
OPTION_NAME: Final = re.compile(r"""`\w+`|(?<![\w.'"/=-])[a-z]+(_[a-z]+)+(?![\w?'"]|: |[./=]\w)""")
"""What may name an option in a message: a word in backticks, or one with an underscore, but not the key of a file."""
TASK_OPTIONS: Final = ("timestep", "cone", *BUILDER_OPTIONS)
"""Options for the builder of a task."""


class UsageError(ValueError):
    """Invalid option or file, reported in one line with exit code 2."""


@contextmanager
def usage_errors() -> Generator[None]:
    """Turn errors that users can cause into UsageErrors, with flags for names of options; for checks only, never for
    computing."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise UsageError(OPTION_NAME.sub(_flag_of, str(error))) from error


def _flag_of(found: re.Match[str]) -> str:
    name = found[0].strip("`")
    return OPTIONS[name].flag if name in OPTIONS else found[0]


class Parser(argparse.ArgumentParser):
    """Argument parser that adds options from their descriptions, and raises UsageError, with suggestions for misspelt
    names."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, allow_abbrev=False, **settings)

    def error(self, message: str) -> NoReturn:
        message = re.sub(r"^argument (?!-)\S+: ", "", message)
        raise UsageError(f"{message}{'' if message.endswith('?') else '.'} See {self.prog} --help")

    def parse_known_args(self, args: Iterable[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Reject unknown options here, since the top level would point to its own help."""
        given, flags = list(args or ()), self._option_string_actions
        own = itertools.takewhile(lambda text: text.startswith("-") if self._subparsers else text != "--", given)
        for flag in (text.partition("=")[0] for text in own if text.startswith("--")):
            if flag not in (*flags, "--"):
                self.error(f"unknown option {flag}{suggestion(flag, flags, SIMILAR_FLAGS)}")
        parsed, extra = super().parse_known_args(given, namespace)
        if extra:
            self.error(f"unexpected argument {extra[0]}")
        return parsed, extra

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            label = str(action.metavar or action.dest).lower()
            raise argparse.ArgumentError(action, unknown(label, value, action.choices))

    def add_flag(self, flag: str, line: str) -> None:
        self.add_argument(flag, action="store_true", help=line)

    def add_option(
        self,
        option: str | Option,
        default: Any = None,
        *,
        given: bool = True,
        read: Callable[[str], Any] | None = None,
        **changes: Any,
    ) -> None:
        """Add an option with changes to its description, and its own parser or another one.

        Unless `given`, the parsed namespace does not hold the default, which a configuration fills in.
        """
        option = dataclasses.replace(OPTIONS[option] if isinstance(option, str) else option, **changes)

        def parse(text: str) -> Any:
            try:
                return (read or option.parse)(text)
            except ValueError as error:
                raise argparse.ArgumentTypeError(str(error)) from None

        flag, several = option.flag, option.many and "," not in option.metavar
        if option.kind is bool:
            self.add_argument(flag, action="store_true", default=None, help=option.describe())
            return
        self.add_argument(
            flag,
            type=parse,
            default=default if given else None,
            metavar=f"{option.metavar}[,{option.metavar}]" if several else option.metavar,
            help=option.describe(default).replace("%", "%%"),
        )

    def add_fields(self, *names: str, **changes: dict[str, Any]) -> None:
        """Add fields of a study's configuration, which fills in their defaults, with changes to their descriptions."""
        for name in names:
            option, default = StudyConfig.option(name), StudyConfig.default(name)
            self.add_option(option, default, given=False, **changes.get(name, {}))

    def add_task_options(self) -> None:
        """Add the task, options that override its settings, and process options."""
        self.add_task_argument()
        self.add_option("sigma")
        self.add_builder_options()
        self.add_process_options()

    def add_builder_options(self, **changes: dict[str, Any]) -> None:
        """Add options for the builder of a task, with changes to their descriptions."""
        for name in TASK_OPTIONS:
            self.add_option(name, many=name == "disable_flag", **changes.get(name, {}))

    def add_task_argument(self) -> None:
        named = f"one of: {', '.join(TASK_DESCRIPTIONS)}; module:name of your own; or any MJCF that MJX runs"
        self.add_argument("task", type=known_task, metavar="TASK|FILE.xml", help=named)

    def add_theta_option(self, purpose: str) -> None:
        """Add `--theta`, read by `theta_of`."""
        numbers = "a policy written by optimise, a .json or .npy file, or numbers (default: the task's)"
        self.add_argument("--theta", metavar="FILE|X[,X]", help=f"{purpose}: {numbers}")

    def add_contact_options(
        self, stiffness: str = "the task's sweep", contact: str = TASKS, *, many: bool = True, analytic: bool = True
    ) -> None:
        """Add the contact models: one or many, with or without the analytic reference."""
        self.add_option("stiffness", many=many, unset=stiffness)
        self.add_option("contact", many=many, unset=contact, choices=CONTACTS if analytic else tuple(FAMILIES))
        self.add_option("damping")

    def add_estimator_options(self) -> None:
        """Add the noise and the estimators' options; see `estimators.ESTIMATORS`."""
        self.add_fields("noise", "baseline", "published", "gamma", "failure_probability", "variance_proxy", "radius")
        self.add_fields("max_norm", "window", "tolerance", "weights", "onset")

    def add_backward_options(self, *, many: bool = True) -> None:
        """Add the contact model of surrogate derivatives: one or many."""
        self.add_option("backward", many=many, unset="none")
        self.add_option("backward_stiffness")
        self.add_option("backward_margin")

    def add_process_options(self, seed: int | None = 0) -> None:
        """Add seed, precision and devices; a seed of None leaves its default to a configuration."""
        self.add_option("seed", 0, given=seed is not None)
        self.add_argument("--precision", choices=PRECISIONS, default="float64", help="default: float64")
        self.add_option("devices")

    def add_folder_options(self) -> None:
        line = "folder for the study's numbers and figures; resumable"
        self.add_argument("--output", type=Path, metavar="DIR", help=line)
        self.add_resume_options()

    def add_resume_options(self) -> None:
        self.add_flag("--dry-run", "print the expected cost; compute and write nothing")
        self.add_flag("--accept-versions", "resume a folder begun by other versions of the software")

    def add_cluster_option(self) -> None:
        line = "compute on Dask workers: local:N processes, slurm:N workers, or a scheduler's tcp://host:port"
        self.add_argument("--cluster", type=_cluster, metavar="WHERE", help=line)


def refuse_unusable(given: Sequence[str]) -> None:
    """Raise UsageError for an option whose value is --, which argparse drops, and for what no file can be called."""
    for text in given:
        if "\0" in text or re.search("[\ud800-\udc7f\udd00-\udfff]", text):
            raise UsageError(f"no argument may hold null or surrogate characters, got {text!r}")
        if text.startswith("-") and text.endswith("=--"):
            raise UsageError(f"{text.removesuffix('=--')} needs a value, got --")


def known_task(text: str) -> str:
    """Return a task's name, or raise ArgumentTypeError if it is unknown."""
    if told := unknown_task(text):
        raise argparse.ArgumentTypeError(told)
    return text


def _cluster(text: str) -> str:
    """Parse a cluster, as for `mjx_study.execution.cluster.connected`."""
    if re.fullmatch(r"(local|slurm)(:[1-9]\d{0,4})?|(tcp|tls|ws|wss|ucx)://\S+", text):
        return text
    wanted = "local:N, slurm:N or an address such as tcp://host:8786"
    raise argparse.ArgumentTypeError(f"must be {wanted}, got {text!r}")


def given_options(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Those of the named options that the command has and that were given."""
    found = {name: getattr(options, name, None) for name in names}
    return {name: value for name, value in found.items() if value is not None}


def task_of(options: argparse.Namespace) -> "mjx_study.tasks.task.Task":
    from mjx_study.tasks import task_with_options

    task = task_with_options(options.task, given_options(options, *TASK_OPTIONS))
    return task if options.sigma is None else task.replace(sigma=options.sigma)


def theta_of(options: argparse.Namespace) -> tuple[float, ...] | None:
    """Return the parameters given by `--theta`; None if it is not given."""
    return theta_and_policy(options)[0]


def theta_and_policy(
    options: argparse.Namespace,
) -> "tuple[tuple[float, ...] | None, mjx_study.options.files.PolicyFile | None]":
    """Return the parameters given by `--theta`, and the policy file that holds them, which must be for the task."""
    from mjx_study.options.files import read_theta

    if options.theta is None:
        return None, None
    parts = options.theta.split(",")
    try:
        numbers = tuple(map(float, parts))
    except ValueError:
        path = Path(options.theta)
    else:
        for text, number in zip(parts, numbers, strict=True):
            try:
                refuse_overflow(text, number)
            except ValueError as error:
                raise ValueError(f"--theta: {error}") from None
        return numbers, None
    theta, policy = read_theta(path)
    if policy is not None and policy.task != options.task:
        raise ValueError(f"{path} is a policy of {policy.task}, not of {options.task}")
    return theta, policy


def configure_process(options: argparse.Namespace) -> None:
    """Set up JAX from the options, and watch its computation; commands without them get float64 and one device."""
    from mjx_study.watchdog import watch

    configure(precision=getattr(options, "precision", PRECISIONS[0]), cpu_devices=getattr(options, "devices", 1))
    watch(lambda line: complain(f"mjx-study: {line}"))


def configure(**settings: Any) -> None:
    """Call `mjx_study.runtime.configure`; ValueError if JAX has no device, for instance by JAX_PLATFORMS."""
    import jax

    from mjx_study.runtime import configure

    try:
        configure(**settings)
        jax.local_devices()
    except RuntimeError as error:
        raise ValueError(f"JAX has no device to compute on: {error}") from error
