"""Small studies of each kind, of an analytic system, so that commands take little time."""

import contextlib
import io
import shutil
from pathlib import Path
from typing import Final

from mjx_study import cli
from mjx_study.storage.folder import Store
from tests.fuzz.answers import answer

ANALYTIC: Final = ("pusher", "--horizon", "4", "--contact", "reference", "--stiffness", "10,100", "--chunk-size", "4")
STUDIES: Final = {
    "gradients": ("--estimators", "zobg,fobg,aobg", "--samples", "8", "--reference-samples", "8", "--seeds", "3"),
    "descents": ("--iterations", "3", "--samples", "4", "--seeds", "2", "--learning-rate", "0.01"),
    "landscapes": ("--points", "3", "--direction", "0", "--span=-1,1", "--samples", "4"),
}
"""Options of a study of each kind."""


def make(kind: str, root: Path) -> Path:
    """Run a study of a kind in a folder of its name, unless it is there."""
    if not (root / kind).exists():
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            assert cli.main(["sweep", *ANALYTIC, *STUDIES[kind], "--output", str(root / kind)]) == 0
    return root / kind


def unfinished(whole: Path, folder: Path) -> Path:
    """Copy a study and let it have everything that a folder may hold: a checkpoint of the last cell."""
    if not folder.exists():
        shutil.copytree(whole, folder)
        store = Store.open(folder)
        arrays, by = store.read_with_versions(1)
        store.file(1, part=True).write(arrays, by)
        store.path(1).unlink()
    return folder


def draw(folder: Path, outside: Path, command: str = "plot") -> int:
    """Exit code of a command that draws a study; its answer is checked."""
    output = {"plot": ["--format", "png", "--output", "out"], "report": ["--output", "out/page.html"]}[command]
    return answer([command, str(folder), *output[:-1], str(folder.parent / output[-1])], outside)


def resume(kind: str, folder: Path, outside: Path) -> int:
    """Exit code of the command that made a study; its answer is checked."""
    return answer(["sweep", *ANALYTIC, *STUDIES[kind], "--output", str(folder)], outside)
