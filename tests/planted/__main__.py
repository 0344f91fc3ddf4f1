"""Plant each defect in a copy of the repository, and say what catches it: the fast tests, gradcheck, or nothing.

The tests that are likely to see it run first; if they pass gradcheck runs, and if it passes too the other fast tests.
"""

import argparse
import dataclasses
import json
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

from mjx_study.cli.gradcheck import UNEXERCISED
from mjx_study.table import format_table, markdown_table
from tests.planted import DEFECTS
from tests.planted.defect import Defect, plant
from tests.planted.models import MODELS

ROOT = Path(__file__).resolve().parents[2]
LEFT_OUT = (".git", ".venv*", ".*cache*", ".hypothesis", "__pycache__", "results", "build", "dist")
LIMIT = 900.0  # [s] for one command
MARK = "<!-- from here on: make defects -->\n"


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What came of a defect; None for what was not run, "" for what saw nothing.

    Attributes:
        defect: that was planted.
        test: the first fast test that failed.
        gradcheck: what gradcheck said.
        seconds: that it took.
    """

    defect: Defect
    test: str | None
    gradcheck: str | None
    seconds: float

    @property
    def caught(self) -> bool:
        """Whether anything saw it."""
        return bool(self.test or self.gradcheck)


@contextmanager
def copy_of_the_tree() -> Generator[Path]:
    """A copy without what is not part of the project; it shares the cache of compiled programs."""
    with tempfile.TemporaryDirectory(prefix="planted-") as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(*LEFT_OUT), symlinks=True)
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
        RuntimeError: pytest could not run them.
    """
    done = run(tree, "pytest", "-q", "-x", "-p", "no:cacheprovider", *arguments)
    if done.returncode == 0:
        return ""
    for line in done.stdout.splitlines():
        if line.startswith(("FAILED ", "ERROR ")):
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


def judge(defect: Defect, known: Verdict | None, *, everything: bool) -> Verdict:
    """Plant a defect and see what catches it.

    Args:
        defect: to plant.
        known: what an earlier run found; only what it lacks is run.
        everything: whether to run gradcheck though a test has caught it.

    Raises:
        RuntimeError: gradcheck finds fault with the model as it is, or pytest cannot run.
    """
    if known and (known.gradcheck is not None or defect.model is None or not everything):
        return known
    start = time.monotonic()
    test, checked, before = (known.test, known.gradcheck, known.seconds) if known else (None, None, 0.0)
    with copy_of_the_tree() as tree:
        plant(defect, tree)
        if test is None:
            test = failing_test(tree, *defect.tests)
        if checked is None and defect.model is not None and (everything or not test):
            if wrong := clean_gradcheck(defect.model):
                raise RuntimeError(f"gradcheck must pass {defect.model} without a defect, and says {wrong}")
            checked = wrong_by_gradcheck(tree, defect.model)
        if not test and not checked:
            test = failing_test(tree, *(f"--deselect={name}" for name in defect.tests))
    return Verdict(defect, test, checked, before + time.monotonic() - start)


def read_results(path: Path | None) -> dict[str, Verdict]:
    """Verdicts by the defect's name, of an earlier run over the same code."""
    lines = path.read_text().splitlines() if path is not None and path.is_file() else []
    documents = [json.loads(line) for line in lines]
    defects = {each.name: each for each in DEFECTS}
    return {d["defect"]: Verdict(defects[d["defect"]], d["test"], d["gradcheck"], d["seconds"]) for d in documents}


def row(verdict: Verdict) -> list[str]:
    """Of the table: name, file, what caught it."""
    told = {None: "not run", "": "passes"}
    defect = verdict.defect
    checked = "-" if defect.model is None else told.get(verdict.gradcheck, verdict.gradcheck or "")
    return [defect.name, defect.file, told.get(verdict.test, verdict.test or "").removeprefix("tests/"), checked]


def summary(verdicts: Sequence[Verdict]) -> str:
    """How many were caught, by what."""
    tested = [verdict.test for verdict in verdicts if verdict.test is not None]
    checked = [verdict.gradcheck for verdict in verdicts if verdict.gradcheck is not None]
    missed = sum(verdict.test == "" and not verdict.caught for verdict in verdicts)
    return (
        f"{len(verdicts)} defects: the fast tests caught {sum(map(bool, tested))} of {len(tested)}, gradcheck "
        f"{sum(map(bool, checked))} of {len(checked)}; {missed} caught by nothing"
    )


def markdown(verdicts: Sequence[Verdict]) -> str:
    """Format the table of the page: defects by file and by what caught them."""
    found: dict[str, tuple[list[str], list[str], list[str]]] = {}
    for verdict in verdicts:
        column = 0 if verdict.test else 1 if verdict.gradcheck else 2
        found.setdefault(verdict.defect.file, ([], [], []))[column].append(verdict.defect.name)
    rows = [(f"`{file}`", *map(", ".join, names)) for file, names in found.items()]
    table = markdown_table(rows, ("file", "caught by the fast tests", "by gradcheck alone", "by nothing"))
    return f"{summary(verdicts)}.\n\n{table}\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Plant, print; 1 where a defect is caught by nothing."""
    parser = argparse.ArgumentParser(prog="python -m tests.planted", description=__doc__)
    parser.add_argument("--list", action="store_true", help="the defects, without planting any")
    parser.add_argument("--only", action="append", metavar="NAME", choices=[each.name for each in DEFECTS])
    parser.add_argument("--everything", action="store_true", help="gradcheck also where a test has caught the defect")
    parser.add_argument(
        "--results", type=Path, metavar="FILE", help="keep verdicts there, and plant only what it lacks"
    )
    parser.add_argument("--known", action="store_true", help="plant nothing: the table of --results, as far as it goes")
    parser.add_argument("--page", type=Path, metavar="FILE.md", help="put the table where the page has its mark")
    options = parser.parse_args(arguments)
    chosen = [each for each in DEFECTS if not options.only or each.name in options.only]
    if options.list:
        print("\n".join(format_table([[each.name, each.file, each.why] for each in chosen], ["defect", "file", "why"])))
        return 0
    verdicts, known = [], read_results(options.results)
    for index, defect in enumerate(chosen, 1):
        verdict = known.get(defect.name)
        if options.known:
            verdicts.append(verdict or Verdict(defect, None, None, 0.0))
            continue
        verdict = judge(defect, verdict, everything=options.everything)
        verdicts.append(verdict)
        if options.results is not None and verdict is not known.get(defect.name):
            with options.results.open("a") as file:
                file.write(json.dumps(dataclasses.asdict(verdict) | {"defect": defect.name}) + "\n")
        found = "caught" if verdict.caught else "CAUGHT BY NOTHING"
        note = f"{index}/{len(chosen)} {defect.name}: {found}, {verdict.seconds:.0f} s"
        print(note, file=sys.stderr, flush=True)
    print("\n".join(format_table([row(each) for each in verdicts], ["defect", "file", "fast tests", "gradcheck"])))
    print(summary(verdicts))
    if options.page is not None:
        head = options.page.read_text().partition(MARK)[0]
        options.page.write_text(f"{head}{MARK}\n## Planted defects\n\n{markdown(verdicts)}")
    return 1 if any(each.test == "" and not each.caught for each in verdicts) else 0


if __name__ == "__main__":
    sys.exit(main())
