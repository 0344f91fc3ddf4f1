"""Flipped bits in every file of a study and of the caches: each is noticed, or changes no number."""

import itertools
import json
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import jax.numpy as jnp
import pytest

from mjx_study import compiled
from mjx_study.caches import ProgramCache
from mjx_study.experiment.study import StudyError
from mjx_study.storage.folder import Store, load_study
from tests.fuzz import studies
from tests.fuzz.answers import Row, WrongError

FLIPS: Final = {"bit flips in files of studies": 1200, "bit flips in files of caches": 400}
"""Kinds, and numbers of flips at full size."""
DRAWN: Final = 20
"""One flip of so many is followed by a command that draws the study."""


def flip(kind: str, count: int, root: Path) -> Row:
    """Flip single bits, in each file in turn, and read it."""
    row, draw = Row(kind), random.Random(0)
    found = _of_studies(root / "studies") if kind.endswith("studies") else _of_caches(root / "caches", draw)
    for path, check in itertools.islice(found, count):
        content = path.read_bytes()
        path.write_bytes(flipped(content, draw))
        with row.counting(path.relative_to(root)):
            row.codes[check()] += 1
        path.write_bytes(content)
    return row


def flipped(content: bytes, draw: random.Random) -> bytes:
    """Content with one bit flipped; of empty content, a byte."""
    place = draw.randrange(8 * len(content)) if content else 0
    changed = bytearray(content or b"\0")
    changed[place // 8] ^= 1 << place % 8
    return bytes(changed)


def _of_studies(root: Path) -> Iterator[tuple[Path, Callable[[], int]]]:
    """Files of studies of each kind, again and again, with what reads a study and compares it with what it was."""
    folders = [studies.unfinished(studies.make(kind, root), root / f"{kind}-unfinished") for kind in studies.STUDIES]
    files = [(folder, path) for folder in folders for path in sorted(folder.rglob("*")) if path.is_file()]
    right = {folder: (_numbers(folder), load_study(folder)) for folder in folders}
    for index, (folder, path) in enumerate(itertools.cycle(files)):
        command = ("plot", "report")[index // DRAWN % 2] if index % DRAWN == 0 else None

        def check(folder: Path = folder, path: Path = path, command: str | None = command) -> int:
            refused = False
            try:
                numbers, shown = right[folder]
                if _numbers(folder) != numbers or not load_study(folder).identical(shown):
                    raise WrongError("read to other numbers")
            except StudyError as error:
                refused = True
                if "\n" in str(error):
                    raise WrongError(f"more than a line: {error}") from None
            needless = path.name.endswith(".part.npz")  # for drawing
            if command and studies.draw(folder, root / "nothing", command) != (2 if refused and not needless else 0):
                raise WrongError(f"another exit code of {command}")
            return 2 if refused else 0

        yield path, check


def _numbers(folder: Path) -> str:
    """All that a study's files say, without measured times."""
    store = Store.open(folder)
    cells = {index: store.read(index) for index in range(len(store.document["cells"])) if store.has(index)}
    parts = {index: store.read_part(index) for index in store.missing}
    plain = {key: {name: array.tolist() for name, array in each.items()} for key, each in (cells | parts).items()}
    return json.dumps([store.document, plain], sort_keys=True)


def _of_caches(root: Path, draw: random.Random) -> Iterator[tuple[Path, Callable[[], int]]]:
    """A program of any content and a trace, again and again, with what must read nothing from it."""
    programs = ProgramCache(root / "programs")
    (root / "traces").mkdir(parents=True, exist_ok=True)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(compiled, "traces_folder", lambda: root / "traces")
        compiled.Compiled(jnp.sin, "sine").executable(1.0)
    (trace,) = (root / "traces").iterdir()

    def check(path: Path, read: Callable[[Path], Any]) -> int:
        if read(path) is not None:
            raise WrongError("damaged content was read")
        if path.exists():
            raise WrongError("a damaged file was kept")
        return 2

    for _ in itertools.count():
        programs.put("program", draw.randbytes(draw.choice([0, 1, 64, 65, 5000])))
        read: dict[Path, Callable[[Path], Any]] = {
            root / "programs" / "program-cache": lambda _: programs.get("program"),
            trace: lambda path: compiled._read(path, "sine"),
        }
        yield from ((path, lambda path=path, each=each: check(path, each)) for path, each in read.items())
