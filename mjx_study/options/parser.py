"""The command line's parser: options from their declarations, and errors in one line."""

import argparse
import dataclasses
import itertools
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, NoReturn

from estimators.choices import suggestion, unknown
from mjx_study.choices import FAMILIES, PRECISIONS, TASK_DESCRIPTIONS, unknown_task
from mjx_study.options.configuration import BUILDER_OPTIONS, CONTACTS, ESTIMATOR_OPTIONS, OPTIONS, UNSET_TASK
from mjx_study.options.option import Option, OptionError, flag_of

SIMILAR_FLAGS: Final = 0.75  # least similarity of a flag that is suggested, which its dashes add to
TASK_OPTIONS: Final = ("timestep", "cone", *BUILDER_OPTIONS)
"""Options for the builder of a task."""
SWEEP: Final = "the task's sweep"
MIDDLE: Final = "the middle one of the task's sweep"
DEVICES: Final = Option("devices", int, "N", "CPU devices", "[1, 256]", unset="one per core")
COUNT: Final = r"(:[1-9]\d{0,4})?"  # number of workers, after "local" or "slurm"
CLUSTER: Final = "local:N, slurm:N or an address such as tcp://host:8786"


class UsageError(Exception):
    """Invalid option or file, reported in one line with exit code 2."""


class Parser(argparse.ArgumentParser):
    """Argument parser that adds options from their declarations, and raises UsageError, with suggestions for misspelt
    names."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        super().__init__(*args, allow_abbrev=False, **settings)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # -2,2 and -1:1:5 are values too

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

    def add_options(self, *names: str) -> None:
        for name in names:
            self.add_option(name)

    def add_option(self, option: str | Option, *, filled: bool | None = None, **changes: Any) -> None:
        """Add an option with changes to its declaration.

        Args:
            filled: whether the parsed options have its default where it is not given; by default if the changes include
                one, or the command itself declares the option. A study's configuration fills in others.
        """
        if filled is None:
            filled = isinstance(option, Option) or "default" in changes
        option = dataclasses.replace(OPTIONS[option] if isinstance(option, str) else option, **changes)
        if option.kind is bool:
            self.add_argument(option.flag, action="store_true", default=None, help=option.describe())
            return

        def parse(text: str) -> Any:
            try:
                return option.parse(text)
            except OptionError as error:
                raise argparse.ArgumentError(None, error.spelled(flag_of)) from None

        several = option.many and not option.read_rows and "," not in option.metavar
        self.add_argument(
            option.flag,
            type=parse,
            default=option.default if filled else None,
            metavar=f"{option.metavar}[,{option.metavar}]" if several else option.metavar,
            help=option.describe().replace("%", "%%"),
        )

    def add_task_options(self, *, many: bool = False) -> None:
        """Add the task, options that override its settings, one value or many, and process options."""
        self.add_task_argument()
        self.add_option("sigma", many=many)
        self.add_builder_options(many=many)
        self.add_process_options()

    def add_task_argument(self) -> None:
        named = f"one of: {', '.join(TASK_DESCRIPTIONS)}; module:name of your own; or any MJCF that MJX runs"
        self.add_argument("task", type=known_task, metavar="TASK|FILE.xml", help=named)

    def add_builder_options(self, *, many: bool = False, **changes: dict[str, Any]) -> None:
        """Add options for the builder of a task, with changes to their declarations."""
        for name in TASK_OPTIONS:
            several = name == "disable_flag" or (many and OPTIONS[name].many)
            self.add_option(name, many=several, **changes.get(name, {}))

    def add_theta_option(self, purpose: str) -> None:
        """Add `--theta`, which may name a file."""
        numbers = "a policy written by optimise, a .json or .npy file, or numbers (default: the task's)"
        self.add_argument("--theta", metavar="FILE|X[,X]", help=f"{purpose}: {numbers}")

    def add_contact_options(
        self,
        stiffness: str = SWEEP,
        contact: str = UNSET_TASK,
        *,
        many: bool = True,
        analytic: bool = True,
    ) -> None:
        """Add the contact models: one or many, with or without the analytic reference."""
        self.add_option("stiffness", many=many, unset=stiffness)
        self.add_option("contact", many=many, unset=contact, choices=CONTACTS if analytic else FAMILIES)
        self.add_options("damping", "smoothing")

    def add_estimator_options(self) -> None:
        self.add_options("noise", *ESTIMATOR_OPTIONS, "published", "onset")

    def add_backward_options(self, *, many: bool = True) -> None:
        self.add_option("backward", many=many)
        self.add_options("backward_stiffness", "backward_margin")

    def add_process_options(self) -> None:
        self.add_option("seed")
        self.add_argument("--precision", choices=PRECISIONS, default="float64", help="default: float64")
        self.add_option(DEVICES)

    def add_folder_options(self, line: str = "folder for the study's numbers and figures; resumable") -> None:
        self.add_argument("--output", type=Path, metavar="DIR", help=line)
        self.add_flag("--dry-run", "print the expected cost; compute and write nothing")
        self.add_flag("--accept-versions", "resume a folder begun by other versions of the software")

    def add_cluster_option(self) -> None:
        line = "compute on Dask workers: local:N processes, slurm:N workers, or a scheduler's tcp://host:port"
        self.add_argument("--cluster", type=_cluster, metavar="WHERE", help=line)


def known_task(text: str) -> str:
    """Return a task's name, or raise ArgumentTypeError if it is unknown."""
    if reason := unknown_task(text):
        raise argparse.ArgumentTypeError(reason)
    return text


def _cluster(text: str) -> str:
    """Parse a cluster, as for `mjx_study.execution.cluster.connected`."""
    if re.fullmatch(rf"(local|slurm){COUNT}|(tcp|tls|ws|wss|ucx)://\S+", text):
        return text
    raise argparse.ArgumentTypeError(f"must be {CLUSTER}, got {text!r}")
