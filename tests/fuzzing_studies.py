"""Studies that were damaged or forged, and what reading, drawing and resuming them must give.

A bit is flipped in a file of a study or of a cache: the flip is noticed, or changes no number. A folder is forged by
somebody who knows how digests are made: every command answers with exit code 0 or 2 and one line, at once, and writes
nothing outside the folder. Studies are of an analytic system, so that commands take little time; nothing is stubbed.
"""

import contextlib
import io
import itertools
import json
import random
import re
import shutil
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mjx_study import cli
from mjx_study.caches import read_cached, write_cached
from mjx_study.study.run import load_study
from mjx_study.study.store import Store, StudyError
from tests.forgeries import FORGERIES
from tests.fuzzing import TooSlow, digest, limited

SECONDS: Final = 20
ANALYTIC: Final = ("pusher", "--horizon", "4", "--contact", "reference", "--stiffness", "10,100", "--chunk-size", "4")
STUDIES: Final = {
    "gradients": ("--estimators", "zobg,fobg,aobg", "--samples", "8", "--reference-samples", "8", "--seeds", "3"),
    "descents": ("--iterations", "3", "--samples", "4", "--seeds", "2", "--learning-rate", "0.01"),
    "landscapes": ("--points", "3", "--direction", "0", "--span=-1,1", "--samples", "4"),
}
"""Options of a small study of each kind."""
READING: Final = (("plot", "--format", "png", "--output", "out"), ("report", "--output", "out/page.html"))


@dataclass
class Row:
    """A row of the table of what was tried.

    Attributes:
        silent: inputs that changed a number unnoticed, or were to be refused and were not.
        outside: inputs after which a file outside the folder was another one.
    """

    kind: str
    inputs: int = 0
    silent: int = 0
    tracebacks: int = 0
    hangs: int = 0
    outside: int = 0
    told: list[str] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        self.told = []

    @property
    def wrong(self) -> int:
        return self.silent + self.tracebacks + self.hangs + self.outside

    @contextlib.contextmanager
    def counting(self, what: str) -> Generator[None]:
        """Count an input, and how it fails; `SilentError` is one that does not show."""
        self.inputs += 1
        try:
            with limited(SECONDS):
                yield
        except SilentError as error:
            self.silent += 1
            self.told.append(f"{what}: silent, {error}")
        except TooSlow:
            self.hangs += 1
            self.told.append(f"{what}: no answer in {SECONDS} s")
        except OutsideError as error:
            self.outside += 1
            self.told.append(f"{what}: {error}")
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            self.tracebacks += 1
            self.told.append(f"{what}: {type(error).__name__}: {error}")


class SilentError(Exception):
    """Raised where something wrong was accepted."""


class OutsideError(Exception):
    """Raised where a file outside the folder was changed."""


def make(kind: str, folder: Path) -> Path:
    """Run a study of a kind in a folder."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert cli.main(["sweep", *ANALYTIC, *STUDIES[kind], "--output", str(folder)]) == 0
    return folder


def unfinished(whole: Path, folder: Path) -> Path:
    """A study with everything that a folder may hold: the last cell is a checkpoint, and a failure is noted."""
    shutil.copytree(whole, folder)
    store = Store.open(folder)
    arrays, by = store.read_with_versions(1)
    store._write(1, arrays, by, part=True)
    store.path(1).unlink()
    store.write_failure(1, "no memory")
    return folder


def answered(*arguments: str) -> int:
    """Exit code of a command whose answer is one."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = cli.main(list(arguments))
    told = err.getvalue()
    assert code in (0, 1, 2) and "Traceback" not in told, (code, told)
    if code:  # 1 where a file of the study cannot be replaced
        lines = [line for line in told.splitlines() if not re.match(r" *\d+\.\d s  \[", line)]
        assert len(lines) == 1 and lines[0].startswith("mjx-study: ") and len(told) < 3000, told
        assert arguments[0] == "sweep" or not out.getvalue(), out.getvalue()  # which first states what it would do
    return code


# Flips.


def flipped(content: bytes, draw: random.Random) -> bytes:
    """Content with one bit flipped; of empty content, a byte."""
    place = draw.randrange(8 * len(content)) if content else 0
    changed = bytearray(content or b"\0")
    changed[place // 8] ^= 1 << place % 8
    return bytes(changed)


def numbers_of(folder: Path) -> Any:
    """All that a study's files say, without measured times."""
    store = Store.open(folder)
    cells = {index: store.read(index) for index in range(len(store.document["cells"])) if store.has(index)}
    parts = {index: store.read_part(index) for index in store.missing}
    plain = {key: {name: array.tolist() for name, array in each.items()} for key, each in (cells | parts).items()}
    return json.dumps([store.document, plain, store.failures], sort_keys=True)


def flip_studies(count: int, root: Path, seed: int = 0, every: int = 20) -> Row:
    """Flip bits in every file of a study of each kind, and read it; some are drawn by commands as well."""
    row, draw = Row("bit flips in a study's files"), random.Random(seed)
    folders = [unfinished(make(kind, root / kind), root / f"{kind}-unfinished") for kind in STUDIES]
    files = [(folder, path) for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    right = {folder: numbers_of(folder) for folder in folders}
    shown = {folder: load_study(folder) for folder in folders}
    for index, (folder, path) in zip(range(count), itertools.cycle(files)):
        content = path.read_bytes()
        path.write_bytes(flipped(content, draw))
        try:
            with row.counting(f"{path.relative_to(root)}"):
                try:
                    if numbers_of(folder) != right[folder] or not load_study(folder).identical(shown[folder]):
                        raise SilentError("read to other numbers")
                    refused = False
                except StudyError as error:
                    assert "\n" not in str(error)
                    refused = True
                if index % every == 0:
                    command, *options = READING[index // every % 2]
                    refused &= not path.name.endswith((".part.npz", ".failed"))  # of which drawing has no need
                    assert answered(command, str(folder), *here(options, root)) == (2 if refused else 0)
        finally:
            path.write_bytes(content)
    return row


def here(options: Any, root: Path) -> list[str]:
    """Options whose paths are in a folder."""
    return [str(root / each) if each.startswith("out") else each for each in options]


def flip_cached(count: int, root: Path, seed: int = 0) -> Row:
    """Flip bits in files of caches of any content: what is read is what was written, or nothing."""
    row, draw = Row("bit flips in cached files"), random.Random(seed)
    path = root / "cache" / "entry"
    for _ in range(count):
        content = draw.randbytes(draw.choice([0, 1, 64, 65, 5000]))
        write_cached(path, content)
        whole = path.read_bytes()
        path.write_bytes(flipped(whole, draw))
        with row.counting("cached file"):
            if read_cached(path) is not None:
                raise SilentError("damaged content was read")
            assert not path.exists()
    return row


# Forgeries.


def forge_studies(count: int | None, root: Path, seed: int = 0) -> list[Row]:
    """Forge folders of each kind of study, and read, draw and resume them.

    Args:
        count: number of each kind of forgery, drawn at random; None for all.

    Returns:
        A row for each kind of forgery.
    """
    draw, rows = random.Random(seed), []
    studies = {kind: make(kind, root / kind) for kind in STUDIES}
    outside = root / "outside"
    outside.mkdir()
    (outside / "file").write_text("somebody's")
    before = digest(outside)
    for what, forgeries in FORGERIES.items():
        row = Row(f"forged folders: {what}")
        every = [(kind, *each) for kind, folder in studies.items() for each in forgeries(folder)]
        chosen = every if count is None else draw.sample(every, min(count, len(every)))
        for kind, name, forge, refuse in chosen:
            at = root / "forged"
            shutil.copytree(studies[kind], at)
            forge(at, outside)
            with row.counting(f"{kind}, {name}"):
                codes = [answered(command, str(at), *here(options, root)) for command, *options in READING[:1]]
                if codes == [0]:
                    codes += [answered(command, str(at), *here(options, root)) for command, *options in READING[1:]]
                again = answered("sweep", *ANALYTIC, *STUDIES[kind], "--output", str(at))
                if refuse and (0 in codes or again == 0):
                    raise SilentError(f"accepted: exit codes {codes} and {again}")
            if digest(outside) != before:
                row.outside += 1
                row.told.append(f"{kind}, {name}: wrote outside")
                shutil.rmtree(outside)
                outside.mkdir()
                (outside / "file").write_text("somebody's")
            shutil.rmtree(at)
        rows.append(row)
    return rows


def fuzz_studies(flips: int, forged: int, root: Path, seed: int = 0) -> list[Row]:
    """Rows of the table of what was tried: so many flips in studies and in caches, and forged folders of each kind."""
    roots = [root / name for name in ("flipped", "cached", "forged")]
    for each in roots:
        each.mkdir()
    rows = [flip_studies(flips, roots[0], seed), flip_cached(flips, roots[1], seed)]
    return [*rows, *forge_studies(forged, roots[2], seed)]
