"""Plant each defect in a copy of the repository, and say what catches it: the fast tests, gradcheck, or nothing.

The tests that are likely to see it run first; if they pass gradcheck runs, and if it passes too the other fast tests.
"""

import argparse
import dataclasses
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from experiments.pages import write_tables
from mjx_study.cli.gradcheck import UNEXERCISED
from mjx_study.table import format_table, markdown_table
from tests.planted.defects import DEFECTS, Defect, plant
from tests.planted.models import MODELS

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = (".git", ".venv*", ".*cache*", ".hypothesis", "__pycache__", "results", "build", "dist")
LIMIT = 900.0  # [s] for one command


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What came of a defect; None for what was not run, "" for what saw nothing.

    Attributes:
        defect: that was planted.
        test: the first fast test that failed.
        gradcheck: what gradcheck said.
    """

    defect: Defect
    test: str
    gradcheck: str | None


@contextmanager
def copy_of_the_tree() -> Generator[Path]:
    """A copy without what is not part of the project; it shares the cache of compiled programs."""
    with tempfile.TemporaryDirectory(prefix="planted-") as folder:
        tree = Path(folder) / "tree"
        left_out = shutil.ignore_patterns(*LEFT_OUT)
        # of the root alone: mjx_study has a package of the name results
        shutil.copytree(
            ROOT, tree, ignore=lambda at, names: left_out(at, names) if at == str(ROOT) else [], symlinks=True
        )
        cache_folder = ROOT / ".pytest_cache" / "jax"
        cache_folder.mkdir(parents=True, exist_ok=True)
        (tree / ".pytest_cache").mkdir()
        (tree / ".pytest_cache" / "jax").symlink_to(cache_folder.resolve())
        yield tree


def run(tree: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A module of the tree in a fresh interpreter."""
    environment = os.environ | {
        "PYTHONPATH": str(tree),
        "PYTHONDONTWRITEBYTECODE": "1",
        "JAX_COMPILATION_CACHE_DIR": str(tree / ".pytest_cache" / "jax"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.5",
    }
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=LIMIT)


def failing_test(tree: Path, *arguments: str) -> str:
    """The first fast test that fails, or "".

    Raises:
        RuntimeError: pytest could not run them, or import their file.
    """
    done = run(tree, "pytest", "-q", "-x", "-p", "no:cacheprovider", *arguments)
    if done.returncode == 0:
        return ""
    for line in done.stdout.splitlines():
        if line.startswith(("FAILED ", "ERROR ")) and "::" in line:
            return line.split(" - ")[0].split(maxsplit=1)[1]
    raise RuntimeError(f"pytest {' '.join(arguments)} ended with code {done.returncode}:\n{done.stdout}{done.stderr}")


def wrong_by_gradcheck(tree: Path, model: str) -> str:
    """What gradcheck finds wrong with a model, or ""."""
    path = tree / f"{model}.xml"
    path.write_text(MODELS[model])
    done = run(tree, "mjx_study", "gradcheck", str(path))
    if "Traceback" in done.stderr:
        return f"{model}: {done.stderr.strip().splitlines()[-1]}"
    return "" if done.returncode in (0, UNEXERCISED) else f"{model}: exit code {done.returncode}"


@cache
def clean_gradcheck(model: str) -> str:
    """The same without a defect, which must be ""."""
    with copy_of_the_tree() as tree:
        return wrong_by_gradcheck(tree, model)


def judge(defect: Defect, *, everything: bool) -> Verdict:
    """Plant a defect and see what catches it.

    Args:
        defect: to plant.
        everything: whether to run gradcheck though a test has caught it.

    Raises:
        RuntimeError: gradcheck finds fault with the model as it is, or pytest cannot run.
    """
    with copy_of_the_tree() as tree:
        plant(defect, tree)
        test, checked = failing_test(tree, *defect.tests), None
        if defect.model is not None and (everything or not test):
            if wrong := clean_gradcheck(defect.model):
                raise RuntimeError(f"gradcheck must pass {defect.model} without a defect, and says {wrong}")
            checked = wrong_by_gradcheck(tree, defect.model)
        if not test and not checked:
            test = failing_test(tree, *(f"--deselect={name}" for name in defect.tests))
    return Verdict(defect, test, checked)


def row(verdict: Verdict) -> list[str]:
    """Of the table: name, file, what caught it."""
    defect, checked = verdict.defect, verdict.gradcheck
    said = "-" if defect.model is None else "not run" if checked is None else checked or "passes"
    return [defect.name, defect.file, verdict.test.removeprefix("tests/") or "passes", said]


def markdown(verdicts: Sequence[Verdict]) -> str:
    """Format the table of the page: how many were caught, by what; defects by file and by what caught them."""
    found: dict[str, tuple[list[str], list[str], list[str]]] = {}
    for verdict in verdicts:
        column = 0 if verdict.test else 1 if verdict.gradcheck else 2
        found.setdefault(verdict.defect.file, ([], [], []))[column].append(verdict.defect.name)
    rows = [(f"`{file}`", *map(", ".join, names)) for file, names in found.items()]
    table = markdown_table(rows, ("file", "caught by the fast tests", "by gradcheck alone", "by nothing"))
    tested = sum(bool(each.test) for each in verdicts)
    checked = [each.gradcheck for each in verdicts if each.gradcheck is not None]
    missed = sum(len(each[2]) for each in found.values())
    return (
        f"{len(verdicts)} defects: the fast tests caught {tested} of {len(verdicts)}, gradcheck "
        f"{sum(map(bool, checked))} of {len(checked)}; {missed} caught by nothing.\n\n{table}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Plant, print; 1 where a defect is caught by nothing."""
    parser = argparse.ArgumentParser(prog="python -m tests.planted", description=__doc__)
    parser.add_argument("--list", action="store_true", help="the defects, without planting any")
    parser.add_argument("--only", action="append", metavar="NAME", choices=[each.name for each in DEFECTS])
    parser.add_argument("--everything", action="store_true", help="gradcheck also where a test has caught the defect")
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="put the table between its marks on the page")
    options = parser.parse_args(arguments)
    chosen = [each for each in DEFECTS if not options.only or each.name in options.only]
    if options.list:
        print("\n".join(format_table([[each.name, each.file, each.why] for each in chosen], ["defect", "file", "why"])))
        return 0
    verdicts = []
    for index, defect in enumerate(chosen, 1):
        start = time.monotonic()
        verdicts.append(verdict := judge(defect, everything=options.everything))
        found = "caught" if verdict.test or verdict.gradcheck else "CAUGHT BY NOTHING"
        note = f"{index}/{len(chosen)} {defect.name}: {found}, {time.monotonic() - start:.0f} s"
        print(note, file=sys.stderr, flush=True)
    print("\n".join(format_table([row(each) for each in verdicts], ["defect", "file", "fast tests", "gradcheck"])))
    print(markdown(verdicts).splitlines()[0])
    if options.page is not None:
        write_tables(options.page, {"defects": markdown(verdicts)})
    return int(not all(each.test or each.gradcheck for each in verdicts))


if __name__ == "__main__":
    sys.exit(main())
