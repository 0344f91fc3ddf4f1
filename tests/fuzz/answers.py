"""Answers of commands to hostile inputs, and counts of those that are wrong.

Whatever the input, a command ends in time with an exit code of 0, 1 or 2, says why in one line if it is not 0, and
changes no file but those that it was asked to write.
"""

import contextlib
import dataclasses
import hashlib
import io
import re
import stat
from collections import Counter
from collections.abc import Generator
from pathlib import Path
from typing import Any, Final

from mjx_study import cli
from tests.faults import deadline

SECONDS: Final = 20
"""Maximum time for an input [s]."""
MOST_TEXT: Final = 3000
"""Maximum length of what a refusal prints."""
OUTPUTS: Final = {"out", "results"}
"""Folders that commands are asked to write to, or write to by default."""
BESIDE: Final = re.compile(r"MuJoCo: | *\d+\.\d s  ")
"""Beginnings of lines that may come beside a refusal: warnings, stages and signs of life."""


class Planned(BaseException):
    """Raised in place of a computation."""


class TooSlow(BaseException):
    """Raised when an answer takes too long."""


class WrongError(AssertionError):
    """Raised for an answer that a command must not give."""


@dataclasses.dataclass
class Row:
    """Inputs of one kind.

    Attributes:
        inputs: how many were tried.
        codes: how many ended with which exit code.
        wrong: what was wrong, of those that were answered wrongly.
    """

    kind: str
    inputs: int = 0
    codes: Counter[int] = dataclasses.field(default_factory=Counter)
    wrong: list[str] = dataclasses.field(default_factory=list)

    @contextlib.contextmanager
    def counting(self, what: Any) -> Generator[None]:
        """Count an input, and an answer that is wrong, comes too late or is a traceback."""
        self.inputs += 1
        try:
            with deadline(SECONDS, TooSlow):
                yield
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            self.wrong.append(f"{self.kind}: {what}: {type(error).__name__} {error}")


def answer(arguments: list[str], folder: Path, *, refuse: bool | None = None) -> int:
    """Exit code of a command, whose answer is checked.

    Args:
        arguments: of the command line.
        folder: must be afterwards what it was before, except for what is under `OUTPUTS`.
        refuse: whether the input must be refused, or must not; None for either.

    Raises:
        WrongError: the input is taken wrongly or refused without a line, a traceback is printed, or the folder changes.
    """
    before = contents_of(folder)
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main(arguments)
        except Planned:
            code = 0
        except SystemExit as stop:
            code = stop.code
            if not {"-h", "--version"} & set(arguments) and not any(each.startswith("--h") for each in arguments):
                raise WrongError(f"left with {code}") from stop
    told = err.getvalue()
    if "Traceback" in told:
        raise WrongError(told)
    if code not in (0, 1, 2) or (refuse is not None and refuse != (code == 2)):
        raise WrongError(f"exit code {code} of {arguments}: {told}")
    lines = [line for line in told.splitlines() if not BESIDE.match(line)]
    if code and (len(lines) != 1 or not lines[0].startswith("mjx-study: ") or len(told) > MOST_TEXT):
        raise WrongError(f"no single line: {told}")
    if code == 2 and out.getvalue() and arguments[0] != "sweep":  # which first states what it would compute
        raise WrongError(f"prints before it refuses: {out.getvalue()}")
    if contents_of(folder) != before:
        raise WrongError("a file was touched")
    return code


def contents_of(folder: Path) -> dict[str, str]:
    """What each path of a folder is, except under `OUTPUTS`: a file of some digest, a folder, a link, ..."""
    found = {}
    for path in folder.rglob("*"):
        if not OUTPUTS & set(path.relative_to(folder).parts):
            mode = path.lstat().st_mode
            is_file = stat.S_ISREG(mode) and mode & 0o400
            found[str(path)] = hashlib.sha256(path.read_bytes()).hexdigest() if is_file else oct(mode)
    return found
